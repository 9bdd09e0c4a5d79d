"""Saddles of boards are put in order whatever is missing and whatever lies beside them."""

from __future__ import annotations

import numpy as np
import pytest
from rendered import PINHOLE, pose, printed, projected, render

from gtsam_rwhec.cameras.targets import Checkerboard, Tag
from gtsam_rwhec.detect.saddle_lattices import Saddles, boards_in, groups_of, lattices, saddles, scaled_down

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


def grids(found: Saddles, rows: int = 4, columns: int = 5) -> list[np.ndarray]:
    members = np.arange(len(found.places))
    return [
        grid
        for lattice in lattices(found, members, rows * columns)
        for grid, _ in boards_in(lattice, found.places, rows, columns)
    ]


def off(grid: np.ndarray, T: np.ndarray) -> float:
    """The largest distance to the truth, whichever way the grid is turned or mirrored."""
    there = projected(PINHOLE, CHESS.corners(), T).reshape(4, 5, 2)
    ways = (there, there[::-1], there[:, ::-1], there[::-1, ::-1])
    return min(float(np.abs(grid - way).max()) for way in ways)


@pytest.mark.parametrize("turn", [0.0, 45.0, 100.0])
def test_a_boards_corners_come_in_order(turn: float) -> None:
    T = pose((35.0, -25.0, turn), (0.0, 0.0, 0.3))
    found = saddles(render(PINHOLE, [(printed(CHESS), T)]))
    assert off(grids(found)[0], T) < 1.0


def test_corners_that_are_missing_are_filled_in_and_others_left_out() -> None:
    T = pose((20.0, -15.0, 30.0), (0.0, 0.0, 0.3))
    found = saddles(render(PINHOLE, [(printed(CHESS), T)]))
    generator = np.random.default_rng(0)
    kept = generator.permutation(len(found.places))[3:]
    stray = generator.uniform((0, 0), (320, 240), (30, 2))
    turned = generator.normal(size=(3, 30, 2))
    turned /= np.linalg.norm(turned, axis=2, keepdims=True)
    mixed = Saddles(
        np.concatenate([found.places[kept], stray]),
        np.concatenate([found.edges[kept], turned[:2].swapaxes(0, 1)]),
        np.concatenate([found.light[kept], turned[2]]),
    )
    assert min(off(grid, T) for grid in grids(mixed)) < 2.0


def test_a_larger_board_has_several_parts_and_a_smaller_one_none() -> None:
    T = pose((5.0, 5.0, 5.0), (0.0, 0.0, 0.3))
    larger = saddles(render(PINHOLE, [(printed(Checkerboard("larger", 7, 4, 0.025)), T)]))
    assert len(grids(larger)) >= 3
    (lattice,) = lattices(larger, np.arange(len(larger.places)), 20)
    assert all(goes_on for _, goes_on in boards_in(lattice, larger.places, 4, 5))
    assert not any(goes_on for _, goes_on in list(boards_in(lattice, larger.places, 4, 7))[:1])
    smaller = saddles(render(PINHOLE, [(printed(Checkerboard("smaller", 4, 3, 0.03)), T)]))
    assert grids(smaller) == []


def test_two_boards_are_two_lattices() -> None:
    places = (-0.08, 0.08)
    scene = [(printed(Checkerboard("c", 5, 4, 0.014)), pose((0.0, 0.0, 10.0), (x, 0.0, 0.3))) for x in places]
    found = saddles(render(PINHOLE, scene, blur_px=0.5))
    assert [len(lattice.members) for lattice in lattices(found, np.arange(len(found.places)), 20)] == [20, 20]
