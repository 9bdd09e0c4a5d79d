"""Odometries, read from a log or from files, and their motions and the carriers', A Y = Y B, over chosen windows."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import LogError, RwhecError
from gtsam_rwhec.geometry.odometry_track import OdometryNoise, OdometryTrack
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.logs import Log, PoseRecord
from gtsam_rwhec.logs.image_folder import as_ns, read_poses
from gtsam_rwhec.logs.pose_tables import PoseStatement
from gtsam_rwhec.results.log_history import RemovalReason
from gtsam_rwhec.rig import Cleaning, OdometrySource, Rig
from gtsam_rwhec.rig.odometry_sections import START, odometry_topic
from gtsam_rwhec.runs.carrier_motion import CarrierMotion, poses_of_tf, poses_of_topic
from gtsam_rwhec.runs.clocks_by_turning import offset_of_either_direction
from gtsam_rwhec.runs.measured_pairs import MeasuredPairs

#: A track of fewer poses has no motion to compare.
FEWEST = 3


def read_odometry(log: Log, rig: Rig, sensor: str) -> OdometryTrack:
    """The track of a sensor with odometry, on its own clock.

    Raises `LogError` if it has too few poses, or if the rig file names a topic or file that does not exist;
    `TransformError`, `StampError` as for the carriers' poses.
    """
    source = rig.odometries[sensor].odometry
    place = rig.source.place(("sensors", sensor, "odometry"))
    of_log = odometry_topic(sensor)
    if source.tf is not None:
        start, child = source.tf
        upper, _, stamps, T = poses_of_tf(log, start, child, child)
        T = T if upper == start else se3.inverse(T)
    elif source.topic is not None:
        stamps, T = poses_of_topic(log, source.topic)
    elif any(topic.name == of_log for topic in log.topics()):  # an earlier stage wrote it
        stamps, T = poses_of_topic(log, of_log)
    else:
        raise LogError(
            f"{log.files[0].path} has no motion of {sensor} yet, which {place} has; gtsam-rwhec detect adds it"
        )
    if len(stamps) < FEWEST:
        raise LogError(f"{place}: {source.place} has {len(stamps)} poses; motions need at least {FEWEST}")
    noise = source.noise
    stated = None
    if noise is not None:
        stated = OdometryNoise(float(np.radians(noise.rotation_deg_per_sqrt_s)), 1e-3 * noise.translation_mm_per_sqrt_s)
    return OdometryTrack(sensor, stamps, T, stated, has_unknown_scale=source.scale == "estimate")


def read_file(rig: Rig, sensor: str) -> tuple[np.ndarray, Array]:
    """Stamps (N,), nanoseconds, and poses (N, 4, 4) of an odometry in a file: TUM, or CSV with a column of stamps.

    Raises `LogError` where the file cannot be read, or a row has no stamp.
    """
    source = rig.odometries[sensor].odometry
    path = rig.folder / str(source.file)
    place = rig.source.place(("sensors", sensor, "odometry"))
    if not path.is_file():
        raise LogError(f"{place}: there is no file {path}")
    try:  # vehicles drive further than the workspaces in which a length may be millimetres
        poses = read_poses(path, PoseStatement(length="m"))
    except RwhecError as error:
        raise LogError(f"{place}: {error}") from error
    stamps = []
    for name, where in zip(poses.names, poses.places, strict=True):
        stamp = as_ns(name if "." in name or len(name) > 15 else f"{name}.0")
        if stamp is None:
            raise LogError(f"{place}: {where}: {name!r} is no stamp; TUM's rows begin with a stamp in seconds")
        stamps.append(stamp)
    in_order = np.array(stamps, dtype=np.int64)
    order = np.argsort(in_order, kind="stable")
    last = np.append(np.diff(in_order[order]) != 0, True)  # of several poses with one stamp the last one counts
    return in_order[order][last], poses.T[order][last]


def files_of(rig: Rig) -> Iterator[tuple[str, Path]]:
    """The sensors whose odometry is in a file, and the files."""
    for name, sensor in rig.odometries.items():
        if sensor.odometry.file is not None:
            yield name, rig.folder / sensor.odometry.file


def records_of_files(rig: Rig) -> dict[str, list[PoseRecord]]:
    """The odometries that are in files, each on its `odometry_topic`, so that a log with them needs no file."""
    found = {}
    for sensor, _ in files_of(rig):
        topic, start = odometry_topic(sensor), f"{rig.frame_of(sensor)}{START}"
        poses = zip(*read_file(rig, sensor), strict=True)
        found[topic] = [PoseRecord(int(stamp), int(stamp), topic, start, "", T) for stamp, T in poses]
    return found


#: Seconds. Windows have one of these lengths.
LENGTHS_S = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
#: A length of windows is tried only if it gives at least this many of them; the shortest is always tried.
FEWEST_WINDOWS = 12
#: The least noise that is estimated for an odometry, after one second: rad and m.
QUIETEST = OdometryNoise(1e-6, 1e-6)
#: A robust standard deviation is this many times the median of the absolute values.
OF_MEDIAN = 1.4826


def odometry_windows(
    track: OdometryTrack,
    path: Trajectory,
    offset_s: float,
    source: OdometrySource,
    cleaning: Cleaning,
    max_gap_s: float,
) -> tuple[MeasuredPairs, float]:
    """Motions over windows of an odometry, against the carriers' path (T_sensorcarrier_targetcarrier over time).

    The chosen length has the most information on the rotation: the sum over windows of |R - I|_F^2 / T, since the
    variance of a random walk grows with the window's length T. `offset_s` is added to the sensor's stamps to get the
    carriers' stamps. `max_gap_s` limits gaps between the carriers' poses. Returns the length too, seconds.
    """
    own = Trajectory(np.asarray(track.stamps_ns), np.asarray(track.T_start_sensor), track.sensor)
    step = float(np.median(np.diff(own.stamps_ns))) * 1e-9
    best: tuple[float, tuple[np.ndarray, np.ndarray, Array, Array]] | None = None
    chosen_s = LENGTHS_S[0]
    for length_s in LENGTHS_S:
        if length_s < 2.0 * step and length_s != LENGTHS_S[-1]:
            continue
        made = _motions(own, path, offset_s, length_s)
        if len(made[0]) < FEWEST_WINDOWS and best is not None:
            break
        good = ~(
            _lost(own, made[0], source) | _gap(own, made[0], source.max_gap_s) | _unknown(path, made[1], max_gap_s)
        )
        turned = ((made[2][good][:, :3, :3] - np.eye(3)) ** 2).sum()
        information = float(turned) / (length_s + step)
        if best is None or information > best[0]:
            best, chosen_s = (information, made), length_s
    assert best is not None
    edges_ns, edges_of_path_ns, A, B = best[1]
    reasons = _reasons(own, path, edges_ns, edges_of_path_ns, A, chosen_s, source, cleaning, max_gap_s)
    used = np.array([not reason for reason in reasons], dtype=bool)
    noise = track.noise or found_noise(A[used], B[used], chosen_s, has_unknown_scale=track.has_unknown_scale)
    covariance = covariances(B, chosen_s, noise)
    return MeasuredPairs(A, B, edges_ns[:, 1], covariance, reasons, track.sensor, track.sensor), chosen_s


def covariances(B: Array, window_s: float, noise: OdometryNoise) -> Array:
    """Covariances (N, 6, 6) of B as a random walk; rotation variance q adds q |t|^2 / 3 to translation t's axes."""
    rotation, translation = (
        rate**2 * window_s for rate in (noise.rotation_rad_per_sqrt_s, noise.translation_m_per_sqrt_s)
    )
    squared = (B[:, :3, 3] ** 2).sum(axis=1) / 3.0
    made = np.zeros((len(B), 6, 6))
    made[:, range(3), range(3)] = rotation
    made[:, range(3, 6), range(3, 6)] = (translation + rotation * squared)[:, None]
    return made


def found_noise(A: Array, B: Array, window_s: float, *, has_unknown_scale: bool) -> OdometryNoise:
    """Estimate the noise from what must be equal in A Y = Y B: the angles, and the translations along the axis.

    If nothing turned there is no axis, and the lengths of the translations are compared.
    """
    if len(A) < 3:
        return OdometryNoise(np.radians(0.1), 0.01)
    a, b = (se3.so3_logmap(T[:, :3, :3]) for T in (A, B))
    angle_a, angle_b = (np.linalg.norm(v, axis=1) for v in (a, b))
    has_axis = np.minimum(angle_a, angle_b) > np.radians(2.0)
    way_a, way_b = (np.linalg.norm(T[:, :3, 3], axis=1) for T in (A, B))
    if has_axis.sum() >= 3:
        way_a, way_b = (
            np.einsum("ni,ni->n", T[has_axis, :3, 3], v[has_axis]) / angle[has_axis]
            for T, v, angle in ((A, a, angle_a), (B, b, angle_b))
        )
    scale = 1.0
    if has_unknown_scale and (way_a @ way_a) > 0.0:
        scale = float(way_a @ way_b) / float(way_a @ way_a)
    rates = (
        OF_MEDIAN * float(np.median(np.abs(difference))) / np.sqrt(window_s)
        for difference in (angle_b - angle_a, way_b - scale * way_a)
    )
    rotation, translation = rates
    return OdometryNoise(
        max(rotation, QUIETEST.rotation_rad_per_sqrt_s), max(translation, QUIETEST.translation_m_per_sqrt_s)
    )


def _motions(
    own: Trajectory, path: Trajectory, offset_s: float, length_s: float
) -> tuple[np.ndarray, np.ndarray, Array, Array]:
    """Starts and ends of windows (N, 2) on both clocks, A and B; windows lie in the time that both tracks have."""
    shift_ns, length_ns = round(1e9 * offset_s), round(1e9 * length_s)
    first = max(int(own.stamps_ns[0]), int(path.stamps_ns[0]) - shift_ns)
    last = min(int(own.stamps_ns[-1]), int(path.stamps_ns[-1]) - shift_ns)
    edges = np.arange(first, last + 1, length_ns)
    edges_ns = np.stack([edges[:-1], edges[1:]], axis=1)
    (carrier, _), (sensor, _) = path.at(edges + shift_ns), own.at(edges)
    return edges_ns, edges_ns + shift_ns, carrier[:-1] @ se3.inverse(carrier[1:]), se3.inverse(sensor[:-1]) @ sensor[1:]


def _reasons(
    own: Trajectory,
    path: Trajectory,
    edges_ns: np.ndarray,
    edges_of_path_ns: np.ndarray,
    A: Array,
    window_s: float,
    source: OdometrySource,
    cleaning: Cleaning,
    max_gap_s: float,
) -> tuple[str, ...]:
    """Why each window is not used: the first check that it fails; empty if it is used."""
    turned, moved = np.linalg.norm(se3.so3_logmap(A[:, :3, :3]), axis=1), np.linalg.norm(A[:, :3, 3], axis=1)
    none = np.zeros(len(A), dtype=bool)
    still = (turned < np.radians(cleaning.min_rotation_deg)) & (moved < 1e-3 * cleaning.min_translation_mm)
    turns, moves = cleaning.max_rotation_deg_s, cleaning.max_translation_m_s
    checks = (
        (_gap(own, edges_ns, source.max_gap_s), RemovalReason.ODOMETRY_GAP),
        (_lost(own, edges_ns, source), RemovalReason.ODOMETRY_STEP),
        (_unknown(path, edges_of_path_ns, max_gap_s), RemovalReason.GAP),
        (none if turns is None else turned > np.radians(turns) * window_s, RemovalReason.TURNING_FAST),
        (none if moves is None else moved > moves * window_s, RemovalReason.MOVING_FAST),
        (still if cleaning.thin else none, RemovalReason.STANDSTILL),
    )
    reasons = np.full(len(A), "", dtype=object)
    for wrong, reason in reversed(checks):
        reasons[wrong] = str(reason)
    return tuple(reasons.tolist())


def _lost(own: Trajectory, edges_ns: np.ndarray, source: OdometrySource) -> np.ndarray:
    """Windows (N,) with a step beyond the gates (DQ paper, Appendix D.1, as speeds)."""
    step = se3.inverse(own.T[:-1]) @ own.T[1:]
    seconds = np.diff(own.stamps_ns) * 1e-9
    turned = np.linalg.norm(se3.so3_logmap(step[:, :3, :3]), axis=1)
    moved = np.linalg.norm(step[:, :3, 3], axis=1) if source.scale == "known" else np.zeros(len(step))
    wrong = (turned > np.radians(source.max_turn_deg_s) * seconds) | (moved > source.max_speed_m_s * seconds)
    return _contains(own.stamps_ns, wrong, edges_ns)


def _gap(own: Trajectory, edges_ns: np.ndarray, max_gap_s: float) -> np.ndarray:
    return _contains(own.stamps_ns, np.diff(own.stamps_ns) > 1e9 * max_gap_s, edges_ns)


def _unknown(path: Trajectory, edges_ns: np.ndarray, max_gap_s: float) -> np.ndarray:
    """Windows (N,) for which the carriers' pose at the start or the end is not known."""
    return np.asarray((path.gaps(edges_ns.reshape(-1)) > max_gap_s).reshape(-1, 2).any(axis=1))


def _contains(stamps_ns: np.ndarray, wrong: np.ndarray, edges_ns: np.ndarray) -> np.ndarray:
    """Windows (N,) that overlap with a wrong step (M - 1,)."""
    count = np.r_[0, np.cumsum(wrong)]
    first = np.clip(np.searchsorted(stamps_ns, edges_ns[:, 0], side="right") - 1, 0, len(wrong))
    last = np.clip(np.searchsorted(stamps_ns, edges_ns[:, 1], side="left"), 0, len(wrong))
    has: np.ndarray = count[last] > count[first]
    return has


#: Seconds. Clocks are compared over pieces of this length, in which an odometry drifts little.
PIECE_S = 30.0
#: A sensor with fewer used windows than this has no answer.
FEWEST_USED = 3


def odometry_pairs(log: Log, rig: Rig, sensor: str, motion: CarrierMotion) -> tuple[MeasuredPairs, float, float | None]:
    """The motions of an odometry and the carriers (A Y = Y B), the time offset, and its deviation if estimated.

    Raises `StampError` if the motion does not determine the time offset, `LogError` if no window is left.
    """
    track = read_odometry(log, rig, sensor)
    section = rig.odometries[sensor]
    offset_s, sigma_s = _time_offset(track, rig, motion.trajectory)
    pairs, window_s = odometry_windows(
        track, motion.trajectory, offset_s, section.odometry, rig.cleaning, rig.carriers.max_gap_s
    )
    if pairs.used.sum() < FEWEST_USED:
        removed = ", ".join(f"{why}: {count}" for why, count in pairs.count.removed.items()) or "none was removed"
        raise LogError(
            f"{rig.source.place(('sensors', sensor))}: {section.odometry.place} has {int(pairs.used.sum())} windows of "
            f"{window_s:g} s to compare with the carriers' motion, of {len(pairs.B)} ({removed}). Are both of "
            "one drive and of one clock? Else leave the sensor out"
        )
    return pairs, offset_s, sigma_s


def _time_offset(track: OdometryTrack, rig: Rig, path: Trajectory) -> tuple[float, float | None]:
    given = rig.odometries[track.sensor].time_offset
    if given != "estimate":
        return float(given), None
    stamps, B = np.asarray(track.stamps_ns), se3.inverse(np.asarray(track.T_start_sensor))
    piece = ((stamps - stamps[0]) // round(1e9 * PIECE_S)).astype(int)
    pieces = [(stamps[piece == k], B[piece == k]) for k in np.unique(piece) if (piece == k).sum() >= 2]
    found = offset_of_either_direction(path, pieces, rig.carriers.max_gap_s, track.sensor)
    return found.offset_s, found.sigma_s
