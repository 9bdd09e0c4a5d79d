"""The solved log: the cleaned log with its solution, for viewers and for the export; written, and read back."""

from __future__ import annotations

from pathlib import Path

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.logs import Log, LogWriter, PoseRecord, open_log
from gtsam_rwhec.logs.mcap_writer import Images
from gtsam_rwhec.results.result_file import parse_result
from gtsam_rwhec.runs.measured_pairs import read_pairs, write_pairs
from gtsam_rwhec.runs.run_log import (
    CERTIFICATE_METADATA,
    RESULT_FILE,
    SOLUTION_TOPIC,
    LogMetadata,
    image_names,
    read_cameras,
    read_embedded_rig,
    records_of,
    write_up_to_detection,
)
from gtsam_rwhec.runs.solving_stage import Calibrated, Solved

#: A calibrated frame's name gets this ending if the raw log has transforms of a frame with the same name.
CALIBRATED = "_calibrated"


def write_solved(log: Log, calibrated: Calibrated, out_path: str | Path, *, result: bytes, images: Images) -> None:
    """Write a log with its solution: frames as static transforms, certificate as metadata, result attached.

    `log` is the cleaned log, whose file may be `out_path`, the MCAP file to write; `images` says whether its images are
    written too. Raises `LogError` if the file cannot be written.
    """
    rig, refined, pairs = calibrated.rig, calibrated.refined, calibrated.pairs.values()
    with LogWriter(out_path) as out:
        write_up_to_detection(log, out, images)
        write_pairs(out, pairs)
        first_ns = min(int(measured.stamps_ns.min()) for measured in pairs)
        taken = _raw_children(log)
        frames = [(rig.carriers.sensors, rig.frame_of(name), pose.matrix()) for name, pose in refined.Y.items()]
        frames += [(rig.carriers.targets, name, pose.matrix()) for name, pose in refined.X.items()]
        # A calibrated frame gets a name of its own if the raw log has one of its name.
        named = [(parent, child + CALIBRATED if child in taken else child, T) for parent, child, T in frames]
        out.transforms(SOLUTION_TOPIC, first_ns, named)
        history = calibrated.log
        LogMetadata(rig, calibrated.cameras, history.detection, history.cleaning, image_names(log)).write(out)
        certificate = refined.solution.certificate
        out.metadata(
            CERTIFICATE_METADATA,
            {
                "status": certificate.status.value,
                "objective": str(certificate.objective),
                "cost": repr(certificate.cost),
                "lower_bound": repr(certificate.lower_bound),
                "relative_gap": repr(certificate.relative_gap),
                "free_directions": "; ".join(map(str, refined.free_directions)),
            },
        )
        out.attachment(RESULT_FILE, "application/json", result, first_ns)


def read_solved(path: str | Path) -> Solved:
    """Read the log that `write_solved` wrote.

    Raises
    ------
    LogError
        The log has no result in it, or a result that is not of its measurements.
    """
    with open_log(path) as log:
        content = log.attachment(RESULT_FILE)
        if content is None:
            raise LogError(f"{path} has no {RESULT_FILE} attached: gtsam-rwhec solve or calibrate did not write it")
        result = parse_result(content, f"{path}, attachment {RESULT_FILE}")
        if result.log is None or result.refined is None:
            raise LogError(f"{path}, attachment {RESULT_FILE}: it is not the refined calibration of a log")
        rig = read_embedded_rig(log)
        refined, pairs = result.refined, read_pairs(log, rig)
    strangers = [*(set(refined.X) - set(rig.targets)), *(set(refined.Y) - set(rig.all_sensors))]
    if strangers or not pairs:
        why = f"frames that its rig file lacks: {', '.join(sorted(strangers)[:10])}" if strangers else "no measurements"
        raise LogError(f"{path} has a {RESULT_FILE}, and {why}: they are not of one calibration")
    return Solved(refined, result.solution, pairs, result.log, read_cameras(log), rig, result.judgement)


def _raw_children(log: Log) -> set[str]:
    """Child frames of the raw log's transforms."""
    raw = [t.name for t in log.topics() if t.is_tf and not t.unreadable and t.name != SOLUTION_TOPIC]
    return {record.child for record in records_of(log, raw, PoseRecord)}
