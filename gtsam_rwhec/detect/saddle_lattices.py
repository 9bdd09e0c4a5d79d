"""Saddles put in order: lattices that grow from corner to corner along the edges on which the corners lie.

At a checkerboard's corner the gray values are a saddle whose two flat directions are the edges, and whose light side
alternates from corner to corner. So a neighbour is known by three signs: the direction, the distance of the corners so
far, and the light side.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.detect.saddles import LEVELS, Saddles, groups_of, saddles, scaled_down
from gtsam_rwhec.geometry.poses import Array

#: A first neighbour is at most this far beside an edge's direction (radians), and among this number of nearest saddles.
BESIDE_RAD, NEAREST = 0.35, 12
#: Corners are at least this far apart (pixels of the level).
LEAST_STEP_PX = 2.5
#: A saddle is at most this share of the smaller step from where the lattice goes on.
OFF = 0.3
#: A lattice has at least this share of a board's corners, and this number of them.
LEAST_SHARE, LEAST_SADDLES = 0.7, 8
#: A lattice is tried to start at this number of saddles of a group, and at most this number of boards are looked for.
STARTS, MOST_LATTICES = 8, 4
#: A start has as many neighbours as possible among this number of nearest saddles.
NEIGHBOURS = 6
#: A lattice of this share of a group's saddles is enough.
ENOUGH = 0.9
#: A board goes on if this share of a row of corners beyond it is there, and two of them.
GOES_ON = 0.4
#: Of a lattice that is larger than the board, at most this number of parts are tried.
MOST_PARTS = 4


@dataclass(frozen=True, eq=False)
class Lattice:
    """Saddles (n,) of a list, and their whole steps (n, 2) along both directions, from 0."""

    members: np.ndarray
    steps: np.ndarray


def lattices(among: Saddles, members: np.ndarray, corners: int) -> Iterator[Lattice]:
    """Lattices among some (m,) of the saddles, from those nearest to their middle on.

    One with as many saddles as a board has corners, or with nearly all there are, is not looked for again from another
    start.
    """
    free = members
    for _ in range(MOST_LATTICES):
        if len(free) < LEAST_SADDLES:
            return
        places = among.places[free]
        apart = np.linalg.norm(places[:, None] - places, axis=2)
        beside = _neighbours(places, among.edges[free], among.light[free], apart)
        from_middle = np.linalg.norm(places - np.median(places, axis=0), axis=1)
        starts = np.lexsort((from_middle, -beside))[:STARTS]
        best: dict[tuple[int, int], int] = {}
        for start in starts.tolist():
            best = max(best, _grown(among, free, apart, start), key=len)
            if len(best) >= min(corners, ENOUGH * len(free)):
                break
        if len(best) < LEAST_SADDLES:
            return
        chosen = np.array(list(best.values()))
        steps = np.array(list(best))
        yield Lattice(free[chosen], steps - steps.min(axis=0))
        free = np.delete(free, chosen)


def _neighbours(places: Array, edges: Array, light: Array, apart: Array) -> np.ndarray:
    """How many (m,) of the nearest saddles are along an edge of both, with their light on the other side."""
    nearest = np.argsort(apart, axis=1)[:, 1 : NEIGHBOURS + 1]
    along = places[nearest] - places[:, None]
    along /= np.maximum(np.linalg.norm(along, axis=2, keepdims=True), 1e-9)
    ok: np.ndarray = np.ones(nearest.shape, dtype=bool)
    sides = []
    for of_edges, of_light in ((edges[:, None], light[:, None]), (edges[nearest], light[nearest])):
        beside = np.abs(along[..., None, 0] * of_edges[..., 1] - along[..., None, 1] * of_edges[..., 0])
        ok &= beside.min(axis=-1) < np.sin(BESIDE_RAD)
        cross = along[..., 0] * of_light[..., 1] - along[..., 1] * of_light[..., 0]
        sides.append(cross * (along * of_light).sum(axis=-1))
    return np.asarray((ok & (sides[0] * sides[1] < 0.0)).sum(axis=1))


def _grown(among: Saddles, members: np.ndarray, apart: Array, start: int) -> dict[tuple[int, int], int]:
    """Places in `members` by their steps from `start`; empty where it has no neighbour along each of its edges."""
    places, edges = among.places[members], among.edges[members]
    light = among.light[members]
    nearest = np.argsort(apart[start])[: NEAREST + 1]
    nearest = nearest[apart[start][nearest] > LEAST_STEP_PX]
    first: list[Array] = []
    for along in edges[start]:
        away = places[nearest] - places[start]
        beside = np.abs(away[:, 0] * along[1] - away[:, 1] * along[0]) / np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        near = np.flatnonzero(beside < np.sin(BESIDE_RAD))
        if not len(near):
            return {}
        first.append(away[near[0]])
    if abs(first[0][0] * first[1][1] - first[0][1] * first[1][0]) < 0.1 * np.prod(np.linalg.norm(first, axis=1)):
        return {}
    found, taken = {(0, 0): start}, {start}
    # Plain numbers: a lattice has too few members for arrays to be faster.
    at, towards = places.tolist(), light.tolist()
    x, y = places.T
    waiting = deque([((0, 0), tuple(first[0].tolist()), tuple(first[1].tolist()))])
    colour = _colour(towards[start], waiting[0][1], waiting[0][2])
    while waiting:
        (i, j), a, b = waiting.popleft()
        here = at[found[i, j]]
        reach = OFF * abs(a[0] * b[1] - a[1] * b[0]) / max(np.hypot(*a), np.hypot(*b))
        for (di, dj), step in (((1, 0), a), ((-1, 0), (-a[0], -a[1])), ((0, 1), b), ((0, -1), (-b[0], -b[1]))):
            key = (i + di, j + dj)
            if key in found:
                continue
            squared = (x - (here[0] + step[0])) ** 2 + (y - (here[1] + step[1])) ** 2
            k = int(squared.argmin())
            if squared[k] > reach**2 or k in taken:
                continue
            if _colour(towards[k], a, b) * colour * (-1) ** (key[0] + key[1]) < 0.0:
                continue
            found[key] = k
            taken.add(k)
            sign = di + dj
            went = (sign * (at[k][0] - here[0]), sign * (at[k][1] - here[1]))
            waiting.append((key, went if di else a, went if dj else b))
    return found


def _colour(light: Sequence[float], a: Sequence[float], b: Sequence[float]) -> float:
    """Above 0 where the light side is between a and b or opposite, below 0 where it is between a and -b."""
    return (light[0] * b[1] - light[1] * b[0]) * (a[0] * light[1] - a[1] * light[0])


def boards_in(lattice: Lattice, places: Array, rows: int, columns: int) -> Iterator[tuple[Array, bool]]:
    """Grids (rows, columns, 2) of places that a lattice may show, and whether the lattice goes on beyond each.

    The fullest come first; a homography gives what lacks.
    """
    least = max(LEAST_SHARE * rows * columns, 5)
    size = lattice.steps.max(axis=0) + 1
    at = np.full(size + 4, -1)  # parts may reach a step beyond it, and are looked at a step beyond them
    at[lattice.steps[:, 0] + 2, lattice.steps[:, 1] + 2] = np.arange(len(lattice.members))
    parts = []
    for turned in (False, True) if rows != columns else (False,):
        shape = (columns, rows) if turned else (rows, columns)
        for i in range(1, at.shape[0] - shape[0]):
            for j in range(1, at.shape[1] - shape[1]):
                part = at[i : i + shape[0], j : j + shape[1]]
                count = int((part >= 0).sum())
                if count >= least:
                    beside = (at[k, j : j + shape[1]] for k in (i - 1, i + shape[0]))
                    above = (at[i : i + shape[0], k] for k in (j - 1, j + shape[1]))
                    goes_on = any((row >= 0).sum() >= max(2, GOES_ON * len(row)) for row in (*beside, *above))
                    parts.append((count, part.T if turned else part, goes_on))
    parts.sort(key=lambda one: (-one[0], one[2]))
    for _, part, goes_on in parts[:MOST_PARTS]:
        there = part >= 0
        steps = np.argwhere(there)[:, ::-1].astype(float)
        seen = places[lattice.members[part[there]]]
        H = cv2.findHomography(steps, seen, 0)[0]
        if H is None or not np.isfinite(H).all():
            continue
        everywhere = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).astype(float)
        grid = np.asarray(cv2.perspectiveTransform(everywhere.reshape(-1, 1, 2), H), dtype=float)
        grid = grid.reshape(rows, columns, 2)
        grid[there] = seen
        yield grid, goes_on


def lattice_sizes(gray: Gray) -> Iterator[tuple[int, int]]:
    """Counts of corners (one way, the other way) of the lattices in an image, which may be checkerboards of any size.

    Outer rows of which less than half is there do not count.
    """
    for level in LEVELS:
        seen = saddles(scaled_down(gray, level))
        for members in groups_of(seen.places, LEAST_SADDLES):
            for lattice in lattices(seen, members, len(members)):
                there = np.zeros(lattice.steps.max(axis=0) + 1, dtype=bool)
                there[tuple(lattice.steps.T)] = True
                for _ in range(4):  # each side in turn
                    while len(there) > 2 and there[0].mean() < 0.5:
                        there = there[1:]
                    there = np.rot90(there)
                yield len(there), len(there[0])
