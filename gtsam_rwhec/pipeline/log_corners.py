"""The corners of a cleaned or solved log as observations, with A at each image: what ``rw.refine_corners`` takes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import DetectionRecord, Log, open_log
from gtsam_rwhec.pipeline.carrier_motion import read_carrier_motion
from gtsam_rwhec.pipeline.log_contract import RESULT_FILE, detections_topic, records_of
from gtsam_rwhec.pipeline.log_metadata import read_cameras, read_cleaning_report, read_embedded_rig
from gtsam_rwhec.pipeline.measured_pairs import MeasuredPairs, read_pairs
from gtsam_rwhec.reprojection.observations import Observations
from gtsam_rwhec.results.result_file import parse_result

#: Fewer corners than this determine no pose.
FEWEST = 4


def read_corners(path: str | Path) -> Observations:
    """The corners of the measurements that are used, of every sensor whose intrinsics and corners the log has.

    Parameters
    ----------
    path
        The log that ``clean_log`` or ``solve_log`` wrote, such as ``clean.mcap``. Of a solved log, A is at the time
        offsets of the answer, and outliers are left out.

    Returns
    -------
    Observations
        Corners in pixels, with the stated intrinsics and sizes, and the carriers' velocity at each image where the log
        has poses at a higher rate.

    Raises
    ------
    LogError
        The log cannot be read, or has no measurement with corners and intrinsics.
    """
    with open_log(path) as log:
        rig, cameras = read_embedded_rig(log), read_cameras(log)
        pairs = read_pairs(log, rig)
        motion, offsets_s = read_carrier_motion(log, rig), _offsets_s(log)
        detections: dict[tuple[str, str, int], DetectionRecord] = {}
        for sensor in cameras:
            for record in records_of(log, [detections_topic(sensor)], DetectionRecord):
                detections[record.id, sensor, record.stamp_ns] = record
    corners = {target.name: target.corners() for target in rig.target_list}
    views = {}
    for (target, sensor), measured in pairs.items():
        seen, pixels = _seen(measured, detections, len(corners[target]))
        if len(seen):
            at_ns = measured.stamps_ns[seen] + round(1e9 * offsets_s.get(sensor, 0.0))
            views[target, sensor] = measured.A[seen], pixels, motion.velocities(at_ns)
    if not views:
        raise LogError(f"{path} has no measurement with corners and intrinsics; driver's poses alone have no corners")
    of_targets = {target: corners[target] for target, _ in views}
    return Observations.of({sensor: cameras[sensor] for _, sensor in views}, of_targets, views)


def _offsets_s(log: Log) -> dict[str, float]:
    """The time offsets at which the log's A was taken, by sensor, seconds."""
    content = log.attachment(RESULT_FILE)
    if content is None:
        return read_cleaning_report(log).time_offsets_s
    result = parse_result(content, f"{log.files[0].path}, attachment {RESULT_FILE}")
    return {} if result.log is None else {offset.sensor: offset.offset_s for offset in result.log.time_offsets}


def _seen(
    measured: MeasuredPairs, detections: Mapping[tuple[str, str, int], DetectionRecord], number: int
) -> tuple[np.ndarray, Array]:
    """A pair's used measurements with corners (V,), and their pixels (V, n, 2), nan where a corner was not seen."""
    which, pixels = [], []
    for i in np.flatnonzero(measured.used).tolist():
        record = detections.get((measured.target, measured.sensor, int(measured.stamps_ns[i])))
        if record is None or record.corners_px is None or len(record.corners_px) < FEWEST:
            continue
        corners = np.full((number, 2), np.nan)
        corners[list(record.corner_indices or range(number))] = record.corners_px
        which.append(i)
        pixels.append(corners)
    return np.array(which, dtype=int), np.array(pixels).reshape(-1, number, 2)
