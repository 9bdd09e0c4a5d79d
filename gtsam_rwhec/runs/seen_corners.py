"""The corners in a log that count, with the pose of each detection: what is asked whether the rig file is right."""

from __future__ import annotations

from collections.abc import Container, Iterator
from typing import NamedTuple

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import DetectionRecord, Log
from gtsam_rwhec.runs.log_contract import detections_topic, records_of


class SeenCorners(NamedTuple):
    """A target's corners in an image: their numbers (n,), pixels (n, 2), and T_camera_target (4, 4), metres."""

    target: str
    indices: np.ndarray
    corners_px: Array
    T: Array


def seen_corners(log: Log, sensor: str, targets: Container[str]) -> Iterator[SeenCorners]:
    """The corners of a sensor's detections of some targets that were not rejected, and have corners and a pose."""
    for record in records_of(log, [detections_topic(sensor)], DetectionRecord):
        indices, pixels, T = record.corner_indices, record.corners_px, record.T_camera_tag
        if record.reason or record.id not in targets or indices is None or pixels is None or T is None:
            continue
        yield SeenCorners(record.id, np.array(indices), pixels, T)
