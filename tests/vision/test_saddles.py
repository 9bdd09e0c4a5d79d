"""Regions with a board's saddles are found; pictures without a board have none."""

from __future__ import annotations

import numpy as np
import pytest
from rendered import PINHOLE, pose, printed, projected, render

from gtsam_rwhec.vision.saddles import regions, saddles
from gtsam_rwhec.vision.targets import Checkerboard, Tag

CHESS = Checkerboard("chess", 5, 4, 0.03)


@pytest.mark.parametrize("turn", [0.0, 45.0, 100.0])
def test_a_boards_corners_are_saddles(turn: float) -> None:
    T = pose((20.0, -15.0, turn), (0.0, 0.0, 0.3))
    image = render(PINHOLE, [(printed(CHESS), T)])
    there = projected(PINHOLE, CHESS.corners(), T)
    off = np.linalg.norm(saddles(image)[:, None] - there, axis=2)
    assert (off.min(axis=0) < 2.0).all()
    ((rows, columns), *_) = regions(image, 20, 1)
    assert (there >= [columns.start, rows.start]).all()
    assert (there < [columns.stop, rows.stop]).all()


def test_tags_noise_and_plain_walls_are_no_regions() -> None:
    plain = render(PINHOLE, [], noise=4.0)
    tag = render(PINHOLE, [(printed(Tag("tag", "tag36h11", 7, 0.1)), pose((10.0, 10.0, 0.0), (0.0, 0.0, 0.4)))])
    for image in (plain, tag):
        assert regions(image, 20, 1) == []


def test_two_boards_are_two_regions() -> None:
    scene = [(printed(Checkerboard("c", 5, 4, 0.012)), pose((0.0, 0.0, 0.0), (x, 0.0, 0.3))) for x in (-0.08, 0.08)]
    assert len(regions(render(PINHOLE, scene, blur_px=0.5), 20, 1)) == 2
