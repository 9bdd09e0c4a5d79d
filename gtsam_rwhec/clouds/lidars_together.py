"""Where two LiDARs of one vehicle are to each other, by what both saw: maps of each, registered at many places."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from rwhec_factors import se3
from scipy.spatial import cKDTree

from gtsam_rwhec.clouds.cloud import Cloud
from gtsam_rwhec.clouds.cloud_odometry import LOST_S, MAP_HALF_S, MAPS_S, NEIGHBOURS, SPACING, moved_on
from gtsam_rwhec.clouds.point_to_plane import Known, Matches, known, matches, sigmas, units
from gtsam_rwhec.clouds.surfaces import Features, Surface
from gtsam_rwhec.files.optional_packages import extra_named
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.trajectory import Trajectory

with extra_named():
    import small_gicp

#: Seconds of sweeps before and after, of which maps are: the shortest with which the maps overlap.
HALVES_S = (0.5 * MAPS_S, MAP_HALF_S)
#: Gates, in spacings, from wide to narrow, and the steps in each.
GATES, STEPS = (8.0, 4.0, 2.0), 6
#: A step is the last of a gate if it moves points by less than this share of the spacing.
SETTLED = 1e-3
#: Velocities are over so many seconds before and after.
AROUND_S = 0.2
#: Maps overlap if they share at least this part of the points of one.
OVERLAP = 0.15
#: Fewer places, or fewer numbers that they have to spare, do not tell how well they agree.
FEWEST_PLACES, FEWEST_SPARE = 3, 6
#: Places that scatter by more than so many times what each claims do not show one pose.
MOST_SCATTER = 25.0
#: All ranges of a LiDAR are off alike by this, m, one standard deviation.
RANGE_BIAS_M = 0.01


@dataclass(frozen=True)
class LidarPath:
    """A LiDAR's maps (`CloudTrack.maps`) and its path, on one clock with others, which is known to a deviation."""

    sensor: str
    maps: Sequence[Cloud]
    path: Trajectory
    clock_sigma_s: float = 0.0

    def stamps(self) -> np.ndarray:
        """The stamps (N,) of the maps, ns."""
        return np.array([each.stamp_ns for each in self.maps], dtype=np.int64)


@dataclass(frozen=True)
class LidarsTogether:
    """The pose of one LiDAR in the frame of another by what both saw.

    Attributes
    ----------
    T_first_second : (4, 4)
    information : (6, 6)
        Of a right perturbation, rotation first; zero along what the surroundings do not tell.
    places : int
        At so many places maps were registered.
    half_s : float
        Maps are of the sweeps so long before and after.
    overlap : float
        The median share of the points of the second's maps that lie on the first's.
    noise_m : float
        Standard deviation of a distance between both.
    scatter : float
        How the places disagree, over what each claims (mean square); where above 1 the information is less by it.
    why_not : str
        Why it is not to be used; empty if it is.
    clock_sigma_s : float
        Standard deviation of what is between the clocks of both.
    """

    first: str
    second: str
    T_first_second: Array
    information: Array
    places: int = 0
    half_s: float = 0.0
    overlap: float = 0.0
    noise_m: float = 0.0
    scatter: float = 0.0
    why_not: str = ""
    clock_sigma_s: float = 0.0

    def __str__(self) -> str:
        pair = f"the clouds of {self.first} and {self.second}"
        if self.why_not:
            return f"{pair} are not registered with each other: {self.why_not}"
        values, along = np.linalg.eigh(self.information)
        told = values > 0.0
        free = "" if told.all() else f"; {int((~told).sum())} directions slide, and are left to the motions"
        spread = np.linalg.pinv(self.information, hermitian=True)
        deg, mm = np.degrees(np.sqrt(np.trace(spread[:3, :3]))), 1e3 * np.sqrt(np.trace(spread[3:, 3:]))
        return (
            f"{pair} are registered with each other at {self.places} places ({self.overlap:.0%} overlap, maps of "
            f"{2 * self.half_s:g} s), which gives the pose to {deg:.2g} degrees and {mm:.2g} mm{free}"
        )


def lidars_together(first: LidarPath, second: LidarPath, T_first_second: Array) -> LidarsTogether:
    """Register the maps of two LiDARs at all places with one pose of the second in the frame of the first.

    ``T_first_second`` (4, 4) is the start. Each place tells the pose by points to planes (`point_to_plane.known`), and
    counts as much as the scatter of all places says. To that come ranges that are off alike.
    """
    clock_sigma_s = float(np.hypot(first.clock_sigma_s, second.clock_sigma_s))
    names = first.sensor, second.sensor
    nothing = LidarsTogether(*names, T_first_second, np.zeros((6, 6)), clock_sigma_s=clock_sigma_s)
    for half_s in HALVES_S:
        places = list(_places(first, second, half_s))
        if len(places) < FEWEST_PLACES:
            words = f"{len(places)} places have maps of both, and {FEWEST_PLACES} are needed; drive longer"
            nothing = nothing if nothing.why_not else replace(nothing, why_not=words)
            continue
        found = _registered(places, nothing, half_s)
        if not found.why_not:
            return found
        nothing = replace(nothing, why_not=found.why_not)
    return nothing


@dataclass(frozen=True)
class _Place:
    """What both saw at one time, in the frames of both then, the points' spacing, and the second's motion in a second."""

    first: Surface
    second: Surface
    spacing_m: float
    velocity: Array


def _places(first: LidarPath, second: LidarPath, half_s: float) -> Iterator[_Place]:
    """Places as far apart in time as maps are long, with the vehicle moved on between."""
    if not first.maps or not second.maps:
        return
    ours, theirs = first.stamps(), second.stamps()
    last: tuple[int, Array] | None = None
    for k, stamp in enumerate(ours.tolist()):
        j = int(np.abs(theirs - stamp).argmin())
        late_s = 1e-9 * float(theirs[j] - stamp)
        at, gaps = zip(*(each.path.at(np.array([stamp, theirs[j]])) for each in (first, second)), strict=True)
        if abs(late_s) > MAPS_S or np.max(gaps) > LOST_S:
            continue
        reach = float(np.median(np.linalg.norm(first.maps[k].points, axis=1)))
        if last and (stamp - last[0] < 1.98e9 * half_s or not moved_on(last[1], at[0][0], reach)):
            continue
        shift = se3.inverse(at[1][:1])[0] @ at[1][1]
        clouds = [_cut(first.maps[k], np.eye(4), 0.0, half_s), _cut(second.maps[j], shift, late_s, half_s)]
        if min(map(len, clouds)) < NEIGHBOURS:
            continue
        spacing_m = SPACING * max(float(np.median(np.linalg.norm(points, axis=1))) for points in clouds)
        last = stamp, at[0][0]
        around, _ = second.path.at(np.array([stamp - round(1e9 * AROUND_S), stamp + round(1e9 * AROUND_S)]))
        velocity = se3.logmap(se3.inverse(around[:1]) @ around[1:])[0] / (2.0 * AROUND_S)
        yield _Place(*(_surface(points, spacing_m) for points in clouds), spacing_m, velocity)


def _cut(cloud: Cloud, T: Array, late_s: float, half_s: float) -> Array:
    """The points of sweeps of some seconds before and after, moved by T."""
    assert cloud.times_s is not None
    points = cloud.points[np.abs(cloud.times_s + late_s) <= half_s]
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def _surface(points: Array, spacing_m: float) -> Surface:
    """A map thinned to a spacing. It has no edges: those of beams are none of things."""
    native, tree = small_gicp.preprocess_points(points, spacing_m, NEIGHBOURS)
    thin = native.points()[:, :3]
    none = Features(np.zeros((0, 3)), np.zeros((0, 3)), cKDTree(np.zeros((0, 3))))
    return Surface("", Features(thin, native.normals()[:, :3], cKDTree(thin)), none, native, tree)


def _registered(places: Sequence[_Place], nothing: LidarsTogether, half_s: float) -> LidarsTogether:
    """The pose with which all places agree best, and what it is worth."""
    T, spacing_m = nothing.T_first_second, float(np.median([each.spacing_m for each in places]))
    for gate in GATES:
        for _ in range(STEPS):
            several = [matches(each.second, each.first, T, gate * each.spacing_m) for each in places]
            sigma_m = sigmas(several, gate * spacing_m)
            tells = [known(each, sigma_m) if len(each.at) else None for each in several]
            total, step = _together([each for each in tells if each])
            T = T @ se3.expmap(step[None])[0]
            if np.linalg.norm(step[:3]) / SPACING + np.linalg.norm(step[3:]) / spacing_m < SETTLED:
                break
    overlap = float(np.median([each.overlap for each in several]))
    if overlap < OVERLAP:
        words = f"they overlap by {overlap:.0%} where the motions put the two, and {OVERLAP:.0%} are needed"
        return replace(nothing, why_not=words)
    those = [(*each, tell) for *each, tell in zip(places, several, tells, strict=True) if tell]
    ranks = [np.linalg.matrix_rank(tell.information, hermitian=True) for *_, tell in those]
    spare = sum(ranks) - np.linalg.matrix_rank(total, hermitian=True)
    squares = sum(float(tell.step @ tell.information @ tell.step) for *_, tell in those)
    if spare < FEWEST_SPARE:
        return replace(nothing, why_not="too few places tell the same of the pose to compare them")
    scatter = float(squares / (spare - 2.0))
    if scatter > MOST_SCATTER:
        words = f"places disagree by {np.sqrt(scatter):.2g} times what each claims: maps lie wrongly on each other"
        return replace(nothing, why_not=words)
    inverse = np.linalg.pinv(total, 1e-12, hermitian=True)
    alike = inverse @ sum((_alike(*each, T, sigma_m) for each in those), np.zeros((6, 3)))
    alike *= (RANGE_BIAS_M, RANGE_BIAS_M, nothing.clock_sigma_s)
    covariance = max(scatter, 1.0) * inverse + alike @ alike.T
    return replace(
        nothing,
        T_first_second=T,
        information=np.linalg.pinv(covariance, 1e-12, hermitian=True),
        places=len(those),
        half_s=half_s,
        overlap=overlap,
        noise_m=float(sigma_m[0]),
        scatter=scatter,
        why_not="",
    )


def _together(tells: Sequence[Known]) -> tuple[Array, Array]:
    """The information (6, 6) of all places, and the step (6,) that they give."""
    total = sum((each.information for each in tells), np.zeros((6, 6)))
    right = sum((each.information @ each.step for each in tells), np.zeros(6))
    return total, np.linalg.pinv(total, 1e-12, hermitian=True) @ right


def _alike(place: _Place, found: Matches, tell: Known, T: Array, sigma_m: Array) -> Array:
    """How one place pulls (6, 3) at the pose if the ranges of the first, or of the second, are off, or their clocks."""
    moved = found.points @ T[:3, :3].T + T[:3, 3]
    rays = (-_unit(moved) @ T[:3, :3], _unit(found.points))
    pulls, little = [], 1e-3 * float(sigma_m[0])
    for each in rays:
        off = found.residuals + little * np.einsum("ni,ni->n", found.rows[:, 3:], each)
        other = known(replace(found, residuals=off), sigma_m)
        pulls.append((other.information @ other.step - tell.information @ tell.step) / little)
    return np.column_stack([*pulls, tell.information @ place.velocity])


def _unit(points: Array) -> Array:
    return np.asarray(points / np.linalg.norm(points, axis=1, keepdims=True))
