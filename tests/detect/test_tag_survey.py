"""The survey finds every tag of every family in an image, and counts each place once."""

from __future__ import annotations

from rendered import PINHOLE, pose, printed, render

from gtsam_rwhec.cameras.targets import AprilGrid, Tag
from gtsam_rwhec.detect.tags import tags_in_image


def test_tags_of_every_family_are_found_once_at_each_place() -> None:
    scene = [
        (Tag("a", "tag36h11", 3, 0.05), pose((0.0, 0.0, 0.0), (-0.12, -0.08, 0.4))),
        (Tag("b", "tag25h9", 5, 0.05), pose((0.0, 0.0, 0.0), (0.0, -0.08, 0.4))),
        (Tag("c", "aruco_5x5_1000", 700, 0.05), pose((0.0, 0.0, 0.0), (0.12, -0.08, 0.4))),
        (Tag("d", "aruco_6x6_50", 1, 0.05), pose((0.0, 0.0, 0.0), (-0.12, 0.08, 0.4))),
        (AprilGrid("e", "tag36h11", 1, 1, 0.05, 0.3, first_id=40), pose((0.0, 0.0, 0.0), (0.08, 0.07, 0.35))),
    ]  # fmt: skip
    image = render(PINHOLE, [(printed(target), T) for target, T in scene], blur_px=0.9)
    assert sorted((tag.family, tag.id, tag.is_double) for tag in tags_in_image(image)) == [
        ("aruco_5x5_1000", 700, False), ("aruco_6x6_1000", 1, False), ("tag25h9", 5, False), ("tag36h11", 3, False),
        ("tag36h11", 40, True),
    ]  # fmt: skip
    assert tags_in_image(render(PINHOLE, [])) == []
