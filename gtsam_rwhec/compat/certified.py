"""The library's certified solution behind OpenCV's calls: from the poses themselves, no pairs of them."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.calibration import solve
from gtsam_rwhec.compat.stations import Stations
from gtsam_rwhec.poses import Array
from gtsam_rwhec.problem import Problem
from gtsam_rwhec.solution import Solution

#: Residuals below this, in radians or relative to the translations, are rounding: exact poses have no weights.
LEAST_RESIDUAL = 1e-6


def certified_hand_eye(stations: Stations) -> tuple[Array, Array]:
    """Certified pose of the camera in the gripper.

    The base's and target's origins are the means that ``stations`` are about: the answer does not depend on them.
    """
    R_A = stations.R_G.transpose(0, 2, 1)  # gripper_T_base
    t_A = -np.einsum("nab,nb->na", R_A, stations.t_G)
    solution = certified(R_A, t_A, stations.R_C, stations.t_C)
    Y = solution.Y["camera"].matrix()
    return Y[:3, :3], Y[:3, 3]


def certified_robot_world(R_A: Array, t_A: Array, R_B: Array, t_B: Array) -> tuple[Array, Array, Array, Array]:
    """Certified base2world and gripper2cam, from world2cam (A, the measurement) and base2gripper (B)."""
    solution = certified(R_B, t_B, R_A, t_A)
    X, Z = solution.X["target"].inverse().matrix(), solution.Y["camera"].inverse().matrix()
    return X[:3, :3], X[:3, 3], Z[:3, :3], Z[:3, 3]


def certified(R_A: Array, t_A: Array, R_B: Array, t_B: Array) -> Solution:
    """Solve A X = Y B twice: with unit weights, then with those of the first answer's residuals.

    OpenCV's calls have no place for the noise; the residuals of any consistent answer tell rotation's and
    translation's apart. An isotropic rotation of rms angle s has s / sqrt(3) an axis and kappa = 1 / (2 sigma_R^2).
    """
    A, B = _transforms(R_A, t_A), _transforms(R_B, t_B)
    first = solve(_problem(A, B, 1.0, 1.0))
    residual = first.residuals["target", "camera"]
    length = np.sqrt(np.square([t_A.std(axis=0), t_B.std(axis=0)]).sum())
    sigma_m = max(residual.translation_rms_m, LEAST_RESIDUAL * length, np.finfo(float).tiny) / np.sqrt(3.0)
    sigma_rad = max(residual.rotation_rms_rad, LEAST_RESIDUAL) / np.sqrt(3.0)
    return solve(_problem(A, B, sigma_m, 0.5 / sigma_rad**2))


def _problem(A: Array, B: Array, sigma: float, kappa: float) -> Problem:
    problem = Problem(keep_measurements=False)
    problem.add("target", "camera", A, B, sigma, kappa)
    return problem


def _transforms(R: Array, t: Array) -> Array:
    T = np.zeros((len(R), 4, 4))
    T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = R, t, 1.0
    return T
