"""A track's stamps and poses belong together."""

from __future__ import annotations

import numpy as np
import pytest

from gtsam_rwhec import odometry
from gtsam_rwhec.errors import CountError, StampError


def test_stamps_that_do_not_ascend_are_named() -> None:
    with pytest.raises(StampError, match=r"lidar goes back in time at row 2: 15 ns after 20 ns"):
        odometry.OdometryTrack("lidar", np.array([10, 20, 15]), np.tile(np.eye(4), (3, 1, 1)))


def test_one_pose_for_each_stamp() -> None:
    with pytest.raises(CountError, match="3 stamps and poses of shape"):
        odometry.OdometryTrack("lidar", np.array([10, 20, 30]), np.tile(np.eye(4), (2, 1, 1)))
