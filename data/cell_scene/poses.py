"""Poses as (4, 4) matrices, made without the library that is to find them again."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

FloatArray = NDArray[np.float64]

#: Standard deviations of the robot's reported poses about and along each axis of its hand.
ROBOT_NOISE_DEG, ROBOT_NOISE_M = 0.02, 0.0002


def pose(rotation_deg: tuple[float, float, float], t_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> FloatArray:
    """(4, 4) of a rotation vector in degrees and a translation."""
    return poses(np.radians([rotation_deg]), np.array([t_m]))[0]


def poses(rotations_rad: ArrayLike, t_m: ArrayLike) -> FloatArray:
    """(N, 4, 4) of rotation vectors (N, 3) and translations (N, 3)."""
    rotations_rad = np.asarray(rotations_rad, dtype=np.float64)
    T = np.tile(np.eye(4), (len(rotations_rad), 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(rotations_rad).as_matrix()
    T[:, :3, 3] = t_m
    return T


def with_robot_noise(T: FloatArray, generator: np.random.Generator) -> FloatArray:
    """(N, 4, 4) poses of the hand as a robot reports them: each turned and moved a little in the hand's own frame."""
    turns = generator.normal(0.0, np.radians(ROBOT_NOISE_DEG), (len(T), 3))
    moves = generator.normal(0.0, ROBOT_NOISE_M, (len(T), 3))
    return T @ poses(turns, moves)
