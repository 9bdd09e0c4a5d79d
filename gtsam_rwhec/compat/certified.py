"""The library's certified solution with OpenCV's arguments: from the poses themselves, without pairs of poses."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.compat.stations import Stations
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.certified_solution import solve
from gtsam_rwhec.solver.solution import Solution

#: Residuals (radians, or lengths over the spread of the translations) below this are rounding error of exact poses.
LEAST_RESIDUAL = 1e-6


def certified_hand_eye(stations: Stations) -> tuple[Array, Array]:
    """The certified pose of the camera in the gripper.

    The target's own origin is restored: the camera measures the position of this origin. About another origin each
    rotation error would move the position.
    """
    R_A = stations.R_G.transpose(0, 2, 1)  # gripper_T_base
    t_A = -np.einsum("nab,nb->na", R_A, stations.t_G)
    t_C = stations.t_C + stations.R_C @ stations.origin
    _, Y = certified_poses(R_A, t_A, stations.R_C, t_C)
    return Y[:3, :3], Y[:3, 3]


def certified_robot_world(R_A: Array, t_A: Array, R_B: Array, t_B: Array) -> tuple[Array, Array, Array, Array]:
    """The certified base2world and gripper2cam, from world2cam (A, the measurement) and base2gripper (B)."""
    X, Z = (np.linalg.inv(T) for T in certified_poses(R_B, t_B, R_A, t_A))
    return X[:3, :3], X[:3, 3], Z[:3, :3], Z[:3, 3]


def certified_poses(R_A: Array, t_A: Array, R_B: Array, t_B: Array) -> tuple[Array, Array]:
    """X and Y (4, 4) of A X = Y B, solved with unit weights, then with weights from the first answer's residuals.

    OpenCV's calls have no argument for the noise; the residuals of a consistent answer estimate the noise of rotations
    and of translations. An isotropic rotation of rms angle s has s / sqrt(3) an axis and kappa = 1 / (2 sigma_R^2).
    OpenCV's calls name no unit either: the solver's unit of length is the spread of the given translations.
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
