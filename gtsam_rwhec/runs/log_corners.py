"""The corners of a cleaned or solved log as observations, with A at each image: what ``rw.refine_corners`` takes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import LogError
from gtsam_rwhec.fitting.observations import Observations
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import DetectionRecord, Log, open_log
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.results.result_file import parse_result
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.carrier_motion import CarrierMotion, read_carrier_motion
from gtsam_rwhec.runs.measured_pairs import MeasuredPairs, read_pairs
from gtsam_rwhec.runs.run_log import (
    RESULT_FILE,
    detections_topic,
    read_cameras,
    read_cleaning_report,
    read_embedded_rig,
    records_of,
)

#: Fewer corners than this determine no pose.
FEWEST = 4


@dataclass(frozen=True, eq=False)
class LogCorners:
    """The corners of a log's detections, by (target, sensor, stamp), and the targets' own corners (n, 3), metres."""

    detections: Mapping[tuple[str, str, int], DetectionRecord]
    targets: Mapping[str, Array]

    @staticmethod
    def of(log: Log, rig: Rig, sensors: Iterable[str]) -> LogCorners:
        """Read the detections of some sensors."""
        detections = {
            (record.id, sensor, record.stamp_ns): record
            for sensor in sensors
            for record in records_of(log, [detections_topic(sensor)], DetectionRecord)
            if record.corners_px is not None and len(record.corners_px) >= FEWEST
        }
        return LogCorners(detections, {target.name: target.corners() for target in rig.target_list})

    def lacking(self, pairs: Mapping[Pair, MeasuredPairs]) -> tuple[Pair, ...]:
        """Pairs with used measurements none of which has corners."""
        return tuple(
            pair for pair, measured in pairs.items() if measured.used.any() and not len(self.seen(measured)[0])
        )

    def without_corners(self, pairs: Mapping[Pair, MeasuredPairs]) -> dict[Pair, int]:
        """How many used measurements have no corners, of the pairs of which some have."""
        missing = {
            pair: int(measured.used.sum()) - number
            for pair, measured in pairs.items()
            if (number := len(self.seen(measured)[0]))
        }
        return {pair: number for pair, number in missing.items() if number}

    def seen(self, measured: MeasuredPairs) -> tuple[np.ndarray, Array]:
        """A pair's used measurements with corners (V,), and their pixels (V, n, 2), nan where a corner was not seen."""
        number = len(self.targets[measured.target])
        which, pixels = [], []
        for i in np.flatnonzero(measured.used).tolist():
            record = self.detections.get((measured.target, measured.sensor, int(measured.stamps_ns[i])))
            if record is None or record.corners_px is None:
                continue
            corners = np.full((number, 2), np.nan)
            corners[list(record.corner_indices or range(number))] = record.corners_px
            which.append(i)
            pixels.append(corners)
        return np.array(which, dtype=int), np.array(pixels).reshape(-1, number, 2)

    def observations(
        self,
        pairs: Mapping[Pair, MeasuredPairs],
        cameras: Mapping[str, Camera],
        motion: CarrierMotion,
        offsets_s: Mapping[str, float],
    ) -> Observations | None:
        """The used measurements with corners, with A at time offsets in seconds; None where there is none."""
        views: dict[tuple[str, str], tuple[Array, Array, Array | None]] = {}
        for pair, measured in pairs.items():
            seen, pixels = self.seen(measured)
            if len(seen):
                at_ns = measured.stamps_ns[seen] + round(1e9 * offsets_s.get(pair.sensor, 0.0))
                views[pair] = measured.A[seen], pixels, motion.velocities(at_ns)
        return self.of_views(views, cameras) if views else None

    def of_views(
        self, views: Mapping[tuple[str, str], tuple[Array, Array, Array | None]], cameras: Mapping[str, Camera]
    ) -> Observations:
        """Views as `Observations.of` takes them, with the targets' corners."""
        return Observations.of(
            {sensor: cameras[sensor] for _, sensor in views}, {name: self.targets[name] for name, _ in views}, views
        )


def read_corners(path: str | Path) -> Observations:
    """The corners of the measurements that are used, of every sensor whose intrinsics and corners the log has.

    Parameters
    ----------
    path
        The log that ``clean_log`` or ``solve_into`` wrote, such as ``calibration.mcap``. Of a solved log, A is at the
        time offsets of the answer, and outliers are left out.

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
        corners, pairs = LogCorners.of(log, rig, cameras), read_pairs(log, rig)
        motion, offsets_s = read_carrier_motion(log, rig), _offsets_s(log)
    with_cameras = {pair: measured for pair, measured in pairs.items() if pair.sensor in cameras}
    found = corners.observations(with_cameras, cameras, motion, offsets_s)
    if found is None:
        raise LogError(f"{path} has no measurement with corners and intrinsics; driver's poses alone have no corners")
    return found


def _offsets_s(log: Log) -> dict[str, float]:
    """The time offsets at which the log's A was taken, by sensor, seconds."""
    content = log.attachment(RESULT_FILE)
    if content is None:
        return read_cleaning_report(log).time_offsets_s
    result = parse_result(content, f"{log.files[0].path}, attachment {RESULT_FILE}")
    return {} if result.log is None else {offset.sensor: offset.offset_s for offset in result.log.time_offsets}
