"""Corners of a solved log for pictures: where they were seen, how far off they are, what stays in the refinement."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.fitting.projection_uncertainty import lens_deviations_over
from gtsam_rwhec.fitting.reprojection_record import Reprojection
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import DetectionRecord, Log
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.report.plots import PlottedCorners, PlottedIntrinsics
from gtsam_rwhec.results.image_errors import SeenView, board_of, errors_as_measured, errors_at_optimum
from gtsam_rwhec.results.removed_measurements import RemovalReason
from gtsam_rwhec.runs.carrier_motion import read_carrier_motion
from gtsam_rwhec.runs.log_contract import detections_topic, records_of
from gtsam_rwhec.runs.solving_stage import Solved


def seen_views(solved: Solved, log: Log, *, left_out: bool = False) -> dict[str, list[SeenView]]:
    """The corners of used detections, with where the calibration has them, by camera.

    With `left_out` those that robust estimation left out are there too, marked as not used.
    """
    path = read_carrier_motion(log, solved.rig).trajectory
    targets = {target.name: target for target in solved.rig.target_list}
    offsets = {offset.sensor: offset.offset_s for offset in solved.log.time_offsets}
    boards = {name: board_of(solved.refined, name, targets[name].corners()) for name in solved.refined.X}
    wanted = ("", RemovalReason.OUTLIER) if left_out else ("",)
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


def plotted_corners(solved: Solved, seen: dict[str, list[SeenView]]) -> dict[str, PlottedCorners]:
    """The corners, and their reprojection errors under the calibration, by camera."""
    return {
        sensor: PlottedCorners(
            np.concatenate([view.pixels for view in views]),
            np.concatenate([errors_as_measured(camera_of(solved, sensor), view).px for view in views]),
        )
        for sensor, views in seen.items()
    }


def plotted_intrinsics(solved: Solved, seen: dict[str, list[SeenView]]) -> dict[str, PlottedIntrinsics]:
    """What is known of each camera whose intrinsics were estimated."""
    numbers = solved.refined.reprojection
    result: dict[str, PlottedIntrinsics] = {}
    if numbers is None:
        return result
    for sensor, found in solved.refined.intrinsics.items():
        views = seen.get(sensor, [])
        if not views:
            continue
        points = np.concatenate([view.points for view in views])
        distance_m = found.projection_m or float(np.median(points[:, 2]))
        covariance = solved.refined.covariance(f"intrinsics:{sensor}")
        grid, deviations = lens_deviations_over(found.camera, covariance, points, distance_m, steps=40)
        corners, image = residuals_of(found.camera, views, numbers)
        result[sensor] = PlottedIntrinsics(
            (found.width, found.height), corners, image, grid, deviations, distance_m,
            numbers.sensors[sensor].regions_px,
        )  # fmt: skip
    return result


def residuals_of(camera: Camera, views: list[SeenView], found: Reprojection) -> tuple[PlottedCorners, np.ndarray]:
    """Errors of corners at the optimum, and the stamp (N,) of each one's image.

    `errors_at_optimum` says how. Corners that are far off do not count.
    """
    pixels: list[Array] = [np.zeros((0, 2))]
    errors: list[Array] = [np.zeros((0, 2))]
    image: list[np.ndarray] = [np.zeros(0, dtype=np.int64)]
    for view in views:
        off = errors_at_optimum(camera, view, found)
        if off is not None:
            pixels.append(view.pixels[off.counts])
            errors.append(off.px[off.counts])
            image.append(np.full(len(pixels[-1]), view.stamp_ns))
    return PlottedCorners(np.concatenate(pixels), np.concatenate(errors)), np.concatenate(image)
