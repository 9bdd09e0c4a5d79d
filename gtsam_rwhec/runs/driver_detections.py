"""The detections of a driver. Poses come from its corners and the rig file's sizes, or from the driver."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.target_poses import plane_poses
from gtsam_rwhec.cameras.targets import Target
from gtsam_rwhec.detect.detections import Rejection
from gtsam_rwhec.errors import CameraError, LogError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import DetectionRecord, Log
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.carrier_motion import check_order
from gtsam_rwhec.runs.image_detections import SensorDetections, message_count
from gtsam_rwhec.runs.tracks import target_of

#: A driver's corners are assumed to have this standard deviation (pixels), which drivers do not state. If the noise is
#: estimated, only the proportions between covariances count.
CORNER_PX = 0.1
#: Two sizes are the same if they differ by less than this share: some messages have them in single precision.
SAME_SIZE = 1e-4


def read_driver_detections(log: Log, rig: Rig, sensor: str, camera: Camera | None) -> SensorDetections:
    """Read the detections of a sensor from the topic of its driver.

    With intrinsics, poses are computed from the corners and the rig file's sizes; the driver may have used other
    sizes. The corners of a plane fit two poses. The one nearer to the driver's pose is taken, or, without a driver's
    pose, the one with the smaller reprojection error. Without intrinsics, the driver's poses and sizes are taken.

    Raises `LogError` if the topic is missing or has no detections, or if the driver made poses with a size other than
    the rig file's; `StampError` as `check_order`; `CameraError` if there are neither poses nor intrinsics.
    """
    source = rig.sensors[sensor]
    assert source.detections is not None
    result: list[DetectionRecord] = []
    targets: list[Target] = []
    strangers: Counter[tuple[str, str]] = Counter()
    messages: dict[tuple[int, int], None] = {}
    for record in log.records([source.detections]):
        if not isinstance(record, DetectionRecord):
            raise LogError(f"topic {source.detections} has no detections but {type(record).__name__}s")
        messages[record.logged_ns, record.stamp_ns] = None
        target = target_of(record, rig.target_list)
        if target is None:
            strangers[record.family or "tag", record.id] += 1
            continue
        result.append(_as_told(record, target, camera, sensor))
        targets.append(target)
    check_order(np.array([stamp for _, stamp in messages], dtype=np.int64), f"topic {source.detections}")
    if camera is not None:
        result = _by_corners(result, targets, camera)
    return SensorDetections(result, message_count(log, source.detections), strangers)


def _as_told(record: DetectionRecord, target: Target, camera: Camera | None, sensor: str) -> DetectionRecord:
    """The driver's record with the rig file's names and sizes, and corners in our order if poses come from them."""
    driver_m = record.size_m
    record = replace(record, id=target.name, family=target.family, size_m=target.length_m)
    if _has_corners(record, camera):
        assert record.corners_px is not None
        # The refinement from corners reads them too.
        return replace(record, corners_px=_in_our_order(record.corners_px))
    if record.T_camera_tag is None:
        raise CameraError(
            f"topic {record.topic}, stamp {record.stamp_ns} ns: the driver gives no pose of {target.name}, and "
            f"sensor {sensor} has no intrinsics from which to make one"
        )
    if driver_m is not None and not np.isclose(driver_m, target.length_m, rtol=SAME_SIZE, atol=0.0):
        raise LogError(
            f"topic {record.topic}, stamp {record.stamp_ns} ns: the driver made its pose of {target.name} with a "
            f"size of {driver_m:g} m, and the rig file says {target.length_m:g} m. Give the driver's size in the "
            f"rig file, or the intrinsics of sensor {sensor}: with them poses are computed from corners"
        )
    return record


def _has_corners(record: DetectionRecord, camera: Camera | None) -> bool:
    return camera is not None and record.corners_px is not None and len(record.corners_px) == 4


def _by_corners(records: list[DetectionRecord], targets: list[Target], camera: Camera) -> list[DetectionRecord]:
    """The records with poses from their corners, all at once; those without corners stay as they are."""
    at = [i for i, record in enumerate(records) if _has_corners(record, camera)]
    corners_px = [records[i].corners_px for i in at]
    poses = plane_poses(camera, [targets[i].corners() for i in at], corners_px, corner_px=CORNER_PX)  # type: ignore[arg-type]
    result = list(records)
    for row, i in enumerate(at):
        T, covariance = poses.T[row], poses.covariance[row]
        which = _nearer(T, records[i].T_camera_tag)
        if not np.isfinite(T[which]).all() or not np.isfinite(covariance[which]).all():
            result[i] = replace(records[i], T_camera_tag=None, covariance=None, reason=Rejection.NO_POSE)
            continue
        result[i] = replace(
            records[i],
            T_camera_tag=T[which],
            covariance=covariance[which],
            reprojection_px=float(poses.reprojection_px[row, which]),
        )
    return result


def _nearer(T: Array, of_driver: Array | None) -> int:
    """Which of two poses (2, 4, 4) is nearer to the driver's; without one the first, which fits better.

    Only the direction of the normal tells the two poses apart: drivers choose a tag's axes as they like.
    """
    if of_driver is None:
        return 0
    return int(np.argmax([abs(float(one[:3, 2] @ of_driver[:3, 2])) for one in np.nan_to_num(T)]))


def _in_our_order(corners_px: np.ndarray) -> np.ndarray:
    """Put corners clockwise in the image, from the driver's first: the AprilTag library goes counterclockwise."""
    first, second = corners_px[2] - corners_px[0], corners_px[3] - corners_px[1]
    clockwise = first[0] * second[1] - first[1] * second[0] > 0.0  # with y down
    return corners_px if clockwise else corners_px[::-1]
