"""Corners of a solved log for pictures: where they were seen, how far off they are, what stays in the refinement."""

from __future__ import annotations

from collections import defaultdict
from typing import NamedTuple

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import DetectionRecord, Log
from gtsam_rwhec.pipeline.carrier_motion import read_carrier_motion
from gtsam_rwhec.pipeline.log_contract import detections_topic, records_of
from gtsam_rwhec.pipeline.solving_stage import Solved
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.refinement.refined import RefinedPoses
from gtsam_rwhec.refinement.reprojection_found import SIZE, WARPS, Reprojection
from gtsam_rwhec.report.plots import PlottedCorners, PlottedIntrinsics
from gtsam_rwhec.reprojection.corner_views import shaped
from gtsam_rwhec.reprojection.projection_uncertainty import lens_deviations_over
from gtsam_rwhec.vision.camera import Camera

#: Fewer corners than this in an image say nothing beside its pose.
FEWEST = 4
#: A corner is far off beyond so many times the median of its image, or the noise.
FAR = 6.0


class SeenView(NamedTuple):
    """A target's corners in an image: pixels (n, 2), and the same points (n, 3) in the camera's frame, metres.

    With the points' derivatives (n, 3, 6) by A Expmap([omega, v]), and the image's stamp.
    """

    pixels: Array
    points: Array
    by_A: Array
    stamp_ns: int

    @staticmethod
    def of(
        pixels: Array, corners: Array, T_camera_targetcarrier: Array, T_targetcarrier_target: Array, stamp_ns: int
    ) -> SeenView:
        """Of corners (n, 3) in the target's frame."""
        Q = corners @ T_targetcarrier_target[:3, :3].T + T_targetcarrier_target[:3, 3]
        R = T_camera_targetcarrier[:3, :3]
        by_xi = np.concatenate([-se3.hat(Q), np.broadcast_to(np.eye(3), (len(Q), 3, 3))], axis=2)
        return SeenView(pixels, Q @ R.T + T_camera_targetcarrier[:3, 3], R @ by_xi, stamp_ns)


def seen_views(solved: Solved, log: Log) -> dict[str, list[SeenView]]:
    """The corners of used detections, with where the calibration has them, by camera."""
    path = read_carrier_motion(log, solved.rig).trajectory
    targets = {target.name: target for target in solved.rig.target_list}
    offsets = {offset.sensor: offset.offset_s for offset in solved.log.time_offsets}
    boards = {name: board_of(solved.refined, name, targets[name].corners()) for name in solved.refined.X}
    used = {
        (pair, int(stamp))
        for pair, measured in solved.pairs.items()
        for stamp in measured.stamps_ns[measured.used].tolist()
    }
    seen: dict[str, list[SeenView]] = defaultdict(list)
    for sensor in solved.cameras:
        if sensor not in solved.refined.Y:
            continue
        inverse = np.linalg.inv(solved.refined.Y[sensor].matrix())
        for record in records_of(log, [detections_topic(sensor)], DetectionRecord):
            pair = Pair(record.id, sensor)
            if record.corners_px is None or record.corner_indices is None or (pair, record.stamp_ns) not in used:
                continue
            A, _ = path.at(np.array([record.stamp_ns + round(1e9 * offsets.get(sensor, 0.0))]))
            corners = boards[record.id][list(record.corner_indices)]
            X = solved.refined.X[record.id].matrix()
            seen[sensor].append(SeenView.of(record.corners_px, corners, inverse @ A[0], X, record.stamp_ns))
    return dict(seen)


def board_of(refined: RefinedPoses, target: str, corners: Array) -> Array:
    """A target's corners (n, 3) as they were found to be: larger or smaller than stated, and bent."""
    scale = refined.scale if isinstance(refined.scale, float) else refined.scale[target]
    shape = np.array([1.0 / scale - 1.0, 0.0, 0.0])
    found = None if refined.reprojection is None else refined.reprojection.boards.get(target)
    if found is not None:
        for name, value in zip(found.names, found.values, strict=True):
            if name != SIZE and name in WARPS.values():
                shape[1 + list(WARPS.values()).index(name)] = value
    board = shaped(corners, shape)[0]
    return board + np.array(found.corners_off_m) if found is not None and found.corners_off_m else board


def camera_of(solved: Solved, sensor: str) -> Camera:
    """A sensor's camera: with the intrinsics that were estimated, where they were."""
    found = solved.refined.intrinsics.get(sensor)
    return solved.cameras[sensor] if found is None else found.camera


def plotted_corners(solved: Solved, seen: dict[str, list[SeenView]]) -> dict[str, PlottedCorners]:
    """The corners, and their reprojection errors under the calibration, by camera."""
    return {
        sensor: PlottedCorners(
            np.concatenate([view.pixels for view in views]),
            np.concatenate([view.pixels - camera_of(solved, sensor).project(view.points) for view in views]),
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

    A of each image is off there by what its noise and its corners together say.
    With the derivatives J of the pixels by A's errors over their deviations, and residuals r over the corners' noise:
    r - J (J' J + I)^-1 J' r, to first order. Corners that are far off do not count.
    """
    deviations = np.repeat([found.carrier_rotation_rad, found.carrier_translation_m], 3)
    pixels: list[Array] = [np.zeros((0, 2))]
    errors: list[Array] = [np.zeros((0, 2))]
    image: list[np.ndarray] = [np.zeros(0, dtype=np.int64)]
    for view in views:
        P = view.points
        x = P[:, :2] / P[:, 2:]
        predicted, by_x = camera.pixel_jacobian(x)
        off = view.pixels - predicted
        if len(P) < FEWEST or not (np.isfinite(off).all() and (P[:, 2] > 0.0).all()):
            continue
        to_x = np.concatenate([np.broadcast_to(np.eye(2), (len(P), 2, 2)), -x[:, :, None]], axis=2)
        J = by_x @ (to_x / P[:, 2, None, None]) @ view.by_A * deviations / found.corner_px
        length = np.linalg.norm(_at_optimum(J, off), axis=1)
        kept = length <= FAR * max(float(np.median(length)), found.corner_px)
        if kept.sum() >= FEWEST:
            pixels.append(view.pixels[kept])
            errors.append(_at_optimum(J[kept], off[kept]))
            image.append(np.full(len(pixels[-1]), view.stamp_ns))
    return PlottedCorners(np.concatenate(pixels), np.concatenate(errors)), np.concatenate(image)


def _at_optimum(J: Array, errors: Array) -> Array:
    """Errors (n, 2) without what A's errors explain, of their derivatives (n, 2, 6) in deviations."""
    flat = J.reshape(-1, 6)
    explained = flat @ np.linalg.solve(flat.T @ flat + np.eye(6), flat.T @ errors.ravel())
    left: Array = errors - explained.reshape(-1, 2)
    return left
