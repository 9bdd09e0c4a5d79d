"""Time offsets by whole rotations, along the carriers' path or its inverse."""

from __future__ import annotations

import numpy as np
import synthetic_logs as made

from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.runs.clocks_by_turning import offset_of_either_direction


def test_an_offset_along_the_inverse_path_is_taken_only_where_it_fits_far_better() -> None:
    """A path that is right gives its own offset, also where detections are so noisy that the other one is tried."""
    generator = np.random.default_rng(3)
    t = np.arange(0.0, 12.0, 0.02)
    stamps = made.BEGIN_NS + np.round(1e9 * t).astype(np.int64)
    path = Trajectory.of(stamps, np.linalg.inv([made.hand(each) for each in t]))
    own = np.arange(0.5, 11.0, 0.1)
    for noise_deg in (0.1, 3.0):
        B = np.array([np.linalg.inv(made.hand(each + 0.1) @ made.Y["cam_0"]) @ made.X["tag_0"] for each in own])
        turned = np.array([made.pose(each, (0, 0, 0)) for each in noise_deg * generator.normal(size=(len(own), 3))])
        tracks = [(made.BEGIN_NS + np.round(1e9 * own).astype(np.int64), B @ turned)]
        found = offset_of_either_direction(path, tracks, 0.2, "cam_0")
        assert abs(found.offset_s - 0.1) < max(5.0 * found.sigma_s, 1e-3)
