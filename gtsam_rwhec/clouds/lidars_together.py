"""Where two LiDARs of one vehicle are to each other, by what both saw: maps of each, registered at many places."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from rwhec_factors import se3
from scipy.linalg import eigh
from scipy.spatial import cKDTree
from scipy.special import chdtri, fdtri

from gtsam_rwhec.clouds.cloud import Cloud
from gtsam_rwhec.clouds.cloud_odometry import LOST_S, MAP_HALF_S, MAPS_S, NEIGHBOURS, SPACING, moved_on
from gtsam_rwhec.clouds.lidar_pair import ROUNDING, LidarsTogether
from gtsam_rwhec.clouds.point_to_plane import (
    CAUCHY,
    LEAST_SHARE,
    SHARED_BY_VIEWS,
    Known,
    Matches,
    known,
    matches,
    sigmas,
    units,
)
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
#: Maps overlap if they share at least this part of the surfaces of one, across every direction.
OVERLAP = 0.15
#: Fewer places do not tell how well they agree.
FEWEST_PLACES = 3
#: Ellipsoids of this level hold what they claim, however few the places are.
LEVEL = 0.95
#: Freedom of the distribution of places about their pose, and rounds in which their weights settle.
FREEDOM, ROUNDS = 4.0, 10
#: Places that scatter by more than so many times what each claims do not show one pose.
MOST_SCATTER = 400.0
#: What a LiDAR's calibration leaves, one standard deviation: ranges that are off alike (m), by a factor, and elevations
#: that are off alike (rad): 0.05 degrees, and a third for the paths that they bend (in simulated yards).
OF_A_LIDAR = (0.01, 0.002, 4.0 / 3.0 * float(np.radians(0.05)))


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


def register_lidars(first: LidarPath, second: LidarPath, T_first_second: Array) -> LidarsTogether:
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
    """What both saw at one time, in the frames of both then."""

    first: Surface
    second: Surface
    rays: tuple[Array, Array]  #: (n, 3): the way from where each was to the points that it saw
    spacing_m: float
    velocity: Array  #: (6,): the second's motion in a second


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
        both = [
            _cut(first.maps[k], first.path, 0.0, half_s, np.eye(4)),
            _cut(second.maps[j], second.path, late_s, half_s, shift),
        ]
        if min(len(points) for points, _ in both) < NEIGHBOURS:
            continue
        spacing_m = SPACING * max(float(np.median(np.linalg.norm(points, axis=1))) for points, _ in both)
        last = stamp, at[0][0]
        around, _ = second.path.at(np.array([stamp - round(1e9 * AROUND_S), stamp + round(1e9 * AROUND_S)]))
        velocity = se3.logmap(se3.inverse(around[:1]) @ around[1:])[0] / (2.0 * AROUND_S)
        (one, its), (other, others) = (_surface(*each, spacing_m) for each in both)
        yield _Place(one, other, (its, others), spacing_m, velocity)


def _cut(cloud: Cloud, path: Trajectory, late_s: float, half_s: float, T: Array) -> tuple[Array, Array]:
    """The points of sweeps of some seconds before and after, and the rays to them (n, 3); both moved by T."""
    assert cloud.times_s is not None
    assert cloud.stamp_ns is not None
    kept = np.abs(cloud.times_s + late_s) <= half_s
    times, sweep = np.unique(cloud.times_s[kept], return_inverse=True)
    stamps = cloud.stamp_ns + np.round(1e9 * np.r_[0.0, times]).astype(np.int64)
    poses = path.at(stamps)[0]
    from_where = (se3.inverse(poses[:1]) @ poses[1:])[:, :3, 3]
    points = cloud.points[kept]
    rays = points - from_where[sweep]
    return np.asarray(points @ T[:3, :3].T + T[:3, 3]), np.asarray(rays @ T[:3, :3].T)


def _surface(points: Array, rays: Array, spacing_m: float) -> tuple[Surface, Array]:
    """A map thinned to a spacing, and its rays. It has no edges: those of beams are none of things."""
    native, tree = small_gicp.preprocess_points(points, spacing_m, NEIGHBOURS)
    thin = native.points()[:, :3]
    none = Features(np.zeros((0, 3)), np.zeros((0, 3)))
    surface = Surface("", Features(thin, native.normals()[:, :3]), none, native, tree)
    return surface, rays[cKDTree(points).query(thin)[1]]


def _registered(places: Sequence[_Place], nothing: LidarsTogether, half_s: float) -> LidarsTogether:
    """The pose with which all places agree best, and what it is worth."""
    T, spacing_m = nothing.T_first_second, float(np.median([each.spacing_m for each in places]))
    for gate in GATES:
        for _ in range(STEPS):
            several = [matches(each.second, each.first, T, gate * each.spacing_m) for each in places]
            sigma_m = sigmas(several, gate * spacing_m)
            pairs = zip(places, several, strict=True)
            told = [(place, each, known(each, sigma_m)) for place, each in pairs if len(each.at)]
            if len(told) < FEWEST_PLACES:
                return replace(nothing, why_not=f"they overlap at {len(told)} places, and {FEWEST_PLACES} are needed")
            unit, _ = units(np.concatenate([each.points for _, each, _ in told]))
            tells, total, told_of = _without_slides([tell for *_, tell in told], unit)
            together = np.linalg.pinv(total, ROUNDING, hermitian=True)
            step = together @ np.sum([each.information @ each.step for each in tells], axis=0)
            T = T @ se3.expmap(step[None])[0]
            if np.linalg.norm(step[:3]) / SPACING + np.linalg.norm(step[3:]) / spacing_m < SETTLED:
                break
    every = [each.second.faces.normals for each in places]
    met = [normals[each.at] for normals, each in zip(every, several, strict=True)]
    # Another yard has the same ground: what counts is the direction of which least is met. A unit is for flat worlds.
    squares = (normals.T @ normals + np.eye(3) for normals in map(np.concatenate, (met, every)))
    overlap = float(eigh(*squares, eigvals_only=True)[0])
    if overlap < OVERLAP:
        words = f"they overlap by {overlap:.0%} where the motions put the two, and {OVERLAP:.0%} are needed"
        return replace(nothing, why_not=words)
    step, inverse, scatter = _agreed(tells, told_of)
    if max(scatter) > MOST_SCATTER:
        words = f"places disagree by {np.sqrt(max(scatter)):.2g} times what each claims: both did not see the same"
        return replace(nothing, why_not=words)
    T = T @ se3.expmap(step[None])[0]
    pulls, shown = (np.sum(each, axis=0) for each in zip(*(_alike(*each, T, sigma_m) for each in told), strict=True))
    # Elevations are as far off as residuals show, if that is more.
    raised = max(OF_A_LIDAR[2], abs(float(shown[0])) / float(shown[1] + (sigma_m[0] / OF_A_LIDAR[2]) ** 2))
    alike = together @ pulls * (*OF_A_LIDAR[:2], raised, *OF_A_LIDAR[:2], raised, nothing.clock_sigma_s)
    # What points of all places are off by together does not average out; what slides stays without weight.
    shared = SHARED_BY_VIEWS[0] * sigma_m[0] * together @ total @ unit
    covariance = inverse + alike @ alike.T + shared @ shared.T
    return replace(
        nothing,
        T_first_second=T,
        information=np.linalg.pinv(covariance, ROUNDING, hermitian=True),
        places=len(told),
        half_s=half_s,
        overlap=overlap,
        noise_m=float(sigma_m[0]),
        scatter=scatter,
        why_not="",
    )


def _agreed(tells: Sequence[Known], told: Array) -> tuple[Array, Array, tuple[float, float]]:
    """The step (6,) that most places agree to, its covariance, and how turns and shifts scatter over what places claim.

    Places count less where they are far from the others (Student's t): an odometry that just began, or a moved thing.
    """
    information, steps = np.array([each.information for each in tells]), np.array([each.step for each in tells])
    parts = (slice(0, 3), slice(3, 6))
    inverses = np.linalg.pinv(information, ROUNDING, hermitian=True)
    rank = np.array([np.linalg.matrix_rank(each, hermitian=True) for each in information])
    expected = [float(np.einsum("nij,nji->", information[:, at, at], inverses[:, at, at])) for at in parts]
    scatter, off, unsure = np.ones(2), steps, 1.0
    for _ in range(ROUNDS):
        unit = np.repeat(np.maximum(unsure * scatter, 1.0) ** -0.5, 3)
        # Turns and shifts are scaled apart, and what slides may be both.
        scaled = told.T @ (information * unit[:, None] * unit) @ told
        weights = (FREEDOM + rank) / (FREEDOM + np.einsum("ni,nij,nj->n", off, scaled, off))
        weights /= max(1.0, float(weights.mean()))
        weighted = weights[:, None, None] * scaled
        inverse = np.linalg.pinv(weighted.sum(axis=0), ROUNDING, hermitian=True)
        step = inverse @ np.einsum("nij,nj->i", weighted, steps)
        off = steps - step
        squares = [
            float(np.einsum("n,ni,nij,nj->", weights, off[:, at], information[:, at, at], off[:, at])) for at in parts
        ]
        count = float(weights.sum() ** 2 / (weights**2).sum())
        scatter = np.array(squares) / (np.where(expected, expected, 1.0) * (1.0 - 1.0 / count))
        # The scatter of few places is itself not known: ellipsoids hold as much as if it were.
        unsure = 6.0 * float(fdtri(6.0, 3.0 * (count - 1.0), LEVEL) / chdtri(6.0, 1.0 - LEVEL))
    return step, inverse, (float(scatter[0]), float(scatter[1]))


def _without_slides(tells: Sequence[Known], unit: Array) -> tuple[list[Known], Array, Array]:
    """What places tell without what slides in all of them, the sum of the information (6, 6), and what takes it out.

    Each place has another direction that slides, by the noise of its normals, so that their sum has none.
    """
    total = np.sum([each.information for each in tells], axis=0)
    values, along = np.linalg.eigh(unit.T @ total @ unit)
    kept = along[:, values > LEAST_SHARE * values[-1]]
    told = unit @ kept @ kept.T @ np.linalg.inv(unit)
    return [replace(each, information=told.T @ each.information @ told) for each in tells], told.T @ total @ told, told


def _alike(place: _Place, found: Matches, tell: Known, T: Array, sigma_m: Array) -> tuple[Array, Array]:
    """How one place pulls (6, 7) at the pose for what the first and the second LiDAR have off, and for a clock.

    That are the ranges, by a length and by a factor, and the elevations, about the LiDAR's own z axis. To that sums
    (2,): the first over the second is by how much elevations of one are too high and those of the other too low.
    """
    moved = found.points @ T[:3, :3].T + T[:3, 3]
    rays = -place.rays[0][place.first.faces.nearest(moved)[1]] @ T[:3, :3], place.rays[1][found.at]
    rows, offs = 0.5 * (found.rows + found.own_rows), []
    for each, up in zip(rays, (T[2, :3], np.array([0.0, 0.0, 1.0])), strict=True):
        ranges = np.linalg.norm(each, axis=1, keepdims=True)
        around = np.cross(each, up)
        raised = np.cross(around, each) / np.maximum(np.linalg.norm(around, axis=1, keepdims=True), 1e-9)
        offs.append([np.einsum("ni,ni->n", rows[:, 3:], pattern) for pattern in (each / ranges, each, raised)])
    off = np.concatenate(offs).T
    weights = 1.0 / (1.0 + (found.residuals / (CAUCHY * sigma_m[0])) ** 2)
    steps = np.linalg.pinv(rows.T * weights @ rows, ROUNDING, hermitian=True) @ (rows.T * weights @ off)
    apart = (off - rows @ steps)[:, [2, 5]].sum(axis=1)  # what no step takes away
    pulls = tell.information @ np.column_stack([steps, place.velocity])
    return np.asarray(pulls), (weights * apart) @ np.column_stack([found.residuals, apart])
