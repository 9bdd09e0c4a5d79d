"""Clouds made ready for registration: thinned to one spacing, with normals, edges and trees."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from gtsam_rwhec.clouds.cloud import Cloud
from gtsam_rwhec.files.optional_packages import extra_named
from gtsam_rwhec.geometry.poses import Array

with extra_named():
    import small_gicp

#: A view is thinned to about this many points: registrations gain little beyond, and cost as they are many.
POINTS = 3000
#: The spacing is found on about this many points of a view.
SAMPLED = 20_000
#: Thinning to less than so many times the spacing of the points themselves makes holes.
THINNED = 1.5
#: Edges are looked for among points that are closer to each other by this factor.
FINER = 2.5
#: Points from which a normal is made, and those around a point that may be on an edge.
NEIGHBOURS, AROUND = 15, 12
#: A view with fewer points after thinning tells no pose.
FEWEST_POINTS = 50
#: A point is on an edge if its neighbours leave such an angle free, rad, around its normal.
FREE_ANGLE = np.radians(110.0)
#: Where the normal and the ray differ by more than 60 degrees, a surface ends for the eye alone: that edge wanders with the sensor.
FACING = 0.5


@dataclass(frozen=True)
class Features:
    """Points (n, 3) with unit normals (n, 3) across which each is known, in the sensor's frame; metres."""

    points: Array
    normals: Array
    tree: cKDTree


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


@dataclass(frozen=True)
class Spacing:
    """Distances of neighbouring points to which views are thinned, m: for faces, and for edges (0: not thinned)."""

    faces_m: float
    edges_m: float


def spacing_of(clouds: Iterable[Array]) -> Spacing:
    """The spacing at which clouds (n, 3) keep about ``POINTS`` points each, or their own if it is larger."""
    own, faces = [], []
    for points in clouds:
        few = points[:: max(1, len(points) // SAMPLED)]
        own.append(float(np.median(cKDTree(points).query(few, 2)[0][:, 1])))
        spacing = THINNED * own[-1]
        # Points on a surface are as many as its area has squares.
        for _ in range(3):
            count = len(small_gicp.voxelgrid_sampling(few, spacing).points())
            spacing *= max(1.0, np.sqrt(count / POINTS))
        faces.append(spacing)
    wide = float(np.median(faces))
    return Spacing(wide, wide / FINER if wide / FINER > THINNED * np.median(own) else 0.0)


def surface_of(cloud: Cloud, name: str, spacing: Spacing) -> Surface:
    """A view thinned to a spacing."""
    native, tree = small_gicp.preprocess_points(cloud.points, spacing.faces_m, NEIGHBOURS)
    points = native.points()[:, :3]
    faces = Features(points, native.normals()[:, :3], cKDTree(points))
    return Surface(name, faces, _edges(cloud.points, spacing.edges_m, faces), native, tree)


def _edges(points: Array, spacing_m: float, faces: Features) -> Features:
    """Where a surface ends that faces the sensor; normals point outwards, in the surface."""
    fine = small_gicp.PointCloud(points)
    if spacing_m > 0.0:
        fine = small_gicp.voxelgrid_sampling(fine, spacing_m)
    points = fine.points()[:, :3]
    normals = faces.normals[faces.tree.query(points)[1]]
    neighbours = np.asarray(small_gicp.KdTree(fine).batch_knn_search(points, AROUND + 1)[0], dtype=np.int64)[:, 1:]
    to = points[neighbours] - points[:, None]
    first = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    second = np.cross(normals, first)
    x, y = np.einsum("nki,ni->nk", to, first), np.einsum("nki,ni->nk", to, second)
    angles = np.sort(np.arctan2(y, x), axis=1)
    gaps = np.diff(angles, axis=1, append=angles[:, :1] + 2.0 * np.pi)
    facing = np.abs(np.einsum("ni,ni->n", normals, points)) > FACING * np.linalg.norm(points, axis=1)
    at = np.flatnonzero((gaps.max(axis=1) > FREE_ANGLE) & facing)
    inwards = x.mean(axis=1)[at, None] * first[at] + y.mean(axis=1)[at, None] * second[at]
    outwards = -inwards / np.maximum(np.linalg.norm(inwards, axis=1, keepdims=True), 1e-12)
    return Features(points[at], outwards, cKDTree(points[at]))
