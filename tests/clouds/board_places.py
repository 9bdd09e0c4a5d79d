"""Real places of a board before a camera and a LiDAR, as other people measured them; tests and benchmarks use them.

The file (`data/vlp` of acfr/cam_lidar_calibration) has 19 rows a place: the board's middle in the camera (mm), its
normal and its four corners; the same in the LiDAR; angles, sizes and other figures. The corners of the two go round in
opposite directions, and either normal may point either way.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rwhec_factors.se3 import pose

import gtsam_rwhec as rw
from gtsam_rwhec.geometry.poses import Array

SIZE_M = (0.61, 0.85)
#: Standard deviations of a place, of camera and LiDAR together, roughly: calibrate finds their size.
SIGMA = np.r_[np.radians([1.0, 1.0, 1.0]), 0.008, 0.008, 0.006]


def places_of(path: Path) -> tuple[Array, Array]:
    """T_camera_board and T_lidar_board (N, 4, 4), metres."""
    rows = np.loadtxt(path, delimiter=",").reshape(-1, 19, 3)
    camera, lidar = (np.array([_board(place[first : first + 6]) for place in rows]) for first in (0, 6))
    return camera, lidar


def _board(given: Array) -> Array:
    """A board's pose from its middle (mm), normal and four corners (mm): x along the shorter side."""
    middle, normal, corners = 1e-3 * given[0], given[1] / np.linalg.norm(given[1]), 1e-3 * given[2:]
    normal = -np.sign(normal @ middle) * normal
    sides = np.roll(corners, -1, axis=0) - corners
    lengths = np.linalg.norm(sides, axis=1)
    first = 0 if lengths[0] + lengths[2] < lengths[1] + lengths[3] else 1
    x = sides[first] / lengths[first] - sides[first + 2] / lengths[first + 2]
    x -= (x @ normal) * normal
    x /= np.linalg.norm(x)
    return pose(np.stack([x, np.cross(normal, x), normal], axis=1), middle)


def halves_of(A: Array, B: Array, which: np.ndarray) -> rw.Calibration:
    """The calibration of some places; where the chessboard is on the board is known to a centimetre."""
    covariances = np.tile(np.diag(SIGMA**2), (len(which), 1, 1))
    problem = rw.clouds.lidar_and_camera(A[which], B[which], SIZE_M, covariances, placed_m=0.01, placed_rad=0.01)
    return rw.calibrate(problem)
