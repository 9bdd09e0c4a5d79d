"""Second stage: detections and the carriers' poses to synchronised pairs (A, B); what is left out has a reason."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.cleaning import (
    ConsensusOptions,
    Kept,
    coarse_time_offset,
    consensus,
    synchronise,
    thin,
    without_fast,
)
from gtsam_rwhec.errors import LogError, StampError
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import DetectionRecord, Log, LogWriter, PairRecord, open_log
from gtsam_rwhec.logs.mcap_writer import Images
from gtsam_rwhec.pipeline.carriers import read_carriers
from gtsam_rwhec.pipeline.changed_rig import rig_for_cleaning
from gtsam_rwhec.pipeline.detection_stage import TOPIC
from gtsam_rwhec.pipeline.log_metadata import (
    CLEANING,
    DETECTION,
    read_cameras,
    read_report,
    write_cameras,
    write_report,
    write_rig,
)
from gtsam_rwhec.pipeline.stage_output import check_writable, topics_before_cleaning
from gtsam_rwhec.pipeline.tracks import Track, tracks_of
from gtsam_rwhec.results.stage_reports import CleaningReport, DetectionReport
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.trajectories.trajectory import Trajectory

PAIR_TOPIC = "/calibration/{sensor}/pairs"
#: A single measurement of a pair: nothing can validate it.
SINGLE = "a single measurement of the pair"
#: Central differences of the carriers' path, for how fast they went at a stamp.
STEP_NS = 20_000_000


def clean_log(
    detected_path: str | Path,
    out_path: str | Path,
    rig: Rig | None = None,
    *,
    images: Images = "copy",
    progress: Progress | None = None,
) -> CleaningReport:
    """Write a log of synchronised pairs.

    What the detected log has is copied; ``/calibration/<sensor>/pairs`` is new: a measured pair for every detection
    that has a pose, with what speaks against it, if anything does.

    Parameters
    ----------
    detected_path
        What ``detect_log`` wrote.
    out_path
        The MCAP file to write; may be `detected_path`.
    rig : Rig, optional
        Left out, the one that is embedded in the log.
    images : "copy" or "leave_out"
        Images that the detected log has.
    progress : callable, optional

    Raises
    ------
    LogError, StampError, TransformError
        For a log without detections or carriers' poses, clocks that have nothing in common, motion that does not tell
        a time offset; and where nothing is left.
    """
    tell = progress or silent
    check_writable(out_path)
    with open_log(detected_path) as log:
        rig = rig_for_cleaning(log, rig)
        detection = read_report(log, DETECTION, DetectionReport)
        cameras = read_cameras(log)
        tell("reading the carriers' poses")
        path = read_carriers(log, rig).trajectory
        pairs: list[PairRecord] = []
        tracks: list[Track] = []
        offsets: dict[str, float] = {}
        sigmas: dict[str, float] = {}
        for sensor in rig.sensors:
            tell(f"synchronising {sensor}")
            of_sensor = tracks_of(_detections(log, sensor), rig, sensor)
            offsets[sensor] = _offset(rig, sensor, path, of_sensor, sigmas)
            _check_overlap(of_sensor, path, sensor, offsets[sensor])
            for track in of_sensor:
                cleaned, A = clean_track(track, path, rig, offsets[sensor])
                tracks.append(cleaned)
                pairs += _pairs(cleaned, A)
        report = CleaningReport(
            tracks=tuple(track.count for track in tracks), time_offsets_s=offsets, coarse_sigma_s=sigmas
        )
        if not any(track.used for track in report.tracks):
            raise LogError(_nothing(log, report))
        tell("writing pairs")
        with LogWriter(out_path) as out:
            out.copy(log, topics_before_cleaning(log), images)
            for pair in sorted(pairs, key=lambda pair: pair.stamp_ns):
                out.pair(pair)
            write_rig(out, rig)
            write_cameras(out, cameras)
            write_report(out, DETECTION, detection)
            write_report(out, CLEANING, report)
    return report


def clean_track(track: Track, path: Trajectory, rig: Rig, offset_s: float) -> tuple[Track, Array]:
    """Synchronise a track and take out what should not be used: the track, marked, and A (N, 4, 4) at its stamps."""
    options = rig.cleaning
    A, kept = synchronise(
        path,
        track.stamps_ns,
        time_offset_s=offset_s,
        max_gap_s=rig.carriers.max_gap_s,
        needs_overlap=False,
    )
    track = _mark(track, kept, np.arange(len(A)))
    stamps = track.stamps_ns
    if options.max_rotation_deg_s is not None or options.max_translation_m_s is not None:
        at = np.flatnonzero(track.used)
        turning, moving = speeds(path, stamps[at] + round(1e9 * offset_s))
        fast = without_fast(
            turning,
            moving,
            stamps[at],
            max_turning_rad_s=_or_infinite(options.max_rotation_deg_s, np.pi / 180.0),
            max_moving_m_s=_or_infinite(options.max_translation_m_s, 1.0),
        )
        track = _mark(track, fast, at)
    if options.thin:
        at = np.flatnonzero(track.used)
        still = thin(
            A[at],
            stamps[at],
            min_rotation_rad=float(np.radians(options.min_rotation_deg)),
            min_translation_m=1e-3 * options.min_translation_mm,
        )
        track = _mark(track, still, at)
    at = np.flatnonzero(track.used)
    if len(at) == 1:
        track = track.without(track.used, [SINGLE])
    elif options.consensus and len(at):
        agreed = consensus(A[at], track.B[at], stamps[at], ConsensusOptions(scale_known=rig.sizes == "known"))
        track = _mark(track, agreed.kept, at)
    return track, A


def speeds(path: Trajectory, stamps_ns: np.ndarray) -> tuple[Array, Array]:
    """Turning (rad/s) and moving (m/s) of the carriers at stamps (N,), by central differences of their path."""
    before, _ = path.at(stamps_ns - STEP_NS)
    after, _ = path.at(stamps_ns + STEP_NS)
    step = se3.inverse(before) @ after
    seconds = 2e-9 * STEP_NS
    return (
        np.linalg.norm(se3.so3_logmap(step[:, :3, :3]), axis=1) / seconds,
        np.linalg.norm(step[:, :3, 3], axis=1) / seconds,
    )


def _offset(rig: Rig, sensor: str, path: Trajectory, tracks: list[Track], sigmas: dict[str, float]) -> float:
    """A sensor's time offset: as given, or from turning rates."""
    given = rig.sensors[sensor].time_offset
    if given != "estimate":
        return float(given)
    usable = [(track.stamps_ns[track.used], track.B[track.used]) for track in tracks if track.used.sum() >= 2]
    if not usable:
        raise StampError(
            f"{sensor}: its time offset is to be estimated, but no target was seen twice; set time_offset to what is "
            "known"
        )
    found = coarse_time_offset(path, usable, max_gap_s=rig.carriers.max_gap_s, where=sensor)
    sigmas[sensor] = found.sigma_s
    return found.offset_s


def _check_overlap(tracks: list[Track], path: Trajectory, sensor: str, offset_s: float) -> None:
    """Of all that a sensor saw something must be within the carriers' path; of each target it need not."""
    if tracks:
        stamps = np.unique(np.concatenate([track.stamps_ns for track in tracks]))
        synchronise(path, stamps, time_offset_s=offset_s, where=sensor)


def _mark(track: Track, kept: Kept, at: np.ndarray) -> Track:
    """Take over what a cleaning step removed of the measurements `at`; what is marked already keeps its reason."""
    why = {int(at[item.index]): item.reason for item in kept.removed}
    bad = np.array([i in why and not said for i, said in enumerate(track.reasons)], dtype=bool)
    return track.without(bad, [why[i] for i in np.flatnonzero(bad).tolist()])


def _detections(log: Log, sensor: str) -> list[DetectionRecord]:
    topic = TOPIC.format(sensor=sensor)
    if topic not in {t.name for t in log.topics()}:
        return []
    return [record for record in log.records([topic]) if isinstance(record, DetectionRecord)]


def _pairs(track: Track, A: Array) -> list[PairRecord]:
    """Of every measurement that has a pose."""
    topic = PAIR_TOPIC.format(sensor=track.sensor)
    return [
        PairRecord(
            logged_ns=int(stamp),
            stamp_ns=int(stamp),
            topic=topic,
            target=track.target,
            sensor=track.sensor,
            A=A[i],
            B=track.B[i],
            is_inlier=not reason,
            reason=reason,
            covariance=None if track.covariance is None else track.covariance[i],
        )
        for i, (stamp, reason) in enumerate(zip(track.stamps_ns, track.reasons, strict=True))
        if reason != "no pose"
    ]


def _nothing(log: Log, report: CleaningReport) -> str:
    said = [
        f"{track.target} in {track.sensor}: {', '.join(f'{count} {why}' for why, count in track.removed.items())}"
        for track in report.tracks
    ]
    return f"{log.files[0].path}: no measurement is left after cleaning. {'; '.join(said)}."


def _or_infinite(value: float | None, unit: float) -> float:
    return np.inf if value is None else value * unit
