"""Detection in the images of all cameras; of the two poses of a detection the one that its whole track supports."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.logs import DetectionRecord, ImageRecord, Log
from gtsam_rwhec.pipeline.carrier_motion import CarrierMotion, check_order
from gtsam_rwhec.pipeline.log_contract import detections_topic
from gtsam_rwhec.pipeline.sensor_detections import SensorDetections
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.vision.ambiguity import choose_over_time
from gtsam_rwhec.vision.camera import Camera
from gtsam_rwhec.vision.detection import Detection, Detector
from gtsam_rwhec.vision.many_images import DetectedImage, detect_in_images, measured_corner_px
from gtsam_rwhec.vision.options import DetectionOptions
from gtsam_rwhec.vision.rejection import Rejection
from gtsam_rwhec.vision.targets import Target

#: After so many images the stamps of a camera are checked, so that nobody waits long for a log that cannot be used.
CHECKED_AFTER = (10, 100, 1000, 10_000)


@dataclass(frozen=True, eq=False)
class _Stamped:
    """A detection and the stamp of its image."""

    stamp_ns: int
    detection: Detection


def detect_in_log(
    log: Log,
    rig: Rig,
    cameras: Mapping[str, Camera],
    motion: CarrierMotion,
    *,
    workers: int | None,
    progress: Progress,
) -> dict[str, SensorDetections]:
    """Detect in the images of every sensor that has images.

    Raises
    ------
    LogError
        A topic has no images, or not one image of a sensor can be used.
    StampError
        Stamps that tell no time.
    """
    sensor_of = {source.images: name for name, source in rig.sensors.items() if source.images is not None}
    images: dict[str, list[DetectedImage]] = {topic: [] for topic in sensor_of}
    for image in _detected(log, rig, cameras, sensor_of, workers=workers, progress=progress):
        images[image.topic].append(image)
    return {
        sensor: _of_sensor(log, rig, sensor, sorted(images[topic], key=lambda image: image.stamp_ns), motion)
        for topic, sensor in sensor_of.items()
    }


def _detected(
    log: Log,
    rig: Rig,
    cameras: Mapping[str, Camera],
    sensor_of: Mapping[str, str],
    *,
    workers: int | None,
    progress: Progress,
) -> Iterator[DetectedImage]:
    """Every image, in no order; stamps are checked while images are read."""
    if not sensor_of:
        return
    options = detection_options(rig)
    stamps: dict[str, list[int]] = defaultdict(list)

    def images() -> Iterator[ImageRecord]:
        for record in log.records(list(sensor_of)):
            if not isinstance(record, ImageRecord):
                raise LogError(f"topic {record.topic} has no images but {type(record).__name__}s")
            of_topic = stamps[record.topic]
            of_topic.append(record.stamp_ns)
            if len(of_topic) in CHECKED_AFTER:
                check_order(np.array(of_topic, dtype=np.int64), f"topic {record.topic}")
            yield record

    makers = {
        topic: partial(Detector, cameras[sensor], rig.target_list, options) for topic, sensor in sensor_of.items()
    }
    total = sum(topic.count for topic in log.topics() if topic.name in sensor_of)
    yield from detect_in_images(
        images(), makers, workers=workers, progress=lambda done: progress(f"detecting: image {done} of {total}")
    )
    for topic in sensor_of:
        check_order(np.array(stamps[topic], dtype=np.int64), f"topic {topic}")


def _of_sensor(log: Log, rig: Rig, sensor: str, images: list[DetectedImage], motion: CarrierMotion) -> SensorDetections:
    faults = tuple(image.fault for image in images if image.found is None)
    if len(faults) == len(images):
        topic = rig.sensors[sensor].images
        why = f"the first: {faults[0]}" if faults else "not one can be read as its schema says"
        raise LogError(
            f"{log.files[0].path}, topic {topic}: none of the {message_count(log, topic)} images of {sensor} can "
            f"be used; {why}"
        )
    strangers: Counter[tuple[str, str]] = Counter()
    detections: list[_Stamped] = []
    for image in images:
        if image.found is not None:
            strangers.update({(family, str(i)): n for (family, i), n in image.found.strangers.items()})
            detections += [_Stamped(image.stamp_ns, detection) for detection in image.found.detections]
    records: list[DetectionRecord] = []
    corner_px: dict[str, float] = {}
    for target in rig.target_list:
        track = [stamped for stamped in detections if stamped.detection.target == target.name]
        of_target, measured_px = _of_track(track, target, sensor, rig, motion)
        records += of_target
        if measured_px is not None:
            corner_px[f"{target.name}/{sensor}"] = measured_px
    return SensorDetections(records, len(images), strangers, faults, corner_px)


def _of_track(
    track: list[_Stamped], target: Target, sensor: str, rig: Rig, motion: CarrierMotion
) -> tuple[list[DetectionRecord], float | None]:
    """Each detection of a target with the one of its two poses that the whole track supports; the corners' noise."""
    options = detection_options(rig)
    chosen: dict[int, tuple[int, Rejection | None]] = {}
    factor, corner_px = 1.0, None
    good = [stamped for stamped in track if stamped.detection.rejection is None]
    if good:
        squared = np.array([stamped.detection.squared_px for stamped in good])
        corner_px = rig.corner_px or measured_corner_px(
            squared[:, 0], np.array([len(stamped.detection.indices) for stamped in good])
        )
        factor = (corner_px / options.corner_px) ** 2
        stamps = np.array([stamped.stamp_ns for stamped in good], dtype=np.int64)
        choice = choose_over_time(
            stamps,
            np.array([stamped.detection.T for stamped in good]),
            squared,
            factor * np.array([stamped.detection.covariance for stamped in good]),
            corner_px,
            motion.A_where_known(stamps, rig.carriers.max_gap_s),
        )
        for stamped, which, margin in zip(good, choice.which.tolist(), choice.margin.tolist(), strict=True):
            chosen[id(stamped)] = which, Rejection.AMBIGUOUS if margin < options.ambiguity_margin else None
    records = []
    for stamped in track:
        detection = stamped.detection
        which, rejection = chosen.get(id(stamped), (0, detection.rejection))
        has_pose = bool(np.isfinite(detection.T[which]).all() and np.isfinite(detection.covariance[which]).all())
        records.append(
            DetectionRecord(
                logged_ns=stamped.stamp_ns,
                stamp_ns=stamped.stamp_ns,
                topic=detections_topic(sensor),
                frame=rig.frame_of(sensor),
                family=target.family,
                id=target.name,
                corners_px=np.asarray(detection.corners_px, dtype=np.float64),
                T_camera_tag=detection.T[which] if has_pose else None,
                covariance=factor * detection.covariance[which] if has_pose else None,
                size_m=target.length_m,
                reprojection_px=float(detection.reprojection_px[which]) if has_pose else None,
                reason=rejection or "",
                corner_indices=tuple(detection.indices.tolist()),
            )
        )
    return records, corner_px


def detection_options(rig: Rig) -> DetectionOptions:
    """The section ``detection`` of the rig file.

    Raises
    ------
    OptionError
        A value that cannot be used.
    """
    return replace(DetectionOptions(), **rig.detection)


def message_count(log: Log, topic: str | None) -> int:
    """How many messages of a topic there are, with those that cannot be read."""
    return sum(t.count for t in log.topics() if t.name == topic)
