"""Sizes of lattices in perspective, among other circles, with a larger dot, and where none is whole."""

from __future__ import annotations

import numpy as np
import pytest

from gtsam_rwhec.detect.circle_lattices import NONE, Ellipses
from gtsam_rwhec.rig.guessed_boards import lattice_size, rectangle, shifted_rows


def seen(points: np.ndarray, tilt: float = 0.0) -> np.ndarray:
    depth = 1.0 + tilt * (points[:, :1] + 0.5 * points[:, 1:]) / np.ptp(points[:, 0])
    return 100.0 + 40.0 * points @ np.array([[0.9, 0.4], [-0.4, 0.9]]) / depth


def circles(points: np.ndarray, tilt: float = 0.0, radius: float = 0.25) -> Ellipses:
    """Circles of a plane in perspective."""
    corners = [(seen(points + step, tilt) - seen(points - step, tilt)) / 2e-3 for step in 1e-3 * np.eye(2)]
    J = radius * np.stack(corners, axis=2)
    return Ellipses(seen(points, tilt), J @ J.transpose(0, 2, 1))


def lattice(columns: int, rows: int) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(columns, dtype=float), np.arange(rows)), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize(("columns", "rows", "tilt"), [(10, 10, 0.0), (10, 10, 0.8), (7, 4, 1.0), (3, 9, 0.3)])
def test_rows_and_columns(columns: int, rows: int, tilt: float) -> None:
    of_board = circles(lattice(columns, rows), tilt)
    of_board.shapes[0] *= 1.6**2
    far = np.random.default_rng(1).uniform(900, 1200, size=(6, 2))
    others = Ellipses(far, np.tile(25.0 * np.eye(2), (6, 1, 1)))
    found = lattice_size(of_board.with_more(others), rectangle)
    assert found is not None
    assert sorted(found) == sorted((columns, rows))


def test_no_whole_lattice() -> None:
    assert lattice_size(NONE, rectangle) is None
    points = np.random.default_rng(2).uniform(0, 10, size=(40, 2))
    found = lattice_size(circles(points), rectangle)
    assert found is None or min(found) < 3
    assert lattice_size(circles(np.delete(lattice(6, 5), 7, axis=0)), rectangle) is None  # one is missing


@pytest.mark.parametrize(("columns", "rows", "tilt"), [(4, 11, 0.0), (4, 11, 0.5), (5, 7, 0.3)])
def test_rows_that_are_shifted_in_turn(columns: int, rows: int, tilt: float) -> None:
    points = np.array([(2 * x + y % 2, y) for y in range(rows) for x in range(columns)], dtype=float)
    assert lattice_size(circles(points, tilt), shifted_rows) == (columns, rows)
    assert lattice_size(circles(points, tilt), rectangle) is None
    assert lattice_size(circles(lattice(6, 5)), shifted_rows) is None
