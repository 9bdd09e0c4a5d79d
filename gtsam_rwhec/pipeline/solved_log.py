"""The cleaned log with its solution in it, for viewers and for the export: written, and read back."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.logs import Log, LogWriter, PairRecord, PoseRecord, open_log
from gtsam_rwhec.logs.mcap_writer import Images
from gtsam_rwhec.pipeline.cleaning_stage import PAIR_TOPIC
from gtsam_rwhec.pipeline.log_metadata import (
    CLEANING,
    DETECTION,
    read_cameras,
    read_embedded_rig,
    write_cameras,
    write_report,
    write_rig,
)
from gtsam_rwhec.pipeline.measured_pairs import MeasuredPairs, read_pairs
from gtsam_rwhec.pipeline.solving_stage import Calibrated
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.refinement.refined import RefinedPoses
from gtsam_rwhec.results.refined_file import refined_json, refined_of
from gtsam_rwhec.results.solution_file import parse_result, solution_of
from gtsam_rwhec.results.stage_reports import LogFields
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.solving.solution import Solution
from gtsam_rwhec.vision.camera import Camera

#: Transforms that never change, so that viewers show every frame at any time.
SOLUTION_TOPIC = "/calibration/tf_static"
CERTIFICATE, RESULT = "gtsam_rwhec.certificate", "result.json"
#: Added to a frame's name where the raw log has another opinion of where it is.
CALIBRATED = "_calibrated"


@dataclass(frozen=True, eq=False)
class Solved:
    """What a solved log holds.

    Attributes
    ----------
    refined : RefinedPoses
    solution : Solution
    pairs : dict of (target, sensor) to MeasuredPairs
    log : LogFields
    cameras : dict of sensor to Camera
    rig : Rig
    """

    refined: RefinedPoses
    solution: Solution
    pairs: dict[Pair, MeasuredPairs]
    log: LogFields
    cameras: dict[str, Camera]
    rig: Rig


def write_solved(
    clean_path: str | Path, calibrated: Calibrated, out_path: str | Path, *, images: Images = "copy"
) -> None:
    """Write the cleaned log with its solution: frames as static transforms, certificate as metadata, result attached.

    Parameters
    ----------
    clean_path
        What ``clean_log`` wrote; may be `out_path`.
    calibrated : Calibrated
    out_path
    images : "copy" or "leave_out"

    Raises
    ------
    LogError
        A file cannot be read or written.
    """
    rig, refined = calibrated.rig, calibrated.refined
    replaced = {PAIR_TOPIC.format(sensor=sensor) for sensor in rig.sensors} | {SOLUTION_TOPIC}
    with open_log(clean_path) as log, LogWriter(out_path) as out:
        topics = [topic.name for topic in log.topics() if topic.name not in replaced]
        out.copy(log, topics, images)
        stamps = [int(stamp) for measured in calibrated.pairs.values() for stamp in measured.stamps_ns]
        for record in _records(calibrated.pairs):
            out.pair(record)
        taken = _raw_children(log)
        frames = [
            (rig.carriers.sensors, free_name(rig.frame_of(name), taken), pose.matrix())
            for name, pose in refined.Y.items()
        ]
        frames += [(rig.carriers.targets, free_name(name, taken), pose.matrix()) for name, pose in refined.X.items()]
        out.transforms(SOLUTION_TOPIC, min(stamps), frames)
        write_rig(out, rig)
        write_cameras(out, calibrated.cameras)
        write_report(out, DETECTION, calibrated.log.detection)
        write_report(out, CLEANING, calibrated.log.cleaning)
        certificate = refined.solution.certificate
        out.metadata(
            CERTIFICATE,
            {
                "status": certificate.status.value,
                "objective": certificate.objective,
                "cost": repr(certificate.cost),
                "lower_bound": repr(certificate.lower_bound),
                "relative_gap": repr(certificate.relative_gap),
                "free_directions": "; ".join(refined.free_directions),
            },
        )
        out.attachment(RESULT, "application/json", refined_json(refined, calibrated.log), min(stamps))


def read_solved(path: str | Path) -> Solved:
    """Read what `write_solved` wrote.

    Raises
    ------
    LogError
        It has no result in it, or not the one of its measurements.
    """
    with open_log(path) as log:
        content = log.attachment(RESULT)
        if content is None:
            raise LogError(f"{path} has no {RESULT} attached: it was not written by gtsam-rwhec solve or calibrate")
        result = parse_result(content, f"{path}, attachment {RESULT}")
        if result.log is None:
            raise LogError(f"{path}, attachment {RESULT}: it does not say which log it is of")
        rig = read_embedded_rig(log)
        refined, pairs = refined_of(result, path), read_pairs(log, rig)
    strangers = [*(set(refined.X) - set(rig.targets)), *(set(refined.Y) - set(rig.sensors))]
    if strangers or not pairs:
        why = (
            f"frames that its rig file has not: {', '.join(sorted(strangers)[:10])}" if strangers else "no measurements"
        )
        raise LogError(f"{path} has a {RESULT}, and {why}: its parts are not of one calibration")
    return Solved(refined, solution_of(result), pairs, result.log, read_cameras(log), rig)


def free_name(frame: str, taken: set[str]) -> str:
    """A frame's name, told apart from one that the raw log has already."""
    return frame + CALIBRATED if frame in taken else frame


def _raw_children(log: Log) -> set[str]:
    """Frames that the raw log says where they are."""
    topics = [t.name for t in log.topics() if not t.unreadable and t.name.rpartition("/")[2] in ("tf", "tf_static")]
    raw = [name for name in topics if name != SOLUTION_TOPIC]
    return {record.child for record in log.records(raw) if isinstance(record, PoseRecord)} if raw else set()


def _records(pairs: dict[Pair, MeasuredPairs]) -> list[PairRecord]:
    records = []
    for (target, sensor), measured in pairs.items():
        topic = PAIR_TOPIC.format(sensor=sensor)
        for i, stamp in enumerate(measured.stamps_ns.tolist()):
            covariance = None if measured.covariance is None else np.asarray(measured.covariance[i])
            reason = measured.reasons[i]
            records.append(
                PairRecord(
                    stamp, stamp, topic, target, sensor, measured.A[i], measured.B[i], not reason, reason, covariance
                )
            )
    return sorted(records, key=lambda record: record.stamp_ns)
