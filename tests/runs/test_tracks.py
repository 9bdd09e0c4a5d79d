"""Which target of the rig file a driver's detection is of."""

from __future__ import annotations

import numpy as np
import pytest

from gtsam_rwhec.cameras.targets import Bundle, BundleTag, Tag
from gtsam_rwhec.errors import FrameError
from gtsam_rwhec.logs import DetectionRecord
from gtsam_rwhec.runs.measured_pairs import target_of

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
BOX = Bundle("box", "tag36h11", tuple(BundleTag(i, 0.05, (0.1 * i, 0.0, 0.0), UPRIGHT) for i in (7, 8, 10)))
TARGETS = (Tag("near", "tag36h11", 3, 0.1), Tag("far", "aruco_4x4_50", 3, 0.1), Tag("lid", "tag36h11", 4, 0.1), BOX)


def seen(family: str, id_: str) -> DetectionRecord:
    return DetectionRecord(1, 1, "/tags", "cam", family, id_, T_camera_tag=np.eye(4))


@pytest.mark.parametrize(
    ("family", "id_", "name"),
    [
        ("tag36h11", "3", "near"),
        ("aruco_4x4_50", "3", "far"),
        ("", "4", "lid"),
        ("", "box", "box"),
        ("", "10,7,8", "box"),  # apriltag_ros names a bundle by its tags
        ("", "7,8", None),
        ("", "7", None),
        ("tag36h11", "5", None),
    ],
)
def test_the_target_of_a_detection(family: str, id_: str, name: str | None) -> None:
    found = target_of(seen(family, id_), TARGETS)
    assert (None if found is None else found.name) == name


def test_an_id_of_two_families_is_refused_without_a_family() -> None:
    with pytest.raises(FrameError, match="could be near or far"):
        target_of(seen("", "3"), TARGETS)
