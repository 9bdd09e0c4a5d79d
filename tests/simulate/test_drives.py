"""Drives have the shape that was asked for, and tracks the truth's motion."""

from __future__ import annotations

import numpy as np
import pytest
from rwhec_factors import se3

from gtsam_rwhec import simulate
from gtsam_rwhec.errors import OptionError


def test_a_planar_drive_stays_on_its_plane_and_tracks_follow_it() -> None:
    T = se3.expmap(np.array([[0.3, -0.2, 0.5, 1.0, 2.0, 3.0]]))[0]
    exact = simulate.SimulatedOdometry(T, 0.0, 0.0, scale=0.5, clock_offset_s=0.25, every=2)
    driven = simulate.drive({"camera": exact}, "planar", seconds=10.0, seed=3)
    np.testing.assert_allclose(driven.T_world_vehicle[:, 2], np.tile([0, 0, 1, 0], (101, 1)), atol=1e-12)
    stamps, track = driven.tracks["camera"]
    np.testing.assert_array_equal(stamps, driven.stamps_ns[::2] - 250_000_000)
    true = driven.T_world_vehicle[::2] @ T
    expected = se3.inverse(true[:1]) @ true
    expected[:, :3, 3] *= 0.5
    np.testing.assert_allclose(track, expected, atol=1e-10)
    np.testing.assert_allclose(driven.T("camera", "camera"), np.eye(4), atol=1e-15)


def test_a_straight_drive_does_not_turn() -> None:
    driven = simulate.drive({}, "straight", seconds=5.0)
    np.testing.assert_allclose(driven.T_world_vehicle[:, :3, :3], np.tile(np.eye(3), (51, 1, 1)))


def test_what_is_no_drive_is_refused() -> None:
    with pytest.raises(OptionError, match="shape is 'up'"):
        simulate.drive({}, "up")  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="must be positive"):
        simulate.drive({}, seconds=0.0)
