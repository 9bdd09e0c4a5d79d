"""Sizes of lattices in perspective, among other points, with a larger dot, and where none is whole."""

from __future__ import annotations

import numpy as np
import pytest

from gtsam_rwhec.rig.guessed_boards import asymmetric_size, lattice_size


def lattice(columns: int, rows: int, tilt: float = 0.0) -> np.ndarray:
    x, y = np.meshgrid(np.arange(columns, dtype=float), np.arange(rows, dtype=float))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    depth = 1.0 + tilt * (points[:, :1] + 0.5 * points[:, 1:]) / columns
    turn = np.array([[0.9, -0.4], [0.4, 0.9]])
    return 100.0 + 40.0 * points @ turn.T / depth


@pytest.mark.parametrize(("columns", "rows", "tilt"), [(10, 10, 0.0), (10, 10, 0.8), (7, 4, 1.0), (3, 9, 0.3)])
def test_rows_and_columns(columns: int, rows: int, tilt: float) -> None:
    points = lattice(columns, rows, tilt)
    sizes = np.full(len(points), 10.0)
    sizes[0] = 16.0
    noise = np.random.default_rng(1)
    far = noise.uniform(900, 1200, size=(6, 2))
    found = lattice_size(np.concatenate([points, far]), np.concatenate([sizes, np.full(6, 10.0)]))
    assert found is not None
    assert sorted(found) == sorted((columns, rows))


def test_no_whole_lattice() -> None:
    noise = np.random.default_rng(2)
    assert lattice_size(np.zeros((0, 2)), np.zeros(0)) is None
    found = lattice_size(noise.uniform(0, 300, size=(40, 2)), np.full(40, 5.0))
    assert found is None or min(found) < 3
    points = np.delete(lattice(6, 5), 7, axis=0)  # one is missing
    assert lattice_size(points, np.full(len(points), 5.0)) is None


@pytest.mark.parametrize(("columns", "rows", "tilt"), [(4, 11, 0.0), (4, 11, 0.5), (5, 7, 0.3)])
def test_rows_that_are_shifted_in_turn(columns: int, rows: int, tilt: float) -> None:
    points = np.array([(2 * x + y % 2, y) for y in range(rows) for x in range(columns)], dtype=float)
    depth = 1.0 + tilt * (points[:, :1] + 0.5 * points[:, 1:]) / (2 * columns)
    points = 100.0 + 30.0 * points @ np.array([[0.9, -0.4], [0.4, 0.9]]) / depth
    assert asymmetric_size(points, np.full(len(points), 9.0)) == (columns, rows)
    assert lattice_size(points, np.full(len(points), 9.0)) is None
    square = lattice(6, 5)
    assert asymmetric_size(square, np.full(len(square), 9.0)) is None
