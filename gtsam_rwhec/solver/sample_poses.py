"""Poses of many small samples of A X = Y B at once, in closed form.

Rotations are of Shah (2013), "Solving the robot-world/hand-eye calibration problem using the Kronecker product": the
sum of R_A (x) R_B takes vec R_X to n vec R_Y, so its first singular vectors, projected to SO(3), are R_Y and R_X. Then
least squares gives translations and scale: the solution of minimum norm where a sample leaves a direction free.
"""

from __future__ import annotations

import numpy as np
from rwhec_factors.se3 import pose, so3_nearest

from gtsam_rwhec.geometry.poses import Array

#: Singular values below this share of the largest are none.
NONE = 1e-6


def poses_of_samples(
    A: Array, B: Array, weight: Array | None = None, *, is_scaled: bool, scales: tuple[float, float] = (1e-9, 1e9)
) -> tuple[Array, Array, Array]:
    """X, Y (H, 4, 4) and scale (H,) of H samples of n measurements.

    Parameters
    ----------
    A, B : (H, n, 4, 4) arrays
        T_sensorcarrier_targetcarrier and T_sensor_target, metres.
    weight : (H, n) array, optional
        Of each measurement; 0 leaves it out.
    is_scaled : bool
        Whether lengths in B are true lengths times an unknown factor; else the scale is 1.
    scales : (float, float)
        What the scale may be. At a limit the translations are solved again: the scale is there where the motion does
        not determine it, since the carrier turns in place.
    """
    H, n = A.shape[:2]
    root = np.ones((H, n)) if weight is None else np.sqrt(weight)
    R_A, R_B, t_A = A[..., :3, :3], B[..., :3, :3], A[..., :3, 3]
    # R_Y = R_A R_X R_B': vec over rows, K[(i, j), (k, l)] = sum R_A[i, k] R_B[j, l]
    flat = (R_A * root[..., None, None] ** 2).reshape(H, n, 9)
    K = (np.swapaxes(flat, 1, 2) @ R_B.reshape(H, n, 9)).reshape(H, 3, 3, 3, 3).transpose(0, 1, 3, 2, 4)
    K = K.reshape(H, 9, 9)
    first = np.linalg.eigh(np.swapaxes(K, 1, 2) @ K)[1][:, :, -1:]  # of K's singular vectors; half the time of an SVD
    R_X, R_Y = _rotations(first.reshape(H, 3, 3)), _rotations((K @ first).reshape(H, 3, 3))
    seen = np.einsum("hij,hnj->hni", R_Y, B[..., :3, 3])
    columns = [R_A, np.broadcast_to(-np.eye(3), (H, n, 3, 3))]
    scale: Array = np.ones(H)
    if not is_scaled:
        solution = _least_squares(np.concatenate(columns, axis=3), seen - t_A, root)
    else:  # R_A t_X + t_A - t_Y = (1 / s) R_Y t_B
        rows = np.concatenate([*columns, -seen[..., None]], axis=3)
        solution = _least_squares(rows, -t_A, root)
        inverse = np.clip(solution[:, 6], 1.0 / scales[1], 1.0 / scales[0])
        at = inverse != solution[:, 6]
        if at.any():
            right = inverse[at, None, None] * seen[at] - t_A[at]
            solution[at, :6] = _least_squares(rows[at, ..., :6], right, root[at])
        scale = 1.0 / inverse
    return pose(R_X, solution[:, :3]), pose(R_Y, solution[:, 3:6]), scale


def _least_squares(rows: Array, right: Array, root: Array) -> Array:
    """(H, k) solutions of minimum norm of rows (H, n, 3, k) and right-hand sides (H, n, 3), weighted by root (H, n)."""
    H, n, _, k = rows.shape
    flat = (rows * root[..., None, None]).reshape(H, 3 * n, k)
    of_rows = np.swapaxes(flat, 1, 2)
    inverse = np.linalg.pinv(of_rows @ flat, rcond=NONE**2, hermitian=True)
    return np.asarray((inverse @ (of_rows @ (right * root[..., None]).reshape(H, 3 * n, 1)))[..., 0])


def _rotations(M: Array) -> Array:
    """The rotations nearest to matrices (H, 3, 3) of unknown sign; the sign is chosen so that det M > 0."""
    return so3_nearest(M * np.where(np.linalg.det(M) < 0.0, -1.0, 1.0)[:, None, None])
