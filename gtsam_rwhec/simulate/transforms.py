"""Rigid transformations as (..., 4, 4) arrays, as the simulators need them."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

FloatArray = NDArray[np.float64]


def pose(R_a_b: ArrayLike, t_a_b: ArrayLike) -> FloatArray:
    """T_a_b of rotations (..., 3, 3) and translations (..., 3), whose leading dimensions are broadcast."""
    rotation = np.asarray(R_a_b, dtype=np.float64)
    translation = np.asarray(t_a_b, dtype=np.float64)
    T_a_b = np.zeros((*np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1]), 4, 4))
    T_a_b[..., :3, :3] = rotation
    T_a_b[..., :3, 3] = translation
    T_a_b[..., 3, 3] = 1.0
    return T_a_b


def inverse(T_a_b: FloatArray) -> FloatArray:
    """T_b_a of (..., 4, 4) poses T_a_b."""
    R_b_a = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    return pose(R_b_a, -(R_b_a @ T_a_b[..., :3, 3:])[..., 0])


def rotations_of_vectors(vectors_rad: ArrayLike) -> FloatArray:
    """Rotation matrices (..., 3, 3) of axis times angle (..., 3), radians."""
    rotations: FloatArray = Rotation.from_rotvec(np.asarray(vectors_rad, dtype=np.float64)).as_matrix()
    return rotations


def rotations_of_quaternions(quaternions_wxyz: FloatArray) -> FloatArray:
    """Rotation matrices (N, 3, 3) of quaternions (N, 4), scalar first, of any length but zero."""
    rotations: FloatArray = Rotation.from_quat(quaternions_wxyz[:, [1, 2, 3, 0]]).as_matrix()
    return rotations


def random_directions(count: int, generator: Generator) -> FloatArray:
    """(N, 3) unit vectors, uniform on the sphere."""
    directions = generator.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions


def random_poses(count: int, extent_m: float, generator: Generator) -> FloatArray:
    """(N, 4, 4) poses: rotation uniform on SO(3), translation uniform in the cube of half-width extent_m."""
    rotations = rotations_of_quaternions(generator.standard_normal((count, 4)))
    return pose(rotations, generator.uniform(-extent_m, extent_m, (count, 3)))
