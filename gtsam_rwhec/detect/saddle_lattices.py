"""Corners of checkerboards as saddles of the gray values, put in order: lattices that grow from corner to corner.

On a ring around a checkerboard's corner dark and light alternate twice. The two flat directions of the saddle are the
edges, and its light side alternates from corner to corner. So a neighbour is known by three signs: the direction, the
distance of the corners so far, and the light side.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.geometry.poses import Array

#: Gray values are blurred by this standard deviation (pixels of the level) before they are differentiated.
SIGMA_PX = 1.0
#: A saddle's curvature along its two axes (gray values a pixel^2) is at least this. Noise of 4 of 255 stays below.
LEAST_CURVATURE = 1.5
#: The ring around a saddle has this radius (pixels of the level) and this number of samples, a multiple of 4.
RING_PX, RING = 3.0, 16
#: Opposite samples of a ring may differ by at most this share of what quarters differ by.
UNLIKE = 0.6
#: A level has at most this number of saddles, the strongest.
MOST = 600
#: Two saddles are of one group if they are closer than this many times the distance to their third nearest neighbour.
NEAR = 1.8
#: A group may be a board if it has at least this share of the board's corners.
SHARE = 0.6
#: Images are halved this often before saddles are looked for: sharp corners first, blurred ones in what is smaller.
LEVELS = (1, 2)
#: At most this number of groups of saddles are looked at.
MOST_GROUPS = 3


@dataclass(frozen=True, eq=False)
class Saddles:
    """n saddles of an image, the strongest first."""

    places: Array  #: (n, 2): pixels, right to some tenths
    edges: Array  #: (n, 2, 2): unit vectors along the two edges that cross
    light: Array  #: (n, 2): A unit vector towards a light side


def scaled_down(gray: Gray, level: int) -> Gray:
    """An image that is halved `level` times, or while there is something to halve."""
    small = np.asarray(gray)
    for _ in range(level):
        if min(small.shape) < 2:
            break
        small = np.asarray(cv2.resize(small, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return small


def groups_of(places: Array, corners: int) -> list[np.ndarray]:
    """The members of groups of saddles (n, 2) that may show a board of this number of corners, the likeliest first.

    A group of about as many saddles as the board has corners is likelier than a larger one, which may be any clutter.
    """
    large = [members for members in _groups(places) if len(members) >= SHARE * corners]
    return sorted(large, key=lambda members: abs(float(np.log(len(members) / corners))))[:MOST_GROUPS]


def saddles(gray: Gray) -> Saddles:
    """An image's saddles with rings that alternate."""
    edge = int(np.ceil(RING_PX)) + 1
    if min(gray.shape) <= 2 * edge:
        return Saddles(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros((0, 2)))
    smooth = cv2.GaussianBlur(gray, (0, 0), SIGMA_PX).astype(np.float32)
    xx = cv2.filter2D(smooth, -1, np.array([[1.0, -2.0, 1.0]], np.float32))
    yy = cv2.filter2D(smooth, -1, np.array([[1.0], [-2.0], [1.0]], np.float32))
    xy = cv2.filter2D(smooth, -1, 0.25 * np.array([[1.0, 0.0, -1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 1.0]], np.float32))
    strength = xy * xy - xx * yy
    peak = (strength >= LEAST_CURVATURE**2) & (strength >= cv2.dilate(strength, np.ones((5, 5), np.uint8)))
    rows, columns = np.nonzero(peak[edge:-edge, edge:-edge])
    rows, columns = rows + edge, columns + edge
    order = np.argsort(-strength[rows, columns], kind="stable")[: 4 * MOST]
    rows, columns = rows[order], columns[order]
    angle = 2.0 * np.pi * np.arange(RING) / RING
    dx, dy = (np.rint(RING_PX * turned(angle)).astype(int) for turned in (np.cos, np.sin))
    ring = smooth[rows[:, None] + dy, columns[:, None] + dx]
    ring -= ring.mean(axis=1, keepdims=True)
    changes = (np.sign(ring) != np.sign(np.roll(ring, 1, axis=1))).sum(axis=1)
    opposite = np.abs(ring - np.roll(ring, RING // 2, axis=1)).mean(axis=1)
    quarter = np.abs(ring - np.roll(ring, RING // 4, axis=1)).mean(axis=1)
    good = np.flatnonzero((changes == 4) & (opposite < UNLIKE * quarter))[:MOST]
    rows, columns = rows[good], columns[good]
    hessian = np.array([[xx[rows, columns], xy[rows, columns]], [xy[rows, columns], yy[rows, columns]]], dtype=float)
    hessian = np.moveaxis(hessian, -1, 0)
    right, down = (
        smooth[rows, columns + 1] - smooth[rows, columns - 1],
        smooth[rows + 1, columns] - smooth[rows - 1, columns],
    )
    flat_at = -np.linalg.solve(hessian, 0.5 * np.stack([right, down], axis=-1).astype(float)[..., None])[..., 0]
    curvature, axes = np.linalg.eigh(hessian)  # the larger one last: gray values rise along it
    open_by = np.arctan2(np.sqrt(np.maximum(curvature[:, 1], 0.0)), np.sqrt(np.maximum(-curvature[:, 0], 1e-12)))
    light = axes[:, :, 1]
    middle = np.arctan2(light[:, 1], light[:, 0])
    turned_by = middle[:, None] + np.stack([open_by, -open_by], axis=-1)
    return Saddles(
        np.stack([columns, rows], axis=1) + np.clip(flat_at, -1.0, 1.0),
        np.stack([np.cos(turned_by), np.sin(turned_by)], axis=-1),
        light,
    )


def _groups(places: Array) -> list[np.ndarray]:
    """Indices of the members of each group of places (n, 2) that are as near to each other as their neighbours are."""
    if len(places) < 4:
        return []
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    third = np.sort(apart, axis=1)[:, 3]
    linked = apart <= NEAR * np.minimum(third[:, None], third)
    count, group = connected_components(csr_array(linked), directed=False)
    return [np.flatnonzero(group == number) for number in range(count)]


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
