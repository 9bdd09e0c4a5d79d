"""How a LiDAR moved, by its own sweeps: each is registered to a map of those before it (GICP)."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.clouds.cloud import Cloud
from gtsam_rwhec.errors import CloudError
from gtsam_rwhec.files.optional_packages import extra_named
from gtsam_rwhec.files.progress import Counted, Progress, silent
from gtsam_rwhec.geometry.poses import Array

with extra_named():
    import small_gicp

#: Points within this share of the median range are one point: 0.2 m in a street, 0.05 m in a room.
SPACING = 0.03
#: Gates, in spacings, of the first and of the second registration.
GATES = (4.0, 2.0)
#: Points from which a normal is made.
NEIGHBOURS = 15
#: A sweep joins the map when the sensor has moved so far (in median ranges) or turned so far, rad; the map has so many.
MOVED, TURNED, KEPT = 0.1, 0.15, 8
#: A sweep is lost where a smaller share of its points lies on the map, or it moves on by more than this (in median
#: ranges) from where the motion before it leads.
FOUND, JUMP = 0.5, 0.3
#: After such a time without a sweep that is found, s, the map begins anew. Odometries take no motion over such a gap.
LOST_S = 1.0
#: What surroundings do not tell (along a corridor, over an open field) has less than this share of the information.
TOLD = 0.02
#: Fewer sweeps have no motion to compare, and fewer points of one no pose.
FEWEST, FEWEST_POINTS = 3, 100
#: The spacing is found on so many sweeps. A point that is farther than this, m, is none.
SPACED, FARTHEST_M = 9, 1e4
#: Maps are kept of times so far apart, s, or doubled until there are no more than so many; each of so much time on both
#: sides. So the maps of two sensors are of about the same times.
MAPS_S, MOST_MAPS, MAP_HALF_S = 2.0, 16, 4.0
#: The points of a sweep are taken over at least and at most these shares of the time between two sweeps.
SHORTEST, LONGEST = 0.1, 2.0


@dataclass(frozen=True, eq=False)
class CloudTrack:
    """The path of a LiDAR by its own sweeps.

    Attributes
    ----------
    stamps_ns : (N,)
        The middle of each sweep that was used, on the sensor's clock.
    T_start_sensor : (N, 4, 4)
        Its poses in the frame in which it began, metres. Where the map begins anew it goes on from where it was lost,
        and nothing tells the motion between: a gap of stamps.
    left_out : tuple of str
        Sweeps that are not used, and why.
    why_no_times : str
        Why the motion during a sweep is not taken off: points have no times, or none that can be; empty if it is.
    maps : tuple of Cloud
        What was seen around some of the stamps, in the sensor's frame then: sweeps of the seconds before and after, put
        there by the poses. ``times_s`` are those of the sweeps. `register_lidars` registers those of two LiDARs.
    """

    stamps_ns: np.ndarray
    T_start_sensor: Array
    left_out: tuple[str, ...]
    why_no_times: str
    maps: tuple[Cloud, ...] = ()


@dataclass(frozen=True)
class _Sweep:
    """Points (n, 3) of a sweep with the seconds (n,) from a stamp: the sweep's, or in the end that of its middle."""

    name: str
    points: Array
    times_s: Array
    stamp_ns: int

    def about_its_middle(self, times: float) -> _Sweep:
        """The same with the stamp of its middle, and times from that; times count so many times as much."""
        middle = times * 0.5 * float(self.times_s.min() + self.times_s.max())
        return replace(self, times_s=times * self.times_s - middle, stamp_ns=self.stamp_ns + round(1e9 * middle))

    def held(self, velocity: Array) -> Array:
        """The points (n, 3) as seen at the middle, without the motion (6,) in a second."""
        turned = se3.expmap(np.outer(self.times_s, velocity))
        still: Array = np.einsum("nij,nj->ni", turned[:, :3, :3], self.points) + turned[:, :3, 3]
        return still


def odometry(clouds: Iterable[Cloud], *, progress: Progress | None = None) -> CloudTrack:
    """The motion of a LiDAR, for ``rw.odometry.OdometryTrack(name, track.stamps_ns, track.T_start_sensor)``.

    Parameters
    ----------
    clouds : iterable of Cloud
        Sweeps with stamps, in order; each is read once and thinned. Where points have times, the motion during a sweep
        is taken off, by the motion between the middles of its neighbours.
    progress : callable, optional

    Raises
    ------
    CloudError
        A sweep has no stamp, or fewer than 3 can be registered.

    Notes
    -----
    Sweeps are registered (Segal et al. 2009, "Generalized-ICP"; small_gicp), and where points have times a second time,
    without the motion that the first one found. A sweep is left out where the surroundings do not tell every motion.
    """
    tell = progress or silent
    sweeps, spacing_m, left_out, why_no_times = _thinned(clouds)
    steps: Array = np.zeros((len(sweeps), 6))
    found, why = dict[int, Array](), dict[int, str]()
    for number, gate in enumerate(GATES[:1] if why_no_times else GATES, start=1):
        found, why = _registered(sweeps, steps, found, spacing_m, gate, f"registering sweeps, round {number}:", tell)
        steps = _velocities(sweeps, found)
    left_out += [why[k] for k in sorted(why)]
    if len(found) < FEWEST:
        total = len(sweeps) + len(left_out) - len(why)
        reasons = "; the first: " + "; ".join(left_out[:3]) if left_out else ""
        raise CloudError(f"of {total} sweeps {len(found)} can be registered, and motions need {FEWEST}{reasons}")
    at = np.array(sorted(found))
    stamps = np.array([sweeps[k].stamp_ns for k in at], dtype=np.int64)
    poses = np.array([found[k] for k in at])
    maps = _maps([sweeps[k] for k in at], stamps, poses, steps[at], spacing_m / SPACING)
    return CloudTrack(stamps, poses, tuple(left_out), why_no_times, tuple(maps))


def _thinned(clouds: Iterable[Cloud]) -> tuple[list[_Sweep], float, list[str], str]:
    """Sweeps with one point for each cube of the spacing, the spacing, who is left out, and why times are not used."""
    given = enumerate(Cloud.each(clouds))
    first = list(islice(given, SPACED))
    spacing_m = SPACING * float(np.median([np.median(np.linalg.norm(c.points, axis=1)) for _, c in first] or [0.0]))
    sweeps: list[_Sweep] = []
    left_out, has_times, last_ns = [], True, None
    for number, cloud in chain(first, given):
        name = cloud.source or f"sweep {number}"
        if cloud.stamp_ns is None:
            raise CloudError(f"{name} has no stamp; give Cloud.of(..., stamp_ns=...)")
        if last_ns is not None and cloud.stamp_ns <= last_ns:
            left_out.append(f"{name}: its stamp {cloud.stamp_ns} ns is no later than that of the sweep before it")
            continue
        times = np.zeros(len(cloud)) if cloud.times_s is None else cloud.times_s
        kept = np.isfinite(times) & (np.abs(cloud.points).max(axis=1) < FARTHEST_M)
        points, times = cloud.points[kept], times[kept]
        at = np.unique(np.floor(points / spacing_m).astype(np.int64), axis=0, return_index=True)[1]
        if len(at) < FEWEST_POINTS:
            left_out.append(f"{name}: {len(at)} points are left after thinning to {spacing_m:.2g} m")
            continue
        has_times, last_ns = has_times and cloud.times_s is not None, cloud.stamp_ns
        sweeps.append(_Sweep(name, points[at].astype(np.float32), times[at], cloud.stamp_ns))
    why = _implausible(sweeps) if has_times else "points have no times"
    return [each.about_its_middle(0.0 if why else 1.0) for each in sweeps], spacing_m, left_out, why


def _implausible(sweeps: Sequence[_Sweep]) -> str:
    """Why times of points cannot be those of sweeps that follow each other; empty if they can."""
    if len(sweeps) < 2:
        return ""
    lasts = float(np.median([np.ptp(each.times_s) for each in sweeps]))
    apart = 1e-9 * float(np.median(np.diff([each.stamp_ns for each in sweeps])))
    if SHORTEST * apart <= lasts <= LONGEST * apart:
        return ""
    return (
        f"times of points of one sweep span {lasts:.3g} s where sweeps are {apart:.3g} s apart: another unit than "
        "seconds (float) or nanoseconds (whole), or not filled in"
    )


def _registered(
    sweeps: Sequence[_Sweep],
    velocities: Array,
    before: dict[int, Array],
    spacing_m: float,
    gate: float,
    words: str,
    tell: Progress,
) -> tuple[dict[int, Array], dict[int, str]]:
    """Poses of sweeps by their places, and why others have none; ``before`` are poses of an earlier round."""
    found: dict[int, Array] = {}
    why: dict[int, str] = {}
    keys: deque[tuple[Array, Array]] = deque(maxlen=KEPT)
    target, velocity, reach = None, np.zeros(6), spacing_m / SPACING
    for k, sweep in enumerate(sweeps):
        tell(Counted(words, k + 1, len(sweeps)))
        # The first round knows the motion before a sweep only.
        moving = velocities[k] if before else velocity
        points = sweep.held(moving)
        cloud, _ = small_gicp.preprocess_points(points, spacing_m, NEIGHBOURS)
        last = max(found, default=None)
        seconds = 0.0 if last is None else 1e-9 * (sweep.stamp_ns - sweeps[last].stamp_ns)
        start = np.eye(4) if last is None else found[last] @ se3.expmap(velocity[None] * seconds)[0]
        if last is not None and last in before and k in before:
            start = found[last] @ se3.inverse(before[last]) @ before[k]
        T = start
        if target is not None:
            result = small_gicp.align(
                *(target[0], cloud, target[1]),
                init_T_target_source=start,
                max_correspondence_distance=gate * spacing_m,
                rotation_epsilon=1e-4,
                translation_epsilon=1e-4,
            )
            T = np.asarray(result.T_target_source)
            fault = _fault(sweep, result, cloud, float(np.linalg.norm((T - start)[:3, 3])), reach)
            if fault:
                why[k] = fault
                if seconds > LOST_S:
                    target, velocity = None, np.zeros(6)
                continue
            assert last is not None
            velocity = se3.logmap((se3.inverse(found[last]) @ T)[None])[0] / seconds
        found[k] = T
        if target is None or moved_on(keys[-1][1], T, reach):
            keys.append((points, T))
            if target is None:  # what was before a loss is elsewhere
                keys = deque(list(keys)[-1:], maxlen=KEPT)
            together = np.concatenate([p @ M[:3, :3].T + M[:3, 3] for p, M in keys])
            target = small_gicp.preprocess_points(together, spacing_m, NEIGHBOURS)
    return found, why


def moved_on(before: Array, T: Array, reach: float) -> bool:
    """Whether a pose is so far from one before it that what is seen is new."""
    moved = se3.logmap((se3.inverse(before) @ T)[None])[0]
    return bool(np.linalg.norm(moved[3:]) > MOVED * reach or np.linalg.norm(moved[:3]) > TURNED)


def _maps(
    sweeps: Sequence[_Sweep], stamps: np.ndarray, poses: Array, velocities: Array, reach: float
) -> Iterator[Cloud]:
    """Maps around some of the stamps (N,), of sweeps that moved on; none over a gap, over which no motion is known."""
    step = round(1e9 * MAPS_S)
    while stamps[-1] - stamps[0] > MOST_MAPS * step:
        step *= 2
    piece = np.cumsum(np.r_[0, np.diff(stamps) > 1e9 * LOST_S])
    for middle in range(int(stamps[0] // step) * step + step // 2, int(stamps[-1]), step):
        k = int(np.abs(stamps - middle).argmin())
        near = (np.abs(stamps - stamps[k]) <= 1e9 * MAP_HALF_S) & (piece == piece[k])
        kept: list[int] = []
        for i in np.flatnonzero(near).tolist():
            if i == k or not kept or moved_on(poses[kept[-1]], poses[i], reach):
                kept.append(i)
        T = se3.inverse(poses[k][None])[0] @ poses[kept]
        each = [sweeps[i].held(velocities[i]) @ M[:3, :3].T + M[:3, 3] for i, M in zip(kept, T, strict=True)]
        times = np.repeat(1e-9 * (stamps[kept] - stamps[k]), [len(points) for points in each])
        points = np.concatenate(each).astype(np.float32).astype(np.float64)
        yield Cloud.of(points, times_s=times, stamp_ns=int(stamps[k]))


def _fault(
    sweep: _Sweep, result: small_gicp.RegistrationResult, cloud: small_gicp.PointCloud, off_m: float, reach: float
) -> str:
    """Why a registration is none; empty if it is one."""
    if result.num_inliers < FOUND * cloud.size():
        share = result.num_inliers / max(cloud.size(), 1)
        return f"{sweep.name}: {share:.0%} of its points lie on what was seen before"
    if off_m > JUMP * reach:
        return f"{sweep.name}: it jumps by {off_m:.2g} m from where the motion before it leads"
    unit = np.diag(np.r_[np.full(3, 1.0 / reach), np.ones(3)])
    values, vectors = np.linalg.eigh(unit @ result.H @ unit)
    if values[0] < TOLD * values[-1]:
        worst = int(np.abs(vectors[:, 0]).argmax())
        motion = f"turn about {'xyz'[worst]}" if worst < 3 else f"motion along {'xyz'[worst - 3]}"
        return f"{sweep.name}: the surroundings do not tell its {motion} (a corridor, an open field)"
    return ""


def _velocities(sweeps: Sequence[_Sweep], found: dict[int, Array]) -> Array:
    """The motion in a second (N, 6) at each sweep, by the poses before and after it; zero where it is not known."""
    result = np.zeros((len(sweeps), 6))
    at = sorted(found)
    for before, k, after in zip([*at[:1], *at[:-1]], at, [*at[1:], *at[-1:]], strict=True):
        seconds = 1e-9 * (sweeps[after].stamp_ns - sweeps[before].stamp_ns)
        if seconds > 0.0:
            result[k] = se3.logmap((se3.inverse(found[before]) @ found[after])[None])[0] / seconds
    return result
