"""How many rows and columns a lattice of points has that perspective has bent: neighbour by neighbour."""

from __future__ import annotations

from collections.abc import Callable
from itertools import permutations

import numpy as np

from gtsam_rwhec.geometry.poses import Array

#: A neighbour is off its predicted place by at most this share of the step to it.
NEAR = 0.25
#: A neighbour's size is this share of the point's own at least, and at most one over it: larger dots belong to it.
ALIKE = 0.4
#: Points from which lattices are grown, spread over all.
STARTS = 12
#: Steps of neighbours, along the lattice.
STEPS = ((1, 0), (-1, 0), (0, 1), (0, -1))


def lattice_size(points: Array, sizes: Array) -> tuple[int, int] | None:
    """The numbers of points along the two axes of the largest lattice that is whole; None where there is none.

    Parameters
    ----------
    points : (n, 2) array
    sizes : (n,) array
        What neighbours have about equal: diameters of blobs.
    """
    return _largest(points, sizes, _rectangle)


def asymmetric_size(points: Array, sizes: Array) -> tuple[int, int] | None:
    """Points in a row, and rows, of the largest whole lattice whose every other row is shifted by half a step."""
    return _largest(points, sizes, _shifted_rows)


def _largest(points: Array, sizes: Array, shape: Callable[[Array], tuple[int, int] | None]) -> tuple[int, int] | None:
    best: tuple[int, int] | None = None
    if len(points) < 4:
        return None
    middle = np.argsort(np.linalg.norm(points - np.median(points, axis=0), axis=1))
    for start in middle[np.unique(np.linspace(0, len(points) - 1, STARTS).astype(int))]:
        cells = _grown(points, sizes, int(start))
        size = None if cells is None else shape(np.array(list(cells)))
        if size is not None and (best is None or size[0] * size[1] > best[0] * best[1]):
            best = size
    return best


def _rectangle(cells: Array) -> tuple[int, int] | None:
    """The sides of a rectangle that these cells (n, 2) fill."""
    columns, rows = (int(side) for side in np.ptp(cells, axis=0) + 1)
    return (columns, rows) if columns * rows == len(cells) else None


def _shifted_rows(cells: Array) -> tuple[int, int] | None:
    """Points in a row, and rows, if these cells (n, 2) are rows that are shifted in turn.

    The two steps of the lattice may be any two of those between neighbours, in half steps along a row and in rows.
    """
    for first, second in permutations(((1, 1), (1, -1), (2, 0), (0, 2)), 2):
        x, row = (cells @ np.array([first, second])).T
        x, row = x - x.min(), row - row.min()
        starts = np.array([x[row == r].min(initial=99) for r in range(row.max() + 1)])
        counts = np.bincount(row)
        ends = np.array([x[row == r].max(initial=-99) for r in range(row.max() + 1)])
        if (
            (counts == counts[0]).all()
            and (ends - starts == 2 * (counts - 1)).all()
            and len(starts) > 1
            and (np.abs(np.diff(starts)) == 1).all()
            and starts.max() == 1
        ):
            return int(counts[0]), len(counts)
    return None


def _grown(points: Array, sizes: Array, start: int) -> dict[tuple[int, int], int] | None:
    """The lattice that grows from a point: which point is in which cell."""
    away = points - points[start]
    apart = np.linalg.norm(away, axis=1)
    ratio = sizes / sizes[start]
    apart[(ratio < ALIKE) | (ratio > 1.0 / ALIKE)] = np.inf
    apart[start] = np.inf
    nearest = np.argsort(apart)[:8]
    first = away[nearest[0]]
    if not np.isfinite(apart[nearest[0]]):
        return None
    sines = np.abs(first[0] * away[nearest, 1] - first[1] * away[nearest, 0]) / (
        np.linalg.norm(first) * np.maximum(apart[nearest], 1e-9)
    )
    across = nearest[np.isfinite(apart[nearest]) & (sines > 0.3)]
    if not len(across):
        return None
    second = away[across[0]]
    cells = {(0, 0): start}
    steps: dict[tuple[int, int], Array] = {(0, 0): np.array([first, second])}
    taken = {start}
    waiting = [(0, 0)]
    while waiting:
        cell = waiting.pop(0)
        here, basis = cells[cell], steps[cell]
        for i, j in STEPS:
            beside = cell[0] + i, cell[1] + j
            if beside in cells:
                continue
            step = i * basis[0] + j * basis[1]
            off = np.linalg.norm(points - points[here] - step, axis=1)
            which = int(np.argmin(off))
            ratio_there = sizes[which] / sizes[here]
            if which in taken or off[which] > NEAR * np.linalg.norm(step) or not ALIKE < ratio_there < 1.0 / ALIKE:
                continue
            cells[beside], taken = which, taken | {which}
            own = basis.copy()
            own[0 if i else 1] = (points[which] - points[here]) * (i or j)  # perspective bends the steps slowly
            steps[beside] = own
            waiting.append(beside)
    return cells
