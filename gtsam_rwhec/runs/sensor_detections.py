"""The detections of each sensor, from its images or from its driver, and the report on those of all sensors.

Each detection in an image has two possible poses. It gets the one that its whole track supports.
"""

from __future__ import annotations

import warnings
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from gtsam_rwhec.cameras.board_turns import Turns, choose_turns, turn_between
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.plane_ambiguity import choose_over_time
from gtsam_rwhec.cameras.target_poses import plane_poses
from gtsam_rwhec.cameras.targets import Checkerboard, CircleGrid, Target
from gtsam_rwhec.detect.detections import Rejection, layouts_over_track, turned_detection
from gtsam_rwhec.detect.detector import Detection, Detector
from gtsam_rwhec.detect.images import Size, stated_size
from gtsam_rwhec.detect.many_images import DetectedImage, detect_in_images, measured_corner_px
from gtsam_rwhec.errors import CameraError, LogError, LogWarning
from gtsam_rwhec.files.progress import Counted, Progress, Remark
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import DetectionRecord, ImageRecord, Log
from gtsam_rwhec.results.log_history import DetectionReport, TrackCount
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.carrier_motion import CarrierMotion, check_order
from gtsam_rwhec.runs.kept_detections import KeptOfLog
from gtsam_rwhec.runs.measured_pairs import target_of
from gtsam_rwhec.runs.run_log import IMAGES_METADATA, detections_topic, image_key


@dataclass(frozen=True)
class LookedAt:
    """One image that was searched for targets."""

    logged_ns: int  #: its log time, by which it is found again
    fault: str = ""  #: why it could not be used; empty if it could


@dataclass(frozen=True, eq=False)
class SensorDetections:
    """The detections of one sensor."""

    records: list[DetectionRecord]  #: detections of the targets; one that is not used has a reason
    count: int  #: number of images, or of messages of the driver, in the log
    strangers: Counter[tuple[str, str]]  #: how often each tag that belongs to no target was seen, by family and id
    faults: tuple[str, ...] = ()  #: one sentence for each image that could not be used
    #: Measured standard deviation of a corner along each axis, pixels, by target/sensor.
    corner_px: Mapping[str, float] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()  #: what was found out about targets
    images: Mapping[int, LookedAt] = field(default_factory=dict)  #: every image, by stamp; none of a driver's


def images_at(log: Log, topic: str, of_sensor: SensorDetections, stamps: Iterable[int]) -> list[ImageRecord]:
    """The images of a sensor at some stamps, in the log's order; messages that cannot be read are missing."""
    wanted = {stamp: of_sensor.images[stamp].logged_ns for stamp in stamps}
    found = log.records_logged_at([topic], wanted.values())
    return [record for record in found if isinstance(record, ImageRecord) and record.stamp_ns in wanted]


def spread(members: Sequence[int], count: int) -> list[int]:
    """At most `count` members, spread evenly, with the first and the last."""
    count = min(count, len(members))
    if count == 1:
        return [members[len(members) // 2]]
    return [members[i] for i in np.linspace(0, len(members) - 1, count).round().astype(int).tolist()] if count else []


def detection_report(log: Log, rig: Rig, found: Mapping[str, SensorDetections]) -> DetectionReport:
    """The report on the detections of all sensors."""
    strangers = sum((of_sensor.strangers for of_sensor in found.values()), Counter[tuple[str, str]]())
    seen = {record.id for of_sensor in found.values() for record in of_sensor.records}
    return DetectionReport(
        sources=tuple(file.path.name for file in log.files),
        images={sensor: of_sensor.count for sensor, of_sensor in found.items()},
        undecoded={sensor: of_sensor.faults for sensor, of_sensor in found.items() if of_sensor.faults},
        tracks=tuple(count for sensor, of_sensor in found.items() for count in _counts(sensor, of_sensor.records)),
        strangers={f"{family} {number}": count for (family, number), count in sorted(strangers.items())},
        unseen=tuple(name for name in rig.targets if name not in seen),
        remarks=tuple(dict.fromkeys(remark for of_sensor in found.values() for remark in of_sensor.remarks)),
        corner_px={key: value for of_sensor in found.values() for key, value in of_sensor.corner_px.items()},
    )


def _counts(sensor: str, records: list[DetectionRecord]) -> Iterator[TrackCount]:
    reasons: dict[str, Counter[str]] = defaultdict(Counter)
    for record in records:
        reasons[record.id][record.reason] += 1
    for target, removed in sorted(reasons.items()):
        yield TrackCount(target=target, sensor=sensor, used=removed.pop("", 0), removed=dict(removed))


#: The size of a sensor's images is the most frequent one among this many first images.
FOR_SIZE = 20
#: A camera's stamps are checked after these numbers of images, so that wrong stamps are reported early.
CHECKED_AFTER = (10, 100, 1000, 10_000)


def detect_in_log(
    log: Log,
    rig: Rig,
    cameras: Mapping[str, Camera],
    motion: CarrierMotion,
    *,
    workers: int | None,
    progress: Progress,
    kept: KeptOfLog | None = None,
) -> dict[str, SensorDetections]:
    """The detections of every sensor that has images; those that `kept` has are not detected again.

    Raises `LogError` if a topic has other messages than images; `StampError` as `check_order`.
    """
    sensor_of = {source.images: name for name, source in rig.sensors.items() if source.images is not None}
    images: dict[str, list[DetectedImage]] = {topic: [] for topic in sensor_of}
    for image in _detected(log, rig, cameras, sensor_of, workers=workers, progress=progress, kept=kept):
        images[image.topic].append(image)
    upright: dict[str, Turns] = {}
    found = {}
    for topic, sensor in sensor_of.items():
        found[sensor] = detections_of_sensor(log, rig, sensor, images[topic], motion, upright)
    return found


def _detected(
    log: Log,
    rig: Rig,
    cameras: Mapping[str, Camera],
    sensor_of: Mapping[str, str],
    *,
    workers: int | None,
    progress: Progress,
    kept: KeptOfLog | None,
) -> Iterator[DetectedImage]:
    """The detections of every image, in any order. Stamps are checked while images are read."""
    if not sensor_of:
        return
    total = image_count(log, rig)
    if kept is not None and kept.done:
        progress(Remark(f"going on with an unfinished run: {kept.done:,} of {total:,} images are done"))
        progress(Counted("detecting: image", kept.done, total))
    if kept is not None and kept.is_whole:
        yield from kept.all()
        return
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
        topic: partial(Detector, cameras[sensor], rig.target_list, rig.detection_options)
        for topic, sensor in sensor_of.items()
    }
    yield from detect_in_images(
        images(),
        makers,
        workers=workers,
        kept=kept,
        progress=lambda done: progress(Counted("detecting: image", done, total)),
    )
    for topic in sensor_of:
        check_order(np.array(stamps[topic], dtype=np.int64), f"topic {topic}")
    if kept is not None:
        kept.finish()


def check_usable(log: Log, rig: Rig, found: Mapping[str, SensorDetections], cameras: Mapping[str, Camera]) -> None:
    """Raise `LogError` if no image of a sensor can be used, with what is wrong with the first, and what to do."""
    for sensor, of_sensor in found.items():
        topic, faults = rig.sensors[sensor].images, of_sensor.faults
        if topic is not None and len(faults) == of_sensor.count:
            why = f"the first: {faults[0]}" if faults else "none can be read as its schema says"
            raise LogError(
                f"{log.files[0].path}, topic {topic}: none of the {message_count(log, topic)} images of {sensor} can "
                f"be used; {why}{of_size(rig, sensor, usual_size(log, topic), cameras[sensor])}"
            )


def of_size(rig: Rig, sensor: str, size: Size | None, camera: Camera) -> str:
    """What to do if the size (width, height) of images differs from that of the intrinsics; empty if it does not."""
    if size is None or size == (camera.width, camera.height):
        return ""
    place = rig.source.place(("sensors", sensor, "intrinsics"))
    (width, height), most = size, max(camera.width, camera.height)
    if abs(width * camera.height - height * camera.width) <= most:
        return (
            f". If these images are the whole view in another resolution, multiply fx, fy, cx and cy by "
            f"{width / camera.width:.6g} and write size: [{width}, {height}]; if they were cut out, or are of another "
            f"camera, give the intrinsics of these images ({place})"
        )
    if abs(width * camera.width - height * camera.height) <= most:
        return (
            f". Width and height are exchanged: the images were turned by a quarter, or size is written the wrong way "
            f"round. Give images as the camera takes them, and size: [width, height] ({place})"
        )
    return f". Give the intrinsics of these images ({place}): what was cut out of an image has another centre"


def usual_size(log: Log, topic: str) -> Size | None:
    """The size (width, height) of most of a topic's first images; None where none says it."""
    sizes: Counter[Size] = Counter()
    for record in images_of_topic(log, topic):
        size = stated_size(record.data) if record.is_compressed else (record.width or 0, record.height or 0)
        if size is not None and min(size) > 0:
            sizes[size] += 1
        if sizes.total() == FOR_SIZE:
            break
    return sizes.most_common(1)[0][0] if sizes else None


def images_of_topic(log: Log, topic: str) -> Iterator[ImageRecord]:
    """The images of a topic. Detection says later which messages cannot be read."""
    with warnings.catch_warnings(action="ignore", category=LogWarning):
        for record in log.records([topic]):
            if not isinstance(record, ImageRecord):
                raise LogError(f"topic {record.topic} has no images but {type(record).__name__}s")
            yield record


def detections_of_sensor(
    log: Log,
    rig: Rig,
    sensor: str,
    images: list[DetectedImage],
    motion: CarrierMotion,
    upright: dict[str, Turns] | None = None,
) -> SensorDetections:
    """The detections in a sensor's images, in any order, each with the pose that its whole track supports.

    `upright` has the first track of each board that looks the same turned, and gets this one if there is none.
    """
    images = sorted(images, key=lambda image: image.stamp_ns)
    upright = {} if upright is None else upright
    faults = _faults(log, images)
    strangers: Counter[tuple[str, str]] = Counter()
    tracks: dict[str, list[tuple[int, Detection]]] = defaultdict(list)
    for image in images:
        if image.found is not None:
            strangers.update({(family, str(i)): n for (family, i), n in image.found.strangers.items()})
            for detection in image.found.detections:
                tracks[detection.target].append((image.stamp_ns, detection))
    records: list[DetectionRecord] = []
    corner_px: dict[str, float] = {}
    for target in rig.target_list:
        of_target, measured_px = _of_track(tracks[target.name], target, sensor, rig, motion, upright)
        records += of_target
        if measured_px is not None:
            corner_px[f"{target.name}/{sensor}"] = measured_px
    remarks = tuple(
        f"{name} is {note}."
        for name, track in tracks.items()
        for note in dict.fromkeys(d.note for _, d in track if d.note and d.rejection is None)
    )
    looked_at = {image.stamp_ns: LookedAt(image.logged_ns, image.fault) for image in images}
    return SensorDetections(records, len(images), strangers, faults, corner_px, remarks=remarks, images=looked_at)


def _faults(log: Log, images: list[DetectedImage]) -> tuple[str, ...]:
    """What is wrong with images. An image from a folder is named by its file, other images by their stamps."""
    names = log.metadata().get(IMAGES_METADATA, {})
    faulty = [image for image in images if image.found is None]
    stamped = [(image, f"topic {image.topic}, image at {image.stamp_ns} ns") for image in faulty]
    return tuple(
        image.fault.replace(words, names.get(image_key(image.topic, image.stamp_ns), words)) for image, words in stamped
    )


def _of_track(
    track: list[tuple[int, Detection]],
    target: Target,
    sensor: str,
    rig: Rig,
    motion: CarrierMotion,
    upright: dict[str, Turns],
) -> tuple[list[DetectionRecord], float | None]:
    """Each stamped detection of a target, with the pose that the whole track supports, and the corners' noise.

    `upright` has the first track of each board that looks the same turned, and gets this one if there is none.
    """
    options = rig.detection_options
    judged = layouts_over_track([detection for _, detection in track])
    track = [(stamp_ns, detection) for (stamp_ns, _), detection in zip(track, judged, strict=True)]
    chosen = [0] * len(track)
    rejections = [detection.rejection for _, detection in track]
    factor, corner_px = 1.0, None
    good = [i for i, rejection in enumerate(rejections) if rejection is None]
    if good:
        detections = [track[i][1] for i in good]
        squared = np.array([detection.squared_px for detection in detections])
        corner_px = rig.corner_px or measured_corner_px(
            squared[:, 0], np.array([len(detection.indices) for detection in detections])
        )
        factor = (corner_px / options.corner_px) ** 2
        stamps = np.array([track[i][0] for i in good], dtype=np.int64)
        carrier = motion.A_where_known(stamps, rig.carriers.max_gap_s)
        sure_of_turn = np.full(len(good), np.inf)
        if isinstance(target, (Checkerboard, CircleGrid)) and target.ways > 1:
            detections, sure_of_turn = _turned(detections, target, carrier, corner_px, factor, upright)
            track = track.copy()
            for i, detection in zip(good, detections, strict=True):
                track[i] = (track[i][0], detection)
        choice = choose_over_time(
            stamps,
            np.array([detection.T for detection in detections]),
            squared,
            factor * np.array([detection.covariance for detection in detections]),
            corner_px,
            carrier,
        )
        surest = np.minimum(choice.margin, sure_of_turn)
        for i, which, margin in zip(good, choice.which.tolist(), surest.tolist(), strict=True):
            chosen[i] = which
            rejections[i] = Rejection.AMBIGUOUS if margin < options.ambiguity_margin else None
    records = []
    for (stamp_ns, detection), which, rejection in zip(track, chosen, rejections, strict=True):
        has_pose = bool(np.isfinite(detection.T[which]).all() and np.isfinite(detection.covariance[which]).all())
        records.append(
            DetectionRecord(
                logged_ns=stamp_ns,
                stamp_ns=stamp_ns,
                topic=detections_topic(sensor),
                frame=rig.frame_of(sensor),
                family=target.family,
                id=target.name,
                corners_px=np.asarray(detection.corners_px, dtype=np.float64),
                T_camera_tag=detection.T[which] if has_pose else None,
                covariance=factor * detection.covariance[which] if has_pose else None,
                size_m=target.length_m,
                reprojection_px=float(detection.reprojection_px[which]) if has_pose else None,
                reason=detection.reason(rejection),
                corner_indices=tuple(detection.indices.tolist()),
            )
        )
    return records, corner_px


def _turned(
    detections: list[Detection],
    board: Checkerboard | CircleGrid,
    carrier: Array,
    corner_px: float,
    factor: float,
    upright: dict[str, Turns],
) -> tuple[list[Detection], Array]:
    """Detections of a board that looks the same when turned, all made the same way up, and how sure that is (n,).

    The first sensor's first image says which way is up.
    """
    turns = choose_turns(
        np.array([detection.T for detection in detections]),
        factor * np.array([detection.covariance for detection in detections]),
        np.array([detection.squared_px for detection in detections]),
        corner_px,
        carrier,
        board.ways,
    )
    more, margin = 0, np.inf
    if board.name in upright:
        more, margin = turn_between(upright[board.name], turns, board.ways)
    elif len(turns.R_A):
        upright[board.name] = turns
    which = (turns.which + more) % board.ways
    turned = [turned_detection(*pair) for pair in zip(detections, [board] * len(which), which.tolist(), strict=True)]
    return turned, np.minimum(turns.margin, margin)


def image_count(log: Log, rig: Rig) -> int:
    """How many images a log has for the sensors of a rig file, with those that cannot be read."""
    topics = {source.images for source in rig.sensors.values() if source.images is not None}
    return sum(topic.count for topic in log.topics() if topic.name in topics)


def message_count(log: Log, topic: str | None) -> int:
    """How many messages a topic has, with those that cannot be read."""
    return sum(t.count for t in log.topics() if t.name == topic)


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
    """The driver's record with the rig file's names and sizes; corners in this library's order if poses need them."""
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
