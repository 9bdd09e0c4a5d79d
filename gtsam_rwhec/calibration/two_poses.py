"""Frames that were at two poses: their residuals fall into two groups, each of which agrees with itself.

Where nearly half of the measurements were taken after a target or a sensor has moved, the best fit lies between both
poses and leaves nothing out, since each half is as far off as the other. In the moved frame's own axes its residuals
are then two points with noise about them, which no noise, drift or smooth error makes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3
from scipy.spatial import cKDTree

from gtsam_rwhec.fitting.noise_rows import stations
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem

#: Two groups lie apart by this many times their own spread. (2,000 simulations each of white noise, random walks, walks
#: with noise, Student's t with 2 degrees of freedom and smooth errors, 20 to 160 measurements: 1 of 30,000 was.)
APART = 8.0
#: Neighbours among the carriers' poses are in the same group with this share, where the groups come with the poses.
SAME_GROUP = 0.9
#: Each group has at least this share of the measurements, and there are so many.
SMALLEST_GROUP, FEWEST = 0.25, 20


@dataclass(frozen=True)
class TwoPoses:
    """A frame whose measurements fall into two groups; ``str()`` is a sentence's part.

    Attributes
    ----------
    frame : str
    first, second : int
        How many measurements each group has.
    angle_rad, distance_m : float
        How far apart the two poses of the frame are.
    from_row : int or None
        The first measurement of the second group among those of its pair, counted from one, where the frame is in one
        pair and one group follows the other; else None.
    is_sensor : bool
        Whether it is a sensor: then its mount gave way.
    """

    frame: str
    first: int
    second: int
    angle_rad: float
    distance_m: float
    from_row: int | None
    is_sensor: bool = False

    def __str__(self) -> str:
        when = "" if self.from_row is None else f" from measurement {self.from_row} on"
        apart = f"{np.degrees(self.angle_rad):.2g} degrees and {1e3 * self.distance_m:.3g} mm apart"
        moved = "its mount is loose or it was knocked" if self.is_sensor else "it was moved"
        return (
            f"{self.frame} was at two poses{when}: its measurements fall into groups of {self.first} and "
            f"{self.second}, {apart}, and each group agrees with itself ({moved}, or it was seen in two ways)"
        )


def two_poses(problem: Problem, refined: Refined, inliers: Mapping[Pair, np.ndarray]) -> TwoPoses | None:
    """The frame of an answer that was at two poses, the one whose groups are farthest apart; None where none was.

    What moved makes two groups of whatever it is seen with, so no other frame is named beside it.

    Parameters
    ----------
    problem : Problem
    refined : Refined
        The answer from the ``inliers``, by pair (N,) booleans; empty: from all measurements.
    """
    if not problem.has_measurements:
        return None
    in_frame: dict[str, list[_Stations]] = {}
    for pair in problem.pairs:
        raw = problem.measurements(*pair)
        kept = inliers.get(pair, np.ones(len(raw.A), dtype=bool))
        for name, twists in zip(pair, residual_twists(refined, pair, raw.A[kept], raw.B[kept]), strict=True):
            in_frame.setdefault(name, []).append(_Stations.of(twists, raw.A[kept], np.flatnonzero(kept)))
    found = [_groups(name, parts, is_sensor=name in refined.Y) for name, parts in in_frame.items()]
    apart, groups = max(found, key=lambda one: one[0], default=(0.0, None))
    return groups if apart > APART else None


def residual_twists(refined: Refined, pair: Pair, A: Array, B: Array) -> tuple[Array, Array]:
    """Residuals (N, 6) of some measurements, in the target's axes and in the sensor's; lengths are true ones."""
    X, Y = refined.X.get(pair.target), refined.Y.get(pair.sensor)
    if X is None or Y is None or not len(A):
        return np.zeros((0, 6)), np.zeros((0, 6))
    scale = refined.scale[pair.target] if isinstance(refined.scale, Mapping) else refined.scale
    measured = B.copy()
    measured[:, :3, 3] /= scale
    predicted = se3.inverse(Y.matrix()) @ A @ X.matrix()
    return se3.logmap(se3.inverse(measured) @ predicted), se3.logmap(measured @ se3.inverse(predicted))


def by_station(A: Array) -> tuple[np.ndarray, Array]:
    """The station (N,) of each pose, and a pose (S, 12) of each station: many visits of one are one error of an arm."""
    rows = A[:, :3].reshape(-1, 12)
    station = stations(rows) if len(rows) else np.zeros(0, dtype=np.int64)
    return station, rows[np.unique(station, return_index=True)[1]]


def means_of(twists: Array, station: np.ndarray) -> Array:
    """The mean residual (S, 6) at each station."""
    if not len(twists):
        return twists
    visits = np.bincount(station)
    return np.stack([np.bincount(station, column) / visits for column in twists.T], axis=1)


@dataclass(frozen=True)
class _Stations:
    """Of one pair: the mean residual (S, 6), a pose (S, 12), the number of visits and the first row of each station."""

    twists: Array
    A: Array
    visits: np.ndarray
    rows: np.ndarray

    @staticmethod
    def of(twists: Array, A: Array, rows: np.ndarray) -> _Stations:
        station, poses = by_station(A)
        first = np.unique(station, return_index=True)[1]
        count = len(first) if len(twists) else 0
        return _Stations(
            means_of(twists, station), poses[:count], np.bincount(station, minlength=count)[:count], rows[first][:count]
        )


def _groups(name: str, parts: list[_Stations], *, is_sensor: bool) -> tuple[float, TwoPoses | None]:
    """How far apart the best two groups of the residuals of a frame's pairs are, in their own spread, and the groups.

    Groups that come with the carriers' poses, and not one after the other in time, are an arm's error, or views of a
    board.
    """
    twists, A = np.concatenate([part.twists for part in parts]), np.concatenate([part.A for part in parts])
    visits = np.concatenate([part.visits for part in parts])
    n = len(twists)
    if n < FEWEST:
        return 0.0, None
    away = twists - twists.mean(axis=0)
    size = np.repeat(np.sqrt((away.reshape(n, 2, 3) ** 2).mean(axis=(0, 2))), 3)
    if not (size > 0.0).all():
        return 0.0, None
    along = away / size @ np.linalg.svd(away / size, full_matrices=False)[2][0]
    order = np.argsort(along)
    ordered, k = along[order], np.arange(1, n)
    sums, squares = np.cumsum(ordered), np.cumsum(ordered**2)
    low, high = sums[:-1] / k, (sums[-1] - sums[:-1]) / (n - k)
    within = np.maximum(squares[-1] - k * low**2 - (n - k) * high**2, 1e-12) / (n - 2)
    apart = np.where(np.minimum(k, n - k) >= SMALLEST_GROUP * n, (high - low) / np.sqrt(within), 0.0)
    best = int(np.argmax(apart))
    is_high = np.zeros(n, dtype=bool)
    is_high[order[best + 1 :]] = True
    if is_high[0]:
        is_high = ~is_high  # the first group is that of the first measurement
    step = twists[is_high].mean(axis=0) - twists[~is_high].mean(axis=0)
    changes = np.flatnonzero(np.diff(is_high))
    if len(changes) > 1 and (is_high[np.asarray(cKDTree(A).query(A, k=2)[1])[:, 1]] == is_high).mean() > SAME_GROUP:
        return 0.0, None
    groups = TwoPoses(
        frame=name,
        first=int(visits[~is_high].sum()),
        second=int(visits[is_high].sum()),
        angle_rad=float(np.linalg.norm(step[:3])),
        distance_m=float(np.linalg.norm(step[3:])),
        from_row=int(parts[0].rows[changes[0] + 1]) + 1 if len(changes) == 1 and len(parts) == 1 else None,
        is_sensor=is_sensor,
    )
    return float(apart[best]), groups
