"""Turns of a sensor and of its carrier."""

from __future__ import annotations

import numpy as np
from turning_tracks import Y, carrier, track

from gtsam_rwhec.geometry.time_offset import Turns, aligned
from gtsam_rwhec.geometry.trajectory import SmoothPath
from gtsam_rwhec.simulate.simulated_noise import random_poses


def test_the_best_rotation_of_vectors() -> None:
    R = random_poses(1, 1.0, np.random.default_rng(3))[0, :3, :3]
    b = np.random.default_rng(4).normal(size=(5, 3))
    np.testing.assert_allclose(aligned(b @ R.T, b, np.ones(5)), R, atol=1e-12)
    flat = b * np.r_[1.0, 0.0, 0.0]  # one axis leaves a turn about it free
    found = aligned(flat @ R.T, flat, np.ones(5))
    assert np.linalg.det(found) > 0.99
    np.testing.assert_allclose(flat @ found.T, flat @ R.T, atol=1e-12)


def test_differences_are_smallest_at_the_offset() -> None:
    path = carrier()
    smooth = SmoothPath.of(path)
    turns = Turns.of([track(0.1, 1, bad=0.2), track(0.1, 2)])
    at = {offset: turns.compared(path, smooth, offset, 0.2) for offset in (0.0, 0.1, 0.2)}
    assert at[0.1][0] < 0.5 * min(at[0.0][0], at[0.2][0])
    np.testing.assert_allclose(at[0.1][1], Y[:3, :3], atol=0.01)
    assert np.sqrt(2.0) * np.radians(0.4) < turns.noise_rad < np.sqrt(2.0) * np.radians(2.0)


def test_stamps_outside_the_path_are_not_known() -> None:
    path = carrier()
    cost, _, known = Turns.of([track(0.0)]).compared(path, SmoothPath.of(path), 1e4, 0.2)
    assert known == 0
    assert cost == np.inf
