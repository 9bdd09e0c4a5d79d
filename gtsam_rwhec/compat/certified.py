"""The library's certified solution behind OpenCV's calls: from the poses themselves, no pairs of them."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.compat.stations import Stations
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solving.certified_solution import solve
from gtsam_rwhec.solving.solution import Solution

#: Residuals below this, in radians or spreads of the translations, are rounding: exact poses have no weights.
LEAST_RESIDUAL = 1e-6


def certified_hand_eye(stations: Stations) -> tuple[Array, Array]:
    """Certified pose of the camera in the gripper.

    The target has its own origin back: what the camera measures with an error of its own is where that is. With an
    origin elsewhere each error of the rotation would move it.
    """
    R_A = stations.R_G.transpose(0, 2, 1)  # gripper_T_base
    t_A = -np.einsum("nab,nb->na", R_A, stations.t_G)
    t_C = stations.t_C + stations.R_C @ stations.origin
    _, Y = certified_poses(R_A, t_A, stations.R_C, t_C)
    return Y[:3, :3], Y[:3, 3]


def certified_robot_world(R_A: Array, t_A: Array, R_B: Array, t_B: Array) -> tuple[Array, Array, Array, Array]:
    """Certified base2world and gripper2cam, from world2cam (A, the measurement) and base2gripper (B)."""
    X, Z = (np.linalg.inv(T) for T in certified_poses(R_B, t_B, R_A, t_A))
    return X[:3, :3], X[:3, 3], Z[:3, :3], Z[:3, 3]


def certified_poses(R_A: Array, t_A: Array, R_B: Array, t_B: Array) -> tuple[Array, Array]:
    """X and Y (4, 4) of A X = Y B, solved twice: with unit weights, then with those of the first answer's residuals.

    OpenCV's calls have no place for the noise; the residuals of any consistent answer tell rotation's and
    translation's apart. An isotropic rotation of rms angle s has s / sqrt(3) an axis and kappa = 1 / (2 sigma_R^2).
    Nor do they name a unit: inside, lengths are in spreads of the given translations.
    """
    unit = float(np.sqrt(t_A.var(axis=0).sum() + t_B.var(axis=0).sum())) or 1.0
    A, B = _transforms(R_A, t_A / unit), _transforms(R_B, t_B / unit)
    residual = _solved(A, B).residuals[Pair("target", "camera")]
    sigma = max(residual.translation_rms_m, LEAST_RESIDUAL) / np.sqrt(3.0)
    sigma_rad = max(residual.rotation_rms_rad, LEAST_RESIDUAL) / np.sqrt(3.0)
    solution = _solved(A, B, sigma, 0.5 / sigma_rad**2)
    X, Y = solution.X["target"].matrix(), solution.Y["camera"].matrix()
    X[:3, 3] *= unit
    Y[:3, 3] *= unit
    return X, Y


def _solved(A: Array, B: Array, sigma: float | None = None, kappa: float | None = None) -> Solution:
    problem = Problem(keep_measurements=False)
    problem.add("target", "camera", A, B, sigma, kappa)
    return solve(problem)


def _transforms(R: Array, t: Array) -> Array:
    T = np.zeros((len(R), 4, 4))
    T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = R, t, 1.0
    return T
