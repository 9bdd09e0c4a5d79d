"""Clouds made ready for registration: thinned to one spacing, with normals, edges and trees."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from gtsam_rwhec.clouds.cloud import Cloud
from gtsam_rwhec.files.optional_packages import extra_named
from gtsam_rwhec.geometry.poses import Array

with extra_named():
    import small_gicp

#: A view is thinned to about this many points, or less if views are many: all views have about this many points.
#: Registrations gain little beyond, and cost as they are many.
POINTS, FEW_POINTS, ALL_POINTS = 3000, 1000, 60_000
#: Of denser clouds every so-manieth point is taken, so that about this many are left to thin.
DENSE = 60_000
#: Points beyond so many times the median are left out.
REACH = 100.0
#: The spacing is found on about this many points of a view.
SAMPLED = 20_000
#: Thinning to less than so many times the spacing of the points themselves makes holes.
THINNED = 1.5
#: Edges are looked for among points that are closer to each other by this factor.
FINER = 2.0
#: Points from which a normal is made, and those around a point that may be on an edge.
NEIGHBOURS, AROUND = 15, 12
#: Ranges are smoothed among so many rays where their noise is more than this share of the spacing: what noise moves a
#: registration by grows with its square, and was 3 mm for 3 mm of noise and 2.5 mm of spacing.
RAYS, NOISY = 9, 0.1
#: Rays whose ranges are no plane by this many deviations look across an edge, and stay.
ON_A_PLANE = 1.5
#: Directions in which rays differ by less than the root of this, beside the others, give no slope.
FLAT = 1e-3
#: Rays by which the noise of a cloud is told.
PROBES = 2000
#: A view with fewer points after thinning tells no pose.
FEWEST_POINTS = 50
#: A point is on an edge if its neighbours leave such an angle free, rad, around its normal.
FREE_ANGLE = np.radians(110.0)
#: And the mean of their offsets is at least this share of the farthest.
LOPSIDED = 0.15
#: Where the normal and the ray differ by more than 60 degrees, a surface ends for the eye alone: that edge wanders
#: with the sensor.
FACING = 0.5
#: Neighbours of an edge by which its direction is smoothed, if they differ from it by less than 37 degrees.
BESIDE_EDGE, ALONG = 7, 0.8
#: Where a surface ends is told by so many points around an edge, in a strip of this half width and depth (shares of how
#: far they reach); by fewer, an edge stays where it is.
BESIDE, FEWEST_BESIDE, WIDTH, DEPTH = 60, 12, 0.4, 0.8
#: Points that are off by more deviations are of another surface; and a deviation is this share of the reach at least.
OFF, LEAST_NOISE = 3.0, 0.01


@dataclass(frozen=True)
class Features:
    """Points (n, 3) with unit normals (n, 3) across which each is known, in the sensor's frame; metres."""

    points: Array
    normals: Array

    @cached_property
    def _tree(self) -> Any:
        return tree_of(self.points)

    @cached_property
    def _ends(self) -> tuple[Array, Array]:
        return self.points.min(axis=0), self.points.max(axis=0)

    def nearest(self, points: Array, gate_m: float = np.inf) -> tuple[Array, np.ndarray]:
        """Distances (m,) of points (m, 3) to the nearest here, infinite beyond the gate, and the places of these."""
        distances, places = np.full(len(points), np.inf), np.zeros(len(points), dtype=np.int64)
        if len(self.points):
            # What is far from all is slow to search.
            low, high = self._ends
            at = np.flatnonzero(((points > low - gate_m) & (points < high + gate_m)).all(axis=1))
            found, its = neighbours_in(self._tree, points[at], 1)
            distances[at], places[at] = np.where(found < gate_m, found, np.inf)[:, 0], its[:, 0]
        return distances, places


def tree_of(points: Array) -> Any:
    """The tree of points (n, 3), n > 0, in which `neighbours_in` searches: in less than half of scipy's time."""
    return small_gicp.KdTree(small_gicp.PointCloud(points))


def neighbours_in(tree: Any, points: Array, count: int) -> tuple[Array, np.ndarray]:
    """Distances (m, count) of points (m, 3) to their neighbours in a tree, the nearest first, and their places."""
    places, squares = tree.batch_knn_search(points, count)
    return np.sqrt(squares), np.asarray(places, dtype=np.int64)


@dataclass(frozen=True)
class Surface:
    """A thinned view: its ``faces`` (points across their surface) and ``edges`` (points across the surface's end).

    ``name`` is for messages; ``native`` is what `small_gicp.align` takes, and ``native_tree`` its tree.
    """

    name: str
    faces: Features
    edges: Features
    native: Any
    native_tree: Any

    @property
    def size_m(self) -> float:
        """Root mean square distance of the points from their centre."""
        return float(np.sqrt(self.faces.points.var(axis=0).sum()))


def size_of(surfaces: Iterable[Surface]) -> float:
    """The size of a thing, m: the median over its views."""
    return float(np.median([each.size_m for each in surfaces]))


@dataclass(frozen=True)
class Spacing:
    """Distances of neighbouring points to which views are thinned, m: for faces, and for edges (0: not thinned).

    ``noise_m`` is the standard deviation of a point along its ray.
    """

    faces_m: float
    edges_m: float
    noise_m: float

    @property
    def is_noisy(self) -> bool:
        """Whether ranges are smoothed before views are thinned."""
        return self.noise_m > NOISY * self.faces_m

    @property
    def left_m(self) -> float:
        """The noise of a point along its ray after that."""
        return self.noise_m / np.sqrt(RAYS) if self.is_noisy else self.noise_m


def spacing_of(clouds: Iterable[Array], views: int) -> Spacing:
    """The spacing at which clouds (n, 3) keep as many points as they need, or their own if it is larger.

    ``clouds`` are some of the ``views``.
    """
    own, faces, noise = [], [], []
    wanted = min(POINTS, max(FEW_POINTS, ALL_POINTS // views))
    for every in clouds:
        points = reachable(every)
        few = points[:: max(1, len(points) // SAMPLED)]
        points = points[:: max(1, len(points) // DENSE)]
        own.append(float(np.median(neighbours_in(tree_of(points), few, 2)[0][:, 1])))
        noise.append(float(np.median(_along_rays(points, np.linspace(0, len(points) - 1, PROBES).astype(int))[1])))
        spacing = THINNED * own[-1]
        for _ in range(10):
            count = len(small_gicp.voxelgrid_sampling(few, spacing).points())
            if count < 1.05 * wanted:
                break
            spacing *= np.sqrt(count / wanted)  # points on a surface are as many as its area has squares
        faces.append(spacing)
    wide = float(np.median(faces))
    edges = wide / FINER if wide / FINER > THINNED * np.median(own) else 0.0
    return Spacing(wide, edges, float(np.median(noise)))


def surface_of(cloud: Cloud, name: str, spacing: Spacing) -> Surface:
    """A view thinned to a spacing."""
    given = reachable(cloud.points[:: max(1, len(cloud) // DENSE)])
    if spacing.is_noisy:
        smooth, off_m = _along_rays(given, np.arange(len(given)))
        given = np.where((off_m < ON_A_PLANE * np.median(off_m))[:, None], smooth, given)
    native, tree = small_gicp.preprocess_points(given, spacing.faces_m, NEIGHBOURS)
    points = native.points()[:, :3]
    faces = Features(points, native.normals()[:, :3])
    return Surface(name, faces, _edges(given, spacing.edges_m, faces), native, tree)


def reachable(points: Array) -> Array:
    """Without points that are far beyond all others: they are none of a thing, and no grid has room for them."""
    away = np.abs(points.T, order="C").max(axis=0)
    reachable: Array = points[away < REACH * np.median(away)]
    return reachable


def _along_rays(points: Array, at: np.ndarray) -> tuple[Array, Array]:
    """The points at places (m,) with the range that a plane through those of `RAYS` rays has, (m, 3), and the deviation
    (m,) of ranges from these planes, m."""
    lengths = np.linalg.norm(points, axis=1)
    rays = points / lengths[:, None]
    near = neighbours_in(tree_of(rays), rays[at], min(RAYS, len(points)))[1]
    # Differences of rays lie across the ray, so one slope of three is none, and rays of a scanned line leave one.
    slopes = rays[near] - rays[at, None]
    slopes /= np.linalg.norm(slopes, axis=2).max(axis=1)[:, None, None] + np.finfo(float).tiny
    rows = np.concatenate([np.ones((*near.shape, 1)), slopes], axis=2)
    off = lengths[near] - lengths[at, None]
    right = np.einsum("nki,nk->ni", rows, off)
    normal = rows.transpose(0, 2, 1) @ rows + FLAT * np.eye(4)
    plane = np.linalg.solve(normal, right[..., None])[..., 0]
    squares = ((off - np.einsum("nki,ni->nk", rows, plane)) ** 2).sum(axis=1)
    smooth = rays[at] * (lengths[at] + plane[:, 0])[:, None]
    return smooth, np.sqrt(squares / max(near.shape[1] - 3, 1))


def _edges(points: Array, spacing_m: float, faces: Features) -> Features:
    """Where a surface ends that faces the sensor; normals point outwards, in the surface."""
    fine = small_gicp.PointCloud(points)
    if spacing_m > 0.0:
        fine = small_gicp.voxelgrid_sampling(fine, spacing_m)
    # Components come first, and `take` takes: numpy is several times quicker so.
    of_all = fine.points()[:, :3].T
    near = np.ascontiguousarray(neighbours_in(small_gicp.KdTree(fine), of_all.T, AROUND + 1)[1].T[1:])
    # Around a point within a surface its neighbours' offsets sum to little.
    lop = np.linalg.norm(of_all.take(near, axis=1).mean(axis=1) - of_all, axis=0)
    at = np.flatnonzero(lop > LOPSIDED * np.linalg.norm(of_all.take(near[-1], axis=1) - of_all, axis=0))
    ends = of_all.take(at, axis=1)
    to = of_all.take(near.take(at, axis=1), axis=1) - ends[:, None]
    normals = faces.normals.T.take(faces.nearest(ends.T)[1], axis=1)
    first = np.cross(normals, np.eye(3).take(np.abs(normals).argmin(axis=0), axis=1), axis=0)
    first /= np.maximum(np.linalg.norm(first, axis=0), 1e-12)
    second = np.cross(normals, first, axis=0)
    x, y = (np.einsum("ikn,in->kn", to, axis) for axis in (first, second))
    angles = np.sort(np.arctan2(y, x), axis=0)
    gaps = np.diff(angles, axis=0, append=angles[:1] + 2.0 * np.pi)
    facing = np.abs((normals * ends).sum(axis=0)) > FACING * np.linalg.norm(ends, axis=0)
    on = (gaps.max(axis=0) > FREE_ANGLE) & facing
    outwards = (-x.mean(axis=0) * first - y.mean(axis=0) * second)[:, on]
    outwards /= np.maximum(np.linalg.norm(outwards, axis=0), 1e-12)
    ends, normals = ends[:, on].T, normals[:, on].T
    outwards = _smoothed(ends, outwards.T)
    return Features(_ends(points, ends, normals, outwards), outwards)


def _smoothed(points: Array, outwards: Array) -> Array:
    """Directions (n, 3) of edges as their neighbours have them: a wrong one sees the end of a surface farther out."""
    if len(points) < BESIDE_EDGE:
        return outwards
    near = neighbours_in(tree_of(points), points, BESIDE_EDGE)[1]
    for _ in range(2):
        same = np.einsum("nki,ni->nk", outwards[near], outwards) > ALONG
        outwards = np.einsum("nk,nki->ni", same, outwards[near])
        outwards /= np.maximum(np.linalg.norm(outwards, axis=1, keepdims=True), 1e-12)
    return outwards


def _ends(dense: Array, points: Array, normals: Array, outwards: Array) -> Array:
    """Edges (n, 3), each moved along ``outwards`` to where the points (N, 3) of its surface end.

    Thinned points are means and lie inside, by half of a point and more, and so does the last point of a surface: m
    points that are spread evenly over a depth reach m / (m + 1) of it.
    """
    if not len(points):
        return points
    distances, near = neighbours_in(tree_of(dense), points, min(BESIDE, len(dense)))
    to, reach = dense.T.take(near.T, axis=1) - points.T[:, None], distances[:, -1]
    depth, aside, height = (
        np.einsum("ikn,ni->kn", to, axes) for axes in (outwards, np.cross(normals, outwards), normals)
    )
    strip = (np.abs(aside) < WIDTH * reach) & (depth > -DEPTH * reach)
    inner = strip & (depth < 0.0)
    inner |= ~inner.any(axis=0)
    height -= _medians(height, inner)
    noise = 1.4826 * _medians(np.abs(height), inner)
    of_surface = strip & (np.abs(height) < OFF * np.maximum(noise, LEAST_NOISE * reach))
    count = of_surface.sum(axis=0)
    last = np.where(of_surface, depth, -DEPTH * reach).max(axis=0)
    end = last + (last + DEPTH * reach) / np.maximum(count - 1, 1)
    return np.asarray(points + np.where(count < FEWEST_BESIDE, 0.0, end)[:, None] * outwards)


def _medians(values: Array, of: np.ndarray) -> Array:
    """The medians (n,) of those values (k, n) that count, at least one of each column: `np.nanmedian` is slow."""
    ordered, count = np.sort(np.where(of, values, np.inf), axis=0), of.sum(axis=0)
    middle = np.take_along_axis(ordered, np.stack([(count - 1) // 2, count // 2]), axis=0)
    return np.asarray(middle.mean(axis=0))


def without_border(surfaces: Sequence[Surface], spacing_m: float) -> list[Surface]:
    """The same without edges where the sensor's view ends, in the rectangle of what all views see in a camera's image.

    There a surface ends for the sensor alone, at the same place of each view. A sensor that sees behind itself (z < 0)
    has no such rectangle.
    """
    if any((each.faces.points[:, 2] <= 0.0).any() for each in surfaces):
        return list(surfaces)
    image = [each.faces.points[:, :2] / each.faces.points[:, 2:] for each in surfaces]
    low, high = (
        np.min([each.min(axis=0) for each in image], axis=0),
        np.max([each.max(axis=0) for each in image], axis=0),
    )
    result = []
    for each in surfaces:
        points = each.edges.points
        inside = np.minimum(points[:, :2] / points[:, 2:] - low, high - points[:, :2] / points[:, 2:]).min(axis=1)
        kept = inside * points[:, 2] > spacing_m
        result.append(replace(each, edges=Features(points[kept], each.edges.normals[kept])))
    return result
