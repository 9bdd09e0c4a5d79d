"""Random rotations, directions and poses, as the simulators draw them."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike
from rwhec_factors.se3 import pose
from scipy.spatial.transform import Rotation

from gtsam_rwhec.geometry.poses import Array


def rotations_of_vectors(vectors_rad: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of axis times angle (..., 3), radians."""
    return Rotation.from_rotvec(np.asarray(vectors_rad, dtype=np.float64)).as_matrix()


def rotations_of_quaternions(quaternions_wxyz: Array) -> Array:
    """Rotation matrices (N, 3, 3) of quaternions (N, 4), scalar first, of any length but zero."""
    return Rotation.from_quat(quaternions_wxyz, scalar_first=True).as_matrix()


def random_directions(count: int, generator: Generator) -> Array:
    """Unit vectors (N, 3), uniform on the sphere."""
    directions = generator.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions


def random_poses(count: int, extent_m: float, generator: Generator) -> Array:
    """Poses (N, 4, 4): rotation uniform on SO(3), translation uniform in the cube of half-width extent_m."""
    rotations = rotations_of_quaternions(generator.standard_normal((count, 4)))
    return pose(rotations, generator.uniform(-extent_m, extent_m, (count, 3)))
