"""The problem's priors of frames as information about the unknowns' change."""

from __future__ import annotations

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.refinement.joint_covariance import JointCovariance
from gtsam_rwhec.refinement.unknowns import Unknown, UnknownKind
from gtsam_rwhec.refinement.variables import State, Variables


def prior_terms(
    problem: Problem, variables: Variables, state: State, layout: JointCovariance, basis: Array
) -> tuple[Array, Array]:
    """Information (p, p) and gradient (p,) of 2 kappa_0 theta^2 + |t - t_0|^2 / sigma_0^2 over two, by the basis."""
    size = len(layout.unit)
    if not problem.priors:
        return np.zeros((basis.shape[1], basis.shape[1])), np.zeros(basis.shape[1])
    information, gradient = np.zeros((size, size)), np.zeros(size)
    for name, priors in problem.priors.items():
        unknown = Unknown(UnknownKind.FRAME, name)
        if unknown not in layout.slots:
            continue
        place, pose = layout.slots[unknown], (state.X | state.Y)[name].matrix()
        for prior in priors:
            if prior.kappa is not None:
                omega = se3.so3_logmap((prior.transform[:3, :3].T @ pose[:3, :3])[None])
                # Log(R Expmap(d)) = omega + Jr^-1(omega) d, and Jr^-1(omega) = Jl^-1(-omega)
                J = se3.so3_left_jacobian_inverse(-omega)[0]
                rows = slice(place.start, place.start + 3)
                information[rows, rows] += 2.0 * prior.kappa * J.T @ J
                gradient[rows] += 2.0 * prior.kappa * J.T @ omega[0]
            if prior.sigma is not None:
                R, away = pose[:3, :3], pose[:3, 3] - prior.transform[:3, 3]
                rows = slice(place.start + 3, place.stop)
                information[rows, rows] += np.eye(3) / prior.sigma**2
                gradient[rows] += R.T @ away / prior.sigma**2
    return basis.T @ information @ basis, basis.T @ gradient
