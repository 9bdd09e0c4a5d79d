"""The second stage: from detections and the carriers' motion to a log of synchronised pairs (A, B)."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from gtsam_rwhec.errors import LogError, LogWarning, StampError
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.logs import Log, open_log
from gtsam_rwhec.logs.mcap_writer import Images
from gtsam_rwhec.results.log_history import CleaningReport, Kept, RemovalReason
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.carrier_motion import read_carrier_motion
from gtsam_rwhec.runs.changed_rig import rig_for_cleaning
from gtsam_rwhec.runs.clocks_by_turning import offset_of_either_direction
from gtsam_rwhec.runs.measured_pairs import MeasuredPairs, detected_pairs, pair_records
from gtsam_rwhec.runs.odometry_cleaning import odometry_steps
from gtsam_rwhec.runs.odometry_motions import odometry_pairs, read_odometry
from gtsam_rwhec.runs.output_folder import check_writable
from gtsam_rwhec.runs.pair_consensus import ConsensusOptions, find_consensus
from gtsam_rwhec.runs.run_log import RunLog, read_cleaning_report, write_run_log

#: Nanoseconds. The carriers' speed at a stamp is measured from this time before it to this time after it.
SPEED_STEP_NS = 20_000_000


@one_blas_thread()
def clean_log(
    detected_path: str | Path,
    out_path: str | Path,
    rig: Rig | None = None,
    *,
    images: Images = "copy",
    progress: Progress | None = None,
) -> CleaningReport:
    """Synchronise detections with the carriers' poses, clean them, and write a log with the pairs.

    The messages of the detected log are copied. The stage adds the topics ``/calibration/<sensor>/pairs``: a measured
    pair (A, B) for every detection with a pose, and the reason if it is not used.

    Parameters
    ----------
    detected_path
        The log that ``detect_log`` wrote.
    out_path
        The MCAP file to write; may be `detected_path`.
    rig : Rig, optional
        The default is the rig file embedded in the log.
    images : "copy" or "leave_out"
        Whether the written log has the images of the detected log.
    progress : callable, optional

    Raises
    ------
    LogError, StampError, TransformError
        The log has no detections or no carriers' poses; its clocks have no time in common; the motion does not
        determine a time offset of any sensor; or no measurement is left.

    Warns
    -----
    LogWarning
        The motion does not determine the time offset of a sensor; the others are cleaned without it.
    """
    check_writable(out_path)
    with open_log(detected_path) as log:
        found = cleaned(log, rig, progress)
        (progress or silent)("writing pairs")
        write_run_log(found, out_path, images)
    return read_cleaning_report(found)


def cleaned(log: Log, rig: Rig | None = None, progress: Progress | None = None) -> RunLog:
    """The log with the pairs, as `clean_log` writes it."""
    tell = progress or silent
    rig = rig_for_cleaning(log, rig)
    tell("reading the carriers' poses")
    motion = read_carrier_motion(log, rig)
    path = motion.trajectory
    pairs: list[MeasuredPairs] = []
    offsets_s: dict[str, float] = {}
    sigmas_s: dict[str, float] = {}
    unknown: dict[str, StampError] = {}
    for sensor in rig.sensors:
        tell(f"synchronising {sensor}")
        tracks = detected_pairs(log, rig, sensor)
        try:
            offsets_s[sensor], sigma_s = _time_offset(rig, sensor, path, tracks)
        except StampError as error:  # the other sensors have an answer without this one
            unknown[sensor] = error
            pairs += [clean_track(track.without(RemovalReason.CLOCK_UNKNOWN), path, rig, 0.0) for track in tracks]
            continue
        if sigma_s is not None:
            sigmas_s[sensor] = sigma_s
        if tracks:  # refuses a sensor if all its stamps are outside the carriers' path; a single target may be outside
            stamps = np.unique(np.concatenate([track.stamps_ns for track in tracks]))
            synchronise(path, stamps, time_offset_s=offsets_s[sensor], where=sensor)
        pairs += [clean_track(track, path, rig, offsets_s[sensor]) for track in tracks]
    if rig.is_of_odometries:
        assert rig.reference is not None
        reference = read_odometry(log, rig, rig.reference)
        for sensor, section in rig.odometries.items():
            tell(f"cleaning {sensor}")
            pairs.append(odometry_steps(log, rig, reference, sensor))
            offsets_s[sensor] = 0.0 if section.time_offset == "estimate" else float(section.time_offset)
    for sensor in (name for name in rig.odometries if name != rig.reference and not rig.is_of_odometries):
        tell(f"comparing the motions of {sensor}")
        motions, offsets_s[sensor], sigma_s = odometry_pairs(log, rig, sensor, motion)
        if sigma_s is not None:
            sigmas_s[sensor] = sigma_s
        pairs.append(motions)
    report = CleaningReport(
        tracks=tuple(measured.count for measured in pairs), time_offsets_s=offsets_s, coarse_sigma_s=sigmas_s
    )
    if not any(track.used for track in report.tracks):
        if unknown:
            raise next(iter(unknown.values()))
        raise LogError(
            f"{log.files[0].path}: no measurement is left after cleaning. {'; '.join(map(str, report.tracks))}."
        )
    for why in unknown.values():
        warnings.warn(f"none of the measurements is used of {why}", LogWarning, stacklevel=3)
    return RunLog.with_pairs(log, report, rig, pair_records(pairs))


def clean_track(track: MeasuredPairs, path: Trajectory, rig: Rig, offset_s: float) -> MeasuredPairs:
    """Synchronise a track with the carriers' path, and give a reason to each measurement that is not used."""
    options = rig.cleaning
    A, kept = synchronise(
        path, track.stamps_ns, time_offset_s=offset_s, max_gap_s=rig.carriers.max_gap_s, needs_overlap=False
    )
    pairs = replace(track, A=A).marked(kept, np.arange(len(A)))
    stamps = pairs.stamps_ns
    if options.max_rotation_deg_s is not None or options.max_translation_m_s is not None:
        at = np.flatnonzero(pairs.used)
        turning, moving = path.speeds(stamps[at] + round(1e9 * offset_s), SPEED_STEP_NS)
        turning_limit_deg_s, moving_limit_m_s = (
            np.inf if limit is None else limit for limit in (options.max_rotation_deg_s, options.max_translation_m_s)
        )
        fast = without_fast(
            turning,
            moving,
            stamps[at],
            max_turning_rad_s=float(np.radians(turning_limit_deg_s)),
            max_moving_m_s=moving_limit_m_s,
        )
        pairs = pairs.marked(fast, at)
    if options.thin:
        at = np.flatnonzero(pairs.used)
        moved = thin(
            A[at],
            stamps[at],
            min_rotation_rad=float(np.radians(options.min_rotation_deg)),
            min_translation_m=1e-3 * options.min_translation_mm,
        )
        pairs = pairs.marked(moved, at)
    at = np.flatnonzero(pairs.used)
    # Nothing can validate a single measurement. Clouds agreed when they were registered, some in few directions only.
    if len(at) == 1 or (options.consensus and len(at) and track.target != rig.object):
        found = find_consensus(A[at], pairs.B[at], stamps[at], ConsensusOptions(scale_known=rig.sizes == "known"))
        pairs = pairs.marked(found.kept, at)
    return pairs


def _time_offset(rig: Rig, sensor: str, path: Trajectory, tracks: list[MeasuredPairs]) -> tuple[float, float | None]:
    """A sensor's time offset, as stated or estimated from rotations, and an estimate's standard deviation."""
    given = rig.sensors[sensor].time_offset
    if given != "estimate":
        return float(given), None
    usable = [(track.stamps_ns[track.used], track.B[track.used]) for track in tracks if track.used.sum() >= 2]
    if not usable:
        raise StampError(
            f"{sensor}: no target was seen twice, and without this the time offset cannot be estimated; state "
            "time_offset in the rig file"
        )
    found = offset_of_either_direction(path, usable, rig.carriers.max_gap_s, sensor)
    return found.offset_s, found.sigma_s


#: Seconds. Poses further apart than this are not interpolated: an arm at 1 m/s moves 20 cm in this time.
MAX_GAP_S = 0.2


def synchronise(
    carrier: Trajectory,
    stamps_ns: np.ndarray,
    *,
    time_offset_s: float = 0.0,
    max_gap_s: float = MAX_GAP_S,
    where: str = "the sensor",
    needs_overlap: bool = True,
) -> tuple[Array, Kept]:
    """Interpolate the carrier's pose at each stamp of a sensor.

    The sensor's stamp t is the carrier's t + `time_offset_s` (Kalibr's convention). Poses further apart in time than
    `max_gap_s` are not interpolated. `where` is the sensor, for messages. Returns A (M, 4, 4), metres, of the stamps
    that are kept, and which stamps were removed: those outside the trajectory or in its gaps.

    Raises
    ------
    StampError
        No stamp is inside the trajectory, and `needs_overlap` is true. Most often the clocks differ.
    """
    stamps = np.asarray(stamps_ns, dtype=np.int64)
    A, gap_s = carrier.at(stamps + round(time_offset_s * 1e9))
    outside = np.isinf(gap_s)
    first, last = carrier.span_s
    if needs_overlap and len(stamps) and outside.all():
        raise StampError(
            f"no overlap in time: {carrier.where} is from {first:.3f} to {last:.3f} s, the stamps of {where} (with its "
            f"time offset of {time_offset_s:g} s) are from {stamps.min() * 1e-9 + time_offset_s:.3f} to "
            f"{stamps.max() * 1e-9 + time_offset_s:.3f} s. Are they of different clocks? If the clocks' difference is "
            "constant and known, give it as the sensor's time offset"
        )
    limits = np.where(stamps > carrier.stamps_ns[0], last, first)
    return A, Kept.by_all(
        Kept.of(outside, RemovalReason.OUTSIDE_TRAJECTORY, stamps, stamps * 1e-9, limits),
        Kept.of(gap_s > max_gap_s, RemovalReason.GAP, stamps, gap_s, max_gap_s),
    )


#: Radians. A carrier that has turned and moved less than this since the last measurement kept has stood still.
STILL_RAD = float(np.radians(0.5))
#: Metres; see `STILL_RAD`.
STILL_M = 0.003


def thin(
    A: Array, stamps_ns: np.ndarray, *, min_rotation_rad: float = STILL_RAD, min_translation_m: float = STILL_M
) -> Kept:
    """Keep a measurement if the carrier has turned or moved since the last measurement that was kept.

    A hundred images at one pose have a hundred times the weight of one, but all share the error of that pose (A). A
    covariance that assumes independent images is then too small. A (N, 4, 4) has the carrier's poses, in order of time.
    """
    bad = np.zeros(len(A), dtype=bool)
    moved = np.zeros(len(A))
    last = 0
    # |R - R'|_F = sqrt(8) sin(angle / 2), so the comparison with a limit needs no logarithm.
    limit = np.sqrt(8.0) * np.sin(0.5 * min(min_rotation_rad, np.pi))
    R, t = A[:, :3, :3], A[:, :3, 3]
    for i in range(1, len(A)):
        moved[i] = np.sqrt(((t[i] - t[last]) ** 2).sum())
        if moved[i] < min_translation_m and ((R[i] - R[last]) ** 2).sum() < limit**2:
            bad[i] = True
        else:
            last = i
    return Kept.of(bad, RemovalReason.STANDSTILL, stamps_ns, moved, min_translation_m)


def without_fast(
    turning_rad_s: Array, moving_m_s: Array, stamps_ns: np.ndarray, *, max_turning_rad_s: float, max_moving_m_s: float
) -> Kept:
    """Keep the measurements at low speed: fast motion blurs images, and errors of stamps count more.

    The first two (N,) are the carrier's speeds at each measurement.
    """
    return Kept.within(
        stamps_ns,
        (RemovalReason.TURNING_FAST, turning_rad_s, max_turning_rad_s),
        (RemovalReason.MOVING_FAST, moving_m_s, max_moving_m_s),
    )
