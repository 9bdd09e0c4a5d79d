"""How many rows and columns a lattice of points has that perspective has bent: neighbour by neighbour."""

from __future__ import annotations

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
    best: tuple[int, int] | None = None
    if len(points) < 4:
        return None
    middle = np.argsort(np.linalg.norm(points - np.median(points, axis=0), axis=1))
    for start in middle[np.unique(np.linspace(0, len(points) - 1, STARTS).astype(int))]:
        cells = _grown(points, sizes, int(start))
        if cells is None:
            continue
        at = np.array(list(cells))
        size = at.max(axis=0) - at.min(axis=0) + 1
        columns, rows = int(size[0]), int(size[1])
        if columns * rows == len(cells) and (best is None or columns * rows > best[0] * best[1]):
            best = columns, rows
    return best


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
