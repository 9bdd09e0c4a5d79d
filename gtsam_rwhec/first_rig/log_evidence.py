"""What a log says about a pair of moving frames: which carries the cameras, whether images were taken at rest."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import Tag, Target, family_named
from gtsam_rwhec.detect.detector import Detection, Detector
from gtsam_rwhec.errors import CameraError, LogError, PoseError, StampError, TransformError
from gtsam_rwhec.first_rig.log_contents import DriverTopic, LogContents
from gtsam_rwhec.first_rig.pose_origin import Origin, Rest, origin_of, rest_of
from gtsam_rwhec.first_rig.roles import RoleEvidence, Seen, evidence_of_roles
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.logs import Log, TfBuffer
from gtsam_rwhec.rig.sections import PoseSource, Sensor

#: Seconds. Between poses further apart in time nothing is interpolated.
MAX_GAP_S = 0.5
#: A driver's poses have this covariance where nobody states it: 0.6 degrees and 10 mm.
OF_DRIVER = 1e-4 * np.eye(6)


@dataclass(frozen=True, eq=False)
class LogEvidence:
    """What a log says about its carriers.

    Attributes
    ----------
    roles : RoleEvidence
        What solving with the cameras on either frame says.
    rest : dict of str to Rest
        By topic of images, whether they were taken at rest; empty where the poses do not tell.
    origin : Origin
        Where the poses come from.
    """

    roles: RoleEvidence
    rest: dict[str, Rest]
    origin: Origin


def evidence_of_log(
    log: Log, contents: LogContents, source: PoseSource, sensors: Mapping[str, Sensor], targets: list[Target]
) -> LogEvidence:
    """Solve for roles, and look at the path, of the poses that `source` names."""
    parent, child = source.parent_and_child
    path = _path(log, contents, source)
    schema = next((topic.schema for topic in contents.topics if topic.name == source.topic), "")
    origin = origin_of([source.topic or "", parent, child], schema, path)
    if path is None:
        return LogEvidence(evidence_of_roles([]), {}, origin)
    rest = {
        topic.topic: rest_of(np.unique(np.array(topic.stamps_ns, dtype=np.int64)), path)
        for topic in contents.images.values()
        if len(topic.stamps_ns) > 1
    }
    return LogEvidence(evidence_of_roles(_seen(contents, path, sensors, targets)), rest, origin)


def _path(log: Log, contents: LogContents, source: PoseSource) -> Trajectory | None:
    """T_parent_child over time; None where the log's poses do not give it."""
    parent, child = source.parent_and_child
    try:
        if source.topic is not None:
            series = log.poses(source.topic)
            last = np.append(np.diff(series.stamps_ns) != 0, True)
            return Trajectory.of(series.stamps_ns[last], series.T[last], f"topic {source.topic}")
        buffer = TfBuffer(log.records([t.name for t in contents.topics if t.is_tf and not t.unreadable]))
        stamps = buffer.stamps(parent, child)
        T, gap_s = buffer.at(parent, child, stamps)
        known = np.isfinite(gap_s)
        return Trajectory.of(stamps[known], T[known], f"tf {parent} to {child}")
    except (LogError, TransformError, StampError, PoseError):
        return None  # calibration says what is wrong with them


def _seen(
    contents: LogContents, path: Trajectory, sensors: Mapping[str, Sensor], targets: list[Target]
) -> Iterator[Seen]:
    by_name = {target.name: target for target in targets}
    for name, sensor in sensors.items():
        if sensor.images is not None:
            topic = contents.images[sensor.images]
            camera = _camera(contents, sensor)
            if camera is None or not topic.pictures:
                continue
            found = Detector(camera, targets)(topic.pictures)
            at = path.at(np.array(topic.places, dtype=np.int64))
            for T, gap_s, of_image in zip(*at, found, strict=True):
                if gap_s < MAX_GAP_S:
                    yield from (Seen(name, by_name[d.target], d, T) for d in of_image.detections)
        elif sensor.detections is not None:
            yield from _of_driver(name, contents.drivers[sensor.detections], path, targets)


def _of_driver(sensor: str, driver: DriverTopic, path: Trajectory, targets: list[Target]) -> Iterator[Seen]:
    tags = {(target.family, target.id): target for target in targets if isinstance(target, Tag)}
    for record in driver.kept:
        target = tags.get((family_named(record.family) or "tag36h11", int(record.id)))
        if target is None or record.T_camera_tag is None:
            continue
        T, gap_s = path.at(np.array([record.stamp_ns]))
        if gap_s[0] < MAX_GAP_S:
            poses = np.stack([record.T_camera_tag, np.full((4, 4), np.nan)])
            detection = Detection(
                target.name, np.zeros((4, 2)), np.arange(4), poses, np.array([0.0, np.nan]), np.zeros(2),
                np.stack([OF_DRIVER, OF_DRIVER]), np.nan, np.nan,
            )  # fmt: skip
            yield Seen(sensor, target, detection, T[0])


def _camera(contents: LogContents, sensor: Sensor) -> Camera | None:
    """The camera of the topic of intrinsics; None without one."""
    record = contents.cameras.get((sensor.intrinsics and sensor.intrinsics.topic) or "")
    if record is None:
        return None
    try:
        return Camera.of(record.width, record.height, record.model, record.K, record.D, f"topic {record.topic}")
    except CameraError:
        return None
