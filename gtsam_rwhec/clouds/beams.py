"""The beams of a spinning LiDAR: which points each measured, where it looked, and pieces that stand before others."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from rwhec_factors.se3 import expmap
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gtsam_rwhec.clouds.cloud import Cloud
from gtsam_rwhec.errors import CloudError, OptionError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import real_array

#: Beams are apart by more than this angle, where the cloud does not number them; radians.
APART_RAD = float(np.radians(0.25))
#: More beams than this are not a LiDAR's of few beams: the elevations of the cloud are no lines.
MOST_BEAMS = 256
#: A beam has at least so many points, usually.
FEWEST_OF_BEAM = 20
#: A beam whose points are further than this from one elevation is none; radians.
STRAIGHT_RAD = float(np.radians(0.5))
#: Pulses that are further apart than this many steps have a gap between them.
GAP_STEPS = 1.6


class Lattice(NamedTuple):
    """Where the beams looked about a place: also where nothing came back. Sorted by beam, and by azimuth in each."""

    directions: Array  #: (N, 3)
    ranges: Array  #: (N,), metres; infinite where nothing came back
    rings: np.ndarray  #: (N,)
    point: np.ndarray  #: (N,) which of the cloud; -1 where nothing came back


@dataclass(frozen=True)
class Beams:
    """A cloud by beams; ``rings`` (N,) number them from the lowest up where the cloud does not."""

    points: Array
    directions: Array
    ranges: Array
    azimuths: Array
    rings: np.ndarray
    times_s: Array | None
    step_rad: float  #: Between two pulses of a beam

    def corrected(self, rings: np.ndarray, bias_m: Array) -> Beams:
        """The beams without what each of ``rings`` measured too far."""
        bias = dict(zip(rings.tolist(), bias_m.tolist(), strict=True))
        ranges = self.ranges - np.array([bias.get(ring, 0.0) for ring in self.rings.tolist()])
        return replace(self, ranges=ranges, points=ranges[:, None] * self.directions)

    def lattice(self, middle: Array, radius_m: float) -> Lattice:
        """Where beams looked within an angle of a point (3,) that ``radius_m`` has there."""
        away = float(np.linalg.norm(middle))
        angle = np.arcsin(min(1.0, radius_m / away))
        near = np.flatnonzero(self.directions @ (middle / away) > np.cos(angle))
        around = np.arctan2(middle[1], middle[0])
        parts: list[tuple[Array, Array, np.ndarray, np.ndarray]] = []
        for ring in np.unique(self.rings[near]):
            index = near[self.rings[near] == ring]
            azimuths = np.mod(self.azimuths[index] - around + np.pi, 2.0 * np.pi) - np.pi
            order = np.argsort(azimuths)
            index, azimuths = index[order], azimuths[order]
            gaps = np.diff(azimuths) / self.step_rad
            lost = [
                azimuths[i] + (np.arange(1, round(gaps[i])) / round(gaps[i])) * (azimuths[i + 1] - azimuths[i])
                for i in np.flatnonzero(gaps > GAP_STEPS)
            ]
            empty = np.concatenate(lost) if lost else np.zeros(0)
            elevation = float(np.median(np.arcsin(np.clip(self.directions[index, 2], -1.0, 1.0))))
            turned = empty + around
            nothing = np.stack(
                [
                    np.cos(elevation) * np.cos(turned),
                    np.cos(elevation) * np.sin(turned),
                    np.full(len(turned), np.sin(elevation)),
                ],
                axis=1,
            )
            order = np.argsort(np.concatenate([azimuths, empty]))
            parts.append(
                (
                    np.concatenate([self.directions[index], nothing])[order],
                    np.concatenate([self.ranges[index], np.full(len(empty), np.inf)])[order],
                    np.full(len(order), ring),
                    np.concatenate([index, np.full(len(empty), -1)])[order],
                )
            )
        if not parts:
            return Lattice(np.zeros((0, 3)), np.zeros(0), np.zeros(0, dtype=int), np.zeros(0, dtype=int))
        directions, ranges, rings, indices = (np.concatenate(part) for part in zip(*parts, strict=True))
        return Lattice(directions, ranges, rings, indices)


def beams_of(cloud: Cloud, where: str) -> Beams:
    """A cloud by beams; a CloudError where it has neither their numbers nor elevations that are lines."""
    ranges = np.linalg.norm(cloud.points, axis=1)
    directions = cloud.points / ranges[:, None]
    elevations = np.arcsin(np.clip(directions[:, 2], -1.0, 1.0))
    if cloud.rings is not None:
        rings = np.asarray(cloud.rings).astype(int)
    else:
        order = np.argsort(elevations)
        rings = np.empty(len(order), dtype=int)
        rings[order] = np.concatenate([[0], np.cumsum(np.diff(elevations[order]) > APART_RAD)])
        count = int(rings.max()) + 1
        spreads = [np.ptp(elevations[rings == ring]) for ring in range(min(count, MOST_BEAMS))]
        is_scattered = np.median(spreads) > STRAIGHT_RAD or np.median(np.bincount(rings)) < FEWEST_OF_BEAM
        if not 3 <= count <= MOST_BEAMS or is_scattered:
            raise CloudError(
                f"{where}: the points have no beam numbers (ring), and their elevations do not fall into lines; give "
                "rings, and the cloud in the LiDAR's own frame, whose z is the axis about which it spins"
            )
    azimuths = np.arctan2(cloud.points[:, 1], cloud.points[:, 0])
    order = np.lexsort((azimuths, rings))
    steps = np.diff(azimuths[order])[np.diff(rings[order]) == 0]
    steps = steps[steps > 1e-5]
    if not len(steps):
        raise CloudError(f"{where}: no beam has two points; give one whole turn of the LiDAR")
    return Beams(cloud.points, directions, ranges, azimuths, rings, cloud.times_s, float(np.median(steps)))


def deskewed(cloud: Cloud, twist: ArrayLike) -> Cloud:
    """A cloud as it would be, had the LiDAR stood where it was at the cloud's stamp.

    Parameters
    ----------
    cloud : Cloud
        With ``times_s``.
    twist : (6,)
        The LiDAR's motion in its own frame, [omega (rad/s), v (m/s)], constant over the turn: of its odometry.

    Raises
    ------
    CloudError
        The cloud tells no times.
    OptionError
        The twist is not six finite numbers.
    """
    if cloud.times_s is None:
        where = cloud.source or cloud.frame_id or "the cloud"
        raise CloudError(f"{where}: the points have no times (times_s), so a motion cannot be taken off; stand still")
    motion = real_array(twist)
    if motion.shape != (6,) or not np.isfinite(motion).all():
        raise OptionError(f"twist={brief(twist)}; give [omega (rad/s), v (m/s)], six finite numbers")
    moved = expmap(np.outer(cloud.times_s, motion))
    return replace(cloud, points=(moved[:, :3, :3] @ cloud.points[:, :, None])[..., 0] + moved[:, :3, 3])


@dataclass(frozen=True)
class Segments:
    """Runs of points of one beam without a jump in depth, that stand before what is beside them."""

    members: list[np.ndarray]  #: indices of each one's points, by azimuth
    line: np.ndarray  #: (S,) the beam's place among the beams, from the lowest up
    beams: Beams
    spacing_rad: float

    @staticmethod
    def of(beams: Beams, jump_m: float) -> Segments:
        """The segments; ``jump_m`` is the least difference of two neighbours' ranges that parts them."""
        elevations = np.arcsin(np.clip(beams.directions[:, 2], -1.0, 1.0))
        numbers = np.unique(beams.rings)
        level = np.array([np.median(elevations[beams.rings == ring]) for ring in numbers])
        members: list[np.ndarray] = []
        lines: list[int] = []
        for line, ring in enumerate(numbers[np.argsort(level)]):
            index = np.flatnonzero(beams.rings == ring)
            index = index[np.argsort(beams.azimuths[index])]
            ranges = beams.ranges[index]
            after = np.roll(ranges, -1)
            wide = np.mod(np.roll(beams.azimuths[index], -1) - beams.azimuths[index], 2.0 * np.pi) > (
                3.0 * beams.step_rad
            )
            cuts = np.flatnonzero((np.abs(after - ranges) > jump_m) | wide)
            for first, last in zip(cuts, np.roll(cuts, -1), strict=True):
                run = np.arange(first + 1, last + 1 + (len(index) if last <= first else 0)) % len(index)
                before, beyond = first % len(index), (last + 1) % len(index)
                stands = (wide[first] or ranges[before] > ranges[run[0]]) and (
                    wide[last] or ranges[beyond] > ranges[run[-1]]
                )
                if stands and len(run) >= 3:
                    members.append(index[run])
                    lines.append(line)
        spacing = float(np.median(np.diff(np.sort(level)))) if len(level) > 1 else 0.0
        return Segments(members, np.array(lines, dtype=int), beams, spacing)

    def pieces(self, *, longest_m: float, shortest_m: float) -> Iterator[np.ndarray]:
        """Points (indices) of segments on beams above one another that belong together, three beams at least."""
        points = self.beams.points
        chords = np.array([np.linalg.norm(points[run[-1]] - points[run[0]]) for run in self.members])
        kept = np.flatnonzero((chords <= longest_m) & (chords >= shortest_m)) if len(chords) else np.zeros(0, int)
        middles = [points[self.members[k]].mean(axis=0) for k in kept]
        near: list[tuple[int, int]] = []
        for a, first in enumerate(kept):
            for b, second in enumerate(kept[:a]):
                if abs(self.line[first] - self.line[second]) != 1:
                    continue
                range_m = float(np.linalg.norm(middles[a]))
                if abs(np.linalg.norm(middles[b]) - range_m) > 0.05 + 1.5 * self.spacing_rad * range_m:
                    continue
                reach = 0.5 * (chords[first] + chords[second]) + self.spacing_rad * range_m
                if np.linalg.norm(middles[a] - middles[b]) < reach:
                    near.append((a, b))
        rows = np.array(near, dtype=int).reshape(-1, 2)
        graph = coo_array((np.ones(len(rows)), (rows[:, 0], rows[:, 1])), shape=(len(kept), len(kept)))
        count, label = connected_components(graph, directed=False)
        for piece in range(count):
            of_piece = kept[label == piece]
            if len(np.unique(self.line[of_piece])) >= 3:
                yield np.concatenate([self.members[k] for k in of_piece])
