"""Random rotations, directions and poses, as the simulators draw them."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike
from rwhec_factors.se3 import pose
from scipy.spatial.transform import Rotation

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import to_rotations


def rotations_of_vectors(vectors_rad: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of axis times angle (..., 3), radians."""
    return Rotation.from_rotvec(np.asarray(vectors_rad, dtype=np.float64)).as_matrix()


def random_directions(count: int, generator: Generator) -> Array:
    """Unit vectors (N, 3), uniform on the sphere."""
    directions = generator.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions


def random_poses(count: int, extent_m: float, generator: Generator) -> Array:
    """Poses (N, 4, 4): rotation uniform on SO(3), translation uniform in the cube of half-width extent_m."""
    rotations = to_rotations(generator.standard_normal((count, 4))[:, [1, 2, 3, 0]])  # drawn as wxyz
    return pose(rotations, generator.uniform(-extent_m, extent_m, (count, 3)))
