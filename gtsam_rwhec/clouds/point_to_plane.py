"""What one surface tells of its pose to another: points across tangent planes, with the information that they have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.clouds.surfaces import Surface
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.directions import SLID

#: Normals of points that match differ by less than 37 degrees.
ALIKE = 0.95
#: Neighbours lie beside each other by less than this share of the gate.
ASIDE = 0.5
#: Cauchy's constant, in deviations: 95 % efficiency for Gaussian noise.
CAUCHY = 2.385
#: Residuals are this share of the gate at least: points without noise are off by how surfaces bend between them. With
#: less, points of flat places left no weight to those that tell a pose, and poses stayed where A's noise put them.
QUIET = 4e-3
#: What all points of faces, and of edges, are off by together, in their deviations. How far out an edge is seen depends
#: on how round it is, and how steep it is seen.
SHARED = (0.2, 0.5)
#: The same of one view among many.
SHARED_BY_VIEWS = (0.1, 0.5)
#: The same of groups of views that only edges link: one sees the end of a surface where the other sees a crease, and
#: all of their edges are off alike. In simulation it is a third of their deviations; real sensors do not see every end.
SHARED_BY_GROUPS = (0.1, 0.7)
#: Information of a direction counts if it is so many of its own deviations above zero.
SIGNIFICANT = 4.0
#: And if it is at least this share of the largest: surfaces are round or flat to no better, as sensors see them.
LEAST_SHARE = 1e-3
#: Points that are nearer to each other than this, m, are in one place.
ONE_PLACE = 1e-6
#: A direction slides if its deviation is more than this share of the thing's size: nothing of it was measured.
SLIDING_SHARE = 0.3
#: Ranges of a surface that is seen by more than 70 degrees from its normal are off: a real ball looked 0.35 % shorter
#: across the axis by them, and 0.1 % without.
STEEP = 0.34


@dataclass(frozen=True)
class Matches:
    """Points (m, 3) of a surface that lie on another, and how far off.

    ``residuals`` (m,) are distances across the mean of both normals, in metres: where a surface is curved, neighbours
    that lie beside each other are off the tangent plane of either, but not of this mean (Rusinkiewicz 2019, "A
    symmetric objective function for ICP"). ``rows`` (m, 6) are derivatives by a right perturbation of T_other_surface
    (rotation first) across the other's normals, ``own_rows`` across the surface's own. ``kind`` is 0 for faces and 1
    for edges; ``at`` are places among the surface's faces, then edges.
    """

    points: Array
    residuals: Array
    rows: Array
    own_rows: Array
    kind: np.ndarray
    at: np.ndarray
    #: The share of the surface's faces that match.
    overlap: float


def matches(surface: Surface, other: Surface, T_other_surface: Array, gate_m: float) -> Matches:
    """The points of a surface that have a neighbour on another within a gate, with a normal like its own."""
    R, t = T_other_surface[:3, :3], T_other_surface[:3, 3]
    found: list[_Arrays] = []
    first = 0
    for kind, (own, its) in enumerate(((surface.faces, other.faces), (surface.edges, other.edges))):
        moved = (R @ own.points.T + t[:, None]).T
        distances, nearest = its.nearest(moved, gate_m)
        at = np.flatnonzero(np.isfinite(distances))
        normals = R.T @ its.normals.T.take(nearest[at], axis=1)
        own_normals = own.normals.T.take(at, axis=1)
        cosine = (normals * own_normals).sum(axis=0)
        alike = cosine > ALIKE if kind else np.abs(cosine) > ALIKE
        own_normals *= np.sign(cosine)
        at, normals, own_normals = (each.compress(alike, axis=-1) for each in (at, normals, own_normals))
        apart = R.T @ (moved.T.take(at, axis=1) - its.points.T.take(nearest[at], axis=1))
        residuals = (0.5 * (normals + own_normals) * apart).sum(axis=0)
        # Farther aside than any neighbour within a surface: the point is beyond the end of the other.
        within = (apart * apart).sum(axis=0) - residuals**2 < (ASIDE * gate_m) ** 2
        at, residuals = at[within], residuals[within]
        points = own.points.T.take(at, axis=1)
        rows, own_rows = (across(points, each.compress(within, axis=1)) for each in (normals, own_normals))
        found.append((points, residuals, rows, own_rows, np.full(len(at), kind), first + at))
        first += len(own.points)
    return _of_arrays(found, len(found[0][1]) / len(surface.faces.points))


def across(points: Array, normals: Array) -> Array:
    """Derivatives (6, ...) of points (3, ...) across normals (3, ...) by a turn and a shift; `np.cross` is slower.

    Components come first: numpy is several times quicker where the longest dimension is the last.
    """
    (x, y, z), (a, b, c) = points, normals
    return np.stack([y * c - z * b, z * a - x * c, x * b - y * a, a, b, c])


def sigmas(several: Sequence[Matches], gate_m: float) -> Array:
    """Robust deviations (2,) of the residuals of faces and of edges over several pairs within a gate, m."""
    result = []
    for kind in range(2):
        residuals = np.concatenate([np.zeros(0), *(each.residuals[each.kind == kind] for each in several)])
        result.append(1.4826 * np.median(np.abs(residuals)) if len(residuals) else gate_m)
    return np.maximum(result, QUIET * gate_m)


def alike(sigma_m: float, noise_m: float) -> float:
    """What neighbouring points are off by together, m: residuals of two views beyond the noise along rays.

    The pattern of a sensor, or noise that neighbours share: no average over a surface takes it away.
    """
    return float(np.sqrt(max(0.5 * sigma_m**2 - noise_m**2, 0.0)))


def joined(several: Sequence[Matches]) -> Matches:
    """Matches of one surface with several others."""
    arrays = [(each.points.T, each.residuals, each.rows.T, each.own_rows.T, each.kind, each.at) for each in several]
    return _of_arrays(arrays, max(each.overlap for each in several))


#: The arrays of `Matches`, in its order; matches are the last dimension.
_Arrays: TypeAlias = tuple[Array, Array, Array, Array, np.ndarray, np.ndarray]


def _of_arrays(several: Sequence[_Arrays], overlap: float) -> Matches:
    points, residuals, rows, own_rows, kind, at = (np.concatenate(part, axis=-1) for part in zip(*several, strict=True))
    return Matches(points.T, residuals, rows.T, own_rows.T, kind, at, overlap)


@dataclass(frozen=True)
class Known:
    """What matches tell of T_other_surface by a right perturbation, rotation first; it adds a guess where they slide.

    ``information`` (6, 6) has nothing along what slides, ``covariance`` there a variance that says so. ``step`` (6,) is
    the perturbation that matches give, and ``of_guess`` (6, 6) the part of a guess that stays.
    """

    information: Array
    covariance: Array
    step: Array
    of_guess: Array


def units(points: Array) -> tuple[Array, float]:
    """The perturbation (6, 6) that a unit in each direction is, and the size of points (m, 3) in metres.

    About the points' centre, and with turns in units of their size, turns and shifts move points alike. Points in one
    place have no size, and count as one metre, beside which they tell nothing.
    """
    size = float(np.sqrt(points.T.var(axis=1).sum()))
    if size < ONE_PLACE:
        size = 1.0
    result = np.eye(6)
    result[:3, :3] /= size
    result[3:, :3] = se3.hat(points.mean(axis=0)) / size
    return result, size


def known(found: Matches, sigma_m: Array, counts: Array | float = 1.0, shared: tuple[float, float] = SHARED) -> Known:
    """What matches tell, with deviations (2,) of faces and edges.

    ``counts`` (m,) divide the weight of each match: a point that many views match is still one point. ``shared`` is
    what all points are off by together. Noise of normals
    looks like information where a surface slides, as rows are squared: so rows by one surface's normals are multiplied
    by those of the other's, whose noise is independent, and directions that are not significant count as nothing.
    """
    from_unit, size = units(found.points)
    to_unit = np.linalg.inv(from_unit)
    sigma = sigma_m[found.kind]
    weights = 1.0 / (counts * sigma**2 * (1.0 + (found.residuals / (CAUCHY * sigma)) ** 2))
    one, two = from_unit.T @ found.rows.T, from_unit.T @ found.own_rows.T
    gradient, certain = np.zeros(6), np.zeros((6, 6))
    for kind in range(2):
        mine = found.kind == kind
        a, b, w = one.compress(mine, axis=1), two.compress(mine, axis=1), weights[mine]
        values, vectors = np.linalg.eigh(_symmetric(a @ (b * w).T))
        spread = np.sqrt(((w * (vectors.T @ a) * (vectors.T @ b)) ** 2).sum(axis=1))
        kept = (values > SIGNIFICANT * spread) & (values > LEAST_SHARE * values.max())
        values, vectors = values[kept], vectors[:, kept]
        # All points of one kind share an error, so their information has a limit.
        limit = 1.0 / (1.0 + values * (shared[kind] * sigma_m[kind]) ** 2)
        certain += (vectors * values * limit) @ vectors.T
        gradient += (vectors * limit) @ (vectors.T @ (0.5 * (a + b) @ (w * found.residuals[mine])))
    values, vectors = np.linalg.eigh(_symmetric(certain))
    slides = values < 1.0 / (SLIDING_SHARE * size) ** 2
    certain = np.where(slides, 0.0, values)
    total = certain + 1.0 / size**2  # a guess is off by the size of the thing
    step = -vectors @ (vectors.T @ gradient / total)
    parts = (certain, 1.0 / total, 1.0 - certain / total)
    information, covariance, of_guess = ((vectors * each) @ vectors.T for each in parts)
    sliding = from_unit @ vectors[:, slides]
    sliding /= np.linalg.norm(sliding, axis=0)
    return Known(
        _symmetric(to_unit.T @ information @ to_unit),
        _symmetric(from_unit @ covariance @ from_unit.T + SLID * sliding @ sliding.T),
        from_unit @ step,
        from_unit @ of_guess @ to_unit,
    )


def told_of_stretch(found: Matches, T_other_surface: Array, sigma_m: Array) -> Array:
    """What faces tell of the share s by which both clouds are too long across their z axes, whatever their pose is.

    (3,): information and gradient of s, in m^2, and how many points tell it. As in `known`, rows by one surface's
    normals are multiplied by those of the other's.
    """
    facing = np.abs((found.own_rows.T[3:] * found.points.T).sum(axis=0))
    mine = (found.kind == 0) & (facing > STEEP * np.linalg.norm(found.points.T, axis=0))
    if not mine.any():
        return np.zeros(3)
    points, R, across_z = found.points.T.compress(mine, axis=1), T_other_surface[:3, :3], np.diag([1.0, 1.0, 0.0])
    longer = R.T @ across_z @ (R @ points + T_other_surface[:3, 3:]) - across_z @ points
    unit, _ = units(points.T)
    told = (each.T.compress(mine, axis=1) for each in (found.rows, found.own_rows))
    one, two = (np.vstack([unit.T @ rows, (rows[3:] * longer).sum(axis=0)]) for rows in told)
    weights = 1.0 / (1.0 + (found.residuals[mine] / (CAUCHY * sigma_m[0])) ** 2)
    gradient = 0.5 * (one + two) @ (weights * found.residuals[mine])
    information = _symmetric(one @ (two * weights).T)
    values, vectors = np.linalg.eigh(information[:6, :6])
    kept = values > LEAST_SHARE * values[-1]
    pose = np.r_[-(vectors[:, kept] / values[kept]) @ (vectors[:, kept].T @ information[:6, 6]), 1.0]
    return np.array([information[6] @ pose, gradient @ pose, mine.sum()])


def _symmetric(M: Array) -> Array:
    return np.asarray(0.5 * (M + M.T))
