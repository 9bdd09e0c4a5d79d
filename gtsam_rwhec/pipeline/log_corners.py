"""The corners of a cleaned or solved log as observations, with A at each image: what ``rw.refine_corners`` takes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import DetectionRecord, open_log
from gtsam_rwhec.pipeline.log_contract import detections_topic, records_of
from gtsam_rwhec.pipeline.log_metadata import read_cameras, read_embedded_rig
from gtsam_rwhec.pipeline.measured_pairs import MeasuredPairs, read_pairs
from gtsam_rwhec.reprojection.observations import Observations

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
        Corners in pixels, with the stated intrinsics and sizes.

    Raises
    ------
    LogError
        The log cannot be read, or has no measurement with corners and intrinsics.
    """
    with open_log(path) as log:
        rig, cameras = read_embedded_rig(log), read_cameras(log)
        pairs = read_pairs(log, rig)
        detections: dict[tuple[str, str, int], DetectionRecord] = {}
        for sensor in cameras:
            for record in records_of(log, [detections_topic(sensor)], DetectionRecord):
                detections[record.id, sensor, record.stamp_ns] = record
    corners = {target.name: target.corners() for target in rig.target_list}
    views = {}
    for (target, sensor), measured in pairs.items():
        A, pixels = _views(measured, detections, len(corners[target]))
        if len(A):
            views[target, sensor] = A, pixels
    if not views:
        raise LogError(f"{path} has no measurement with corners and intrinsics; driver's poses alone have no corners")
    seen = {target: corners[target] for target, _ in views}
    return Observations.of({sensor: cameras[sensor] for _, sensor in views}, seen, views)


def _views(
    measured: MeasuredPairs, detections: Mapping[tuple[str, str, int], DetectionRecord], number: int
) -> tuple[Array, Array]:
    """A (V, 4, 4) and pixels (V, n, 2), nan where a corner was not seen, of a pair's used measurements."""
    A, pixels = [], []
    for i in np.flatnonzero(measured.used).tolist():
        record = detections.get((measured.target, measured.sensor, int(measured.stamps_ns[i])))
        if record is None or record.corners_px is None or len(record.corners_px) < FEWEST:
            continue
        seen = np.full((number, 2), np.nan)
        seen[list(record.corner_indices or range(number))] = record.corners_px
        A.append(measured.A[i])
        pixels.append(seen)
    return np.array(A).reshape(-1, 4, 4), np.array(pixels).reshape(-1, number, 2)
