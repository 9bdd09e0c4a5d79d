"""The corners of a cleaned or solved log as observations, with A at each image: what ``rw.refine_corners`` takes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import gtsam
import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import LogError
from gtsam_rwhec.fitting.observations import Observations
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import DetectionRecord, Log, open_log
from gtsam_rwhec.problem.corners import check_in_image
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.results.result_file import parse_result
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.carrier_motion import CarrierMotion, read_carrier_motion
from gtsam_rwhec.runs.measured_pairs import MeasuredPairs, Pairs, read_pairs
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

    def in_problem(
        self, problem: Problem, pairs: Mapping[Pair, MeasuredPairs], cameras: Mapping[str, Camera]
    ) -> Problem:
        """The problem with corners added to the used measurements of sensors with intrinsics.

        Raises CameraError if a corner is outside its image, as those of a driver may be.
        """
        every = {pair: problem.measurements(*pair) for pair in problem.pairs}
        boards, sensors = {}, {}
        for pair, raw in every.items():
            if pair.sensor not in cameras or pair.is_motion:
                continue
            seen, pixels = self.seen(pairs[pair])
            if not len(seen):
                continue
            check_in_image(pixels, cameras[pair.sensor], f"the images of {pair.sensor}")
            corners = np.full((len(raw.A), *pixels.shape[1:]), np.nan)
            corners[np.searchsorted(np.flatnonzero(pairs[pair].used), seen)] = pixels
            every[pair] = replace(raw, pixels=corners)
            boards[pair.target], sensors[pair.sensor] = self.targets[pair.target], cameras[pair.sensor]
        if not boards:
            return problem
        result = problem.with_measurements(every)
        result.boards, result.cameras = boards, sensors
        return result

    def observations(
        self,
        pairs: Mapping[Pair, MeasuredPairs],
        cameras: Mapping[str, Camera],
        motion: CarrierMotion,
        offsets_s: Mapping[str, float],
    ) -> Observations | None:
        """The used measurements that have corners, with A at `offsets_s`; None if there are none."""
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
        """Observations of some views (as `Observations.of` takes them), with the cameras and the targets' corners."""
        return Observations.of(
            {sensor: cameras[sensor] for _, sensor in views}, {name: self.targets[name] for name, _ in views}, views
        )


def read_corners(path: str | Path) -> Observations:
    """Read the corners of the used measurements, for every sensor with intrinsics and corners in the log.

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


def with_intrinsics(
    pairs: Mapping[Pair, MeasuredPairs],
    logged: LogCorners,
    cameras: Mapping[str, Camera],
    X: Mapping[str, gtsam.Pose3],
    Y: Mapping[str, gtsam.Pose3],
    corner_px: float,
) -> Pairs:
    """The pairs with B of their corners by some intrinsics: of a plane's two poses, the one near Y^-1 A X.

    Raises TargetError for a target that is not flat: it has no pose in an image alone.
    """
    views: dict[tuple[str, str], tuple[Array, Array, Array | None]] = {}
    rows, predicted = {}, {}
    for pair, measured in pairs.items():
        seen, pixels = logged.seen(measured)
        if len(seen) and pair.target in X and pair.sensor in Y:
            A = measured.A[seen]
            rows[pair], views[pair] = seen, (A, pixels, None)
            predicted[pair.target, pair.sensor] = np.linalg.inv(Y[pair.sensor].matrix()) @ A @ X[pair.target].matrix()
    changed = dict(pairs)
    if not views:
        return changed
    found = replace(logged.of_views(views, cameras), corner_px=corner_px).poses(predicted)
    for pair, seen in rows.items():
        measured, poses = pairs[pair], found.measurements(*pair)
        B = measured.B.copy()
        B[seen] = poses.B
        covariance = None if measured.covariance is None else measured.covariance.copy()
        if covariance is not None and poses.covariances is not None:
            covariance[seen] = poses.covariances
        changed[pair] = replace(measured, B=B, covariance=covariance)
    return changed
