"""Sizes of boards without tags, found out from rendered images; no size where there is no such board."""

from __future__ import annotations

import numpy as np
import pytest
from rendered import pose, printed, render

from gtsam_rwhec.cameras import Camera, Charuco, Checkerboard
from gtsam_rwhec.cameras.targets import CircleGrid, Target
from gtsam_rwhec.rig.guessed_boards import boards_seen

CAMERA = Camera.of(480, 360, "pinhole", [[500.0, 0, 240], [0, 500.0, 180], [0, 0, 1]], (), "a test")
POSES = [((10.0, -20.0, 8.0), (0.01, 0.0, 0.36)), ((-25.0, 15.0, -20.0), (0.0, 0.01, 0.4))]


def images(target: Target) -> list[np.ndarray]:
    return [render(CAMERA, [(printed(target), pose(*at))], seed=i) for i, at in enumerate(POSES)]


@pytest.mark.parametrize(
    ("target", "counts"),
    [
        (Checkerboard("board", 6, 8, 0.022), (8, 6)),
        (CircleGrid("grid", 7, 5, 0.03), (7, 5)),
        (CircleGrid("grid", 4, 9, 0.02, asymmetric=True), (4, 9)),
        (Charuco("board", "aruco_5x5_100", 7, 5, 0.04, 0.03), None),
    ],
    ids=["checkerboard", "circles", "asymmetric", "charuco"],
)
def test_the_board_and_nothing_else(target: Target, counts: tuple[int, int] | None) -> None:
    found = boards_seen(images(target))
    assert [seen.counts for seen in found] == ([] if counts is None else [counts])
    for seen in found:
        assert type(seen.board) is type(target)
        assert getattr(seen.board, "asymmetric", False) == getattr(target, "asymmetric", False)
        assert seen.images == (0, 1)
