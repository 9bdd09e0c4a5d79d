"""What one surface tells of its pose to another: points across tangent planes, with the information that they have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.clouds.surfaces import Surface
from gtsam_rwhec.geometry.poses import Array

#: Normals of points that match differ by less than 37 degrees.
ALIKE = 0.8
#: Cauchy's constant, in deviations: 95 % efficiency for Gaussian noise.
CAUCHY = 2.385
#: Information of a direction counts if it is so many of its own deviations above zero.
SIGNIFICANT = 4.0
#: And if it is at least this share of the largest: surfaces are round or flat to no better, as sensors see them.
LEAST_SHARE = 1e-3


@dataclass(frozen=True)
class Matches:
    """Points (m, 3) of a surface that lie on another, and how far off.

    ``residuals`` (m,) are distances from the other's tangent planes, in metres; ``rows`` (m, 6) their derivatives by a
    right perturbation of T_other_surface (rotation first), ``own_rows`` the same by the surface's own normals. ``kind``
    is 0 for faces and 1 for edges; ``at`` are places among the surface's faces, then edges.
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
    found, counts = [], []
    first = 0
    for kind, (own, its) in enumerate(((surface.faces, other.faces), (surface.edges, other.edges))):
        distances, nearest = its.tree.query(own.points @ R.T + t, distance_upper_bound=gate_m)
        at = np.flatnonzero(np.isfinite(distances))
        normals = its.normals[nearest[at]] @ R
        cosine = np.einsum("ij,ij->i", normals, own.normals[at])
        alike = cosine > ALIKE if kind else np.abs(cosine) > ALIKE
        at, normals, sign = at[alike], normals[alike], np.sign(cosine[alike])[:, None]
        points = own.points[at]
        residuals = np.einsum("ij,ij->i", normals, points - (its.points[nearest[at]] - t) @ R)
        rows = [np.hstack([np.cross(points, n), n]) for n in (normals, sign * own.normals[at])]
        found.append((points, residuals, *rows, np.full(len(at), kind), first + at))
        counts.append(len(at))
        first += len(own.points)
    return Matches(*(np.concatenate(part) for part in zip(*found, strict=True)), counts[0] / len(surface.faces.points))


def sigmas(several: Sequence[Matches], spacing_m: float) -> Array:
    """Robust deviations (2,) of the residuals of faces and of edges over several pairs, m."""
    result = []
    for kind in range(2):
        residuals = np.concatenate([np.zeros(0), *(each.residuals[each.kind == kind] for each in several)])
        result.append(1.4826 * np.median(np.abs(residuals)) if len(residuals) else spacing_m)
    return np.maximum(result, 1e-4 * spacing_m)


def joined(several: Sequence[Matches]) -> Matches:
    """Matches of one surface with several others."""
    names = ("points", "residuals", "rows", "own_rows", "kind", "at")
    return Matches(*(np.concatenate([getattr(each, name) for each in several]) for name in names), several[0].overlap)


@dataclass(frozen=True)
class Known:
    """What matches tell of T_other_surface by a right perturbation, rotation first; it adds a guess where they slide.

    ``information`` (6, 6) has nothing along what slides, ``covariance`` there the size of the thing. ``step`` (6,) is the
    perturbation that matches give, and ``of_guess`` (6, 6) the part of a guess that stays.
    """

    information: Array
    covariance: Array
    step: Array
    of_guess: Array


def units(points: Array) -> tuple[Array, float]:
    """The perturbation (6, 6) that a unit in each direction is, and the size of points (m, 3) in metres.

    About the points' centre, and with turns in units of their size, turns and shifts move points alike.
    """
    size = float(np.sqrt(points.var(axis=0).sum()))
    result = np.eye(6)
    result[:3, :3] /= size
    result[3:, :3] = se3.hat(points.mean(axis=0)) / size
    return result, size


def known(found: Matches, sigma_m: Array, counts: Array | float = 1.0) -> Known:
    """What matches tell, with deviations (2,) of faces and edges.

    ``counts`` (m,) divide the weight of each match: a point that many views match is still one point. Noise of normals
    looks like information where a surface slides, as rows are squared: so rows by one surface's normals are multiplied
    by those of the other's, whose noise is independent, and directions that are not significant count as nothing.
    """
    from_unit, size = units(found.points)
    to_unit = np.linalg.inv(from_unit)
    sigma = sigma_m[found.kind]
    weights = 1.0 / (counts * sigma**2 * (1.0 + (found.residuals / (CAUCHY * sigma)) ** 2))
    one, two = found.rows @ from_unit, found.own_rows @ from_unit
    gradient, certain = np.zeros(6), np.zeros((6, 6))
    for kind in range(2):
        mine = found.kind == kind
        a, b, w = one[mine], two[mine], weights[mine]
        values, vectors = np.linalg.eigh(_symmetric(a.T @ (b * w[:, None])))
        spread = np.sqrt(((w[:, None] * (a @ vectors) * (b @ vectors)) ** 2).sum(axis=0))
        kept = vectors[:, (values > SIGNIFICANT * spread) & (values > LEAST_SHARE * values.max())]
        certain += kept @ (kept.T @ (a.T @ (b * w[:, None])) @ kept) @ kept.T
        gradient += kept @ (kept.T @ (a.T @ (w * found.residuals[mine])))
    values, vectors = np.linalg.eigh(_symmetric(certain))
    certain = np.maximum(values, 0.0)
    total = certain + 1.0 / size**2  # a guess is off by the size of the thing
    step = -vectors @ (vectors.T @ gradient / total)
    information, covariance, of_guess = (
        (vectors * d) @ vectors.T for d in (certain, 1.0 / total, 1.0 - certain / total)
    )
    return Known(
        _symmetric(to_unit.T @ information @ to_unit),
        _symmetric(from_unit @ covariance @ from_unit.T),
        from_unit @ step,
        from_unit @ of_guess @ to_unit,
    )


def _symmetric(M: Array) -> Array:
    return np.asarray(0.5 * (M + M.T))
