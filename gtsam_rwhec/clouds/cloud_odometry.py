"""How a LiDAR moved, by its own sweeps: each is registered to a map of those before it (GICP)."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

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
#: Fewer sweeps have no motion to compare.
FEWEST = 3


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
    has_times : bool
        Whether points have times, so that the motion during each sweep is taken off.
    """

    stamps_ns: np.ndarray
    T_start_sensor: Array
    left_out: tuple[str, ...]
    has_times: bool


@dataclass(frozen=True)
class _Sweep:
    """Points (n, 3) of a sweep with the seconds (n,) from its middle, and the stamp of that."""

    name: str
    points: Array
    times_s: Array
    stamp_ns: int


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
        A sweep has no stamp, or is older than the one before it; or fewer than 3 can be registered.

    Notes
    -----
    Sweeps are registered twice (Segal et al. 2009, "Generalized-ICP"; small_gicp): the second time without the motion
    that the first one found. A sweep from which the surroundings do not tell every motion is left out.
    """
    tell = progress or silent
    sweeps, spacing_m, has_times = _thinned(clouds)
    steps: Array = np.zeros((len(sweeps), 6))
    found: dict[int, Array] = {}
    for number, gate in enumerate(GATES if has_times else GATES[:1], start=1):
        found, why = _registered(sweeps, steps, found, spacing_m, gate, f"registering sweeps, round {number}:", tell)
        steps = _velocities(sweeps, found)
    if len(found) < FEWEST:
        reasons = "; ".join(list(why.values())[:3])
        raise CloudError(f"of {len(sweeps)} sweeps {len(found)} can be registered; motions need {FEWEST}. {reasons}")
    at = np.array(sorted(found))
    stamps = np.array([sweeps[k].stamp_ns for k in at], dtype=np.int64)
    return CloudTrack(stamps, np.array([found[k] for k in at]), tuple(why[k] for k in sorted(why)), has_times)


def _thinned(clouds: Iterable[Cloud]) -> tuple[list[_Sweep], float, bool]:
    """All sweeps with one point for each cube of the spacing, the spacing, and whether all points have times."""
    sweeps: list[_Sweep] = []
    spacing_m, has_times = 0.0, True
    for number, cloud in enumerate(Cloud.each(clouds)):
        name = cloud.source or f"sweep {number}"
        if cloud.stamp_ns is None:
            raise CloudError(f"{name} has no stamp; give Cloud.of(..., stamp_ns=...)")
        if not spacing_m:
            spacing_m = SPACING * float(np.median(np.linalg.norm(cloud.points, axis=1)))
        has_times = has_times and cloud.times_s is not None
        times = np.zeros(len(cloud)) if cloud.times_s is None else cloud.times_s
        middle = 0.5 * float(times.min() + times.max())
        stamp = cloud.stamp_ns + round(1e9 * middle)
        if sweeps and stamp <= sweeps[-1].stamp_ns:
            raise CloudError(f"{name} is at {stamp} ns, no later than the sweep before it; give sweeps in their order")
        first = np.unique(np.floor(cloud.points / spacing_m).astype(np.int64), axis=0, return_index=True)[1]
        points, times = (each[first].astype(np.float32) for each in (cloud.points, times - middle))
        sweeps.append(_Sweep(name, points, times, stamp))
    return sweeps, spacing_m, has_times and bool(sweeps)


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
        turned = se3.expmap(np.outer(sweep.times_s, moving))
        points = np.einsum("nij,nj->ni", turned[:, :3, :3], sweep.points) + turned[:, :3, 3]
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
        moved = se3.logmap((se3.inverse(keys[-1][1]) @ T)[None])[0] if keys else np.full(6, np.inf)
        far = np.linalg.norm(moved[3:]) > MOVED * reach or np.linalg.norm(moved[:3]) > TURNED
        if target is None or far:
            keys.append((points, T))
            if target is None:  # what was before a loss is elsewhere
                keys = deque(list(keys)[-1:], maxlen=KEPT)
            together = np.concatenate([p @ M[:3, :3].T + M[:3, 3] for p, M in keys])
            target = small_gicp.preprocess_points(together, spacing_m, NEIGHBOURS)
    return found, why


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
