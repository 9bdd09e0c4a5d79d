"""Regions with a board's saddles are found; pictures without a board have none."""

from __future__ import annotations

import numpy as np
import pytest
from rendered import PINHOLE, pose, printed, projected, render

from gtsam_rwhec.cameras.targets import Checkerboard, Tag
from gtsam_rwhec.detect.saddle_lattices import groups_of, saddles, scaled_down

CHESS = Checkerboard("chess", 5, 4, 0.03)


@pytest.mark.parametrize("turn", [0.0, 45.0, 100.0])
def test_a_boards_corners_are_saddles(turn: float) -> None:
    T = pose((20.0, -15.0, turn), (0.0, 0.0, 0.3))
    image = render(PINHOLE, [(printed(CHESS), T)])
    there = projected(PINHOLE, CHESS.corners(), T)
    found = saddles(image)
    off = np.linalg.norm(found.places[:, None] - there, axis=2)
    assert (off.min(axis=0) < 0.5).all()
    right, down = (projected(PINHOLE, CHESS.corners() + step, T) - there for step in 1e-4 * np.eye(3)[:2])
    for k, nearest in enumerate(off.argmin(axis=0)):
        axes = np.stack([right[k], down[k]]) / np.linalg.norm([right[k], down[k]], axis=1)[:, None]
        along = np.abs(found.edges[nearest] @ axes.T)
        assert along.max(axis=1).min() > 0.95
        x, y = found.places[nearest] + 5.0 * found.light[nearest]
        assert image[round(y), round(x)] > 128
    assert len(groups_of(found.places, 20)[0]) >= 20


def test_tags_noise_and_plain_walls_are_no_regions() -> None:
    plain = render(PINHOLE, [], noise=4.0)
    tag = render(PINHOLE, [(printed(Tag("tag", "tag36h11", 7, 0.1)), pose((10.0, 10.0, 0.0), (0.0, 0.0, 0.4)))])
    for image in (plain, tag):
        assert groups_of(saddles(scaled_down(image, 1)).places, 20) == []


def test_two_boards_are_two_regions() -> None:
    scene = [(printed(Checkerboard("c", 5, 4, 0.012)), pose((0.0, 0.0, 0.0), (x, 0.0, 0.3))) for x in (-0.08, 0.08)]
    assert len(groups_of(saddles(scaled_down(render(PINHOLE, scene, blur_px=0.5), 1)).places, 20)) == 2
