"""Corners of a solved log: where cameras saw them, and where the calibration has them."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.logs import DetectionRecord, Log
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.results.image_errors import SeenView, board_of
from gtsam_rwhec.results.removed_measurements import RemovalReason
from gtsam_rwhec.runs.carrier_motion import read_carrier_motion
from gtsam_rwhec.runs.run_log import detections_topic, records_of
from gtsam_rwhec.runs.solving_stage import Solved


def seen_views(solved: Solved, log: Log) -> dict[str, list[SeenView]]:
    """The corners of detections that are used, or that robust estimation left out, with where the calibration has them.

    By camera; those that were left out are marked as not used.
    """
    path = read_carrier_motion(log, solved.rig).trajectory
    targets = {target.name: target for target in solved.rig.target_list}
    offsets = {offset.sensor: offset.offset_s for offset in solved.log.time_offsets}
    boards = {name: board_of(solved.refined, name, targets[name].corners()) for name in solved.refined.X}
    wanted = ("", RemovalReason.OUTLIER)
    is_used = {
        (pair, stamp): not reason
        for pair, measured in solved.pairs.items()
        for stamp, reason in zip(measured.stamps_ns.tolist(), measured.reasons, strict=True)
        if reason in wanted and pair.target in solved.refined.X
    }
    seen: dict[str, list[SeenView]] = defaultdict(list)
    for sensor in solved.cameras:
        if sensor not in solved.refined.Y:
            continue
        records = [
            record
            for record in records_of(log, [detections_topic(sensor)], DetectionRecord)
            if record.corners_px is not None and (Pair(record.id, sensor), record.stamp_ns) in is_used
        ]
        stamps = np.array([record.stamp_ns for record in records], dtype=np.int64)
        A, _ = path.at(stamps + round(1e9 * offsets.get(sensor, 0.0)))
        for record, T in zip(records, np.linalg.inv(solved.refined.Y[sensor].matrix()) @ A, strict=True):
            board, X = boards[record.id], solved.refined.X[record.id].matrix()
            if record.corners_px is None or (record.corner_indices is None and len(record.corners_px) != len(board)):
                continue
            corners = board if record.corner_indices is None else board[list(record.corner_indices)]  # a driver's: all
            used = is_used[Pair(record.id, sensor), record.stamp_ns]
            seen[sensor].append(SeenView.of(record.corners_px, corners, T, X, record.stamp_ns, record.id, is_used=used))
    return dict(seen)


def camera_of(solved: Solved, sensor: str) -> Camera:
    """A sensor's camera: with the intrinsics that were estimated, where they were."""
    found = solved.refined.intrinsics.get(sensor)
    return solved.cameras[sensor] if found is None else found.camera
