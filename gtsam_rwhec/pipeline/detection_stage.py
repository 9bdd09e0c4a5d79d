"""First stage: images (or a driver's detections) to poses of targets, written beside the raw messages."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import DetectionRecord, ImageRecord, Log, LogWriter, open_log
from gtsam_rwhec.logs.mcap_writer import Images
from gtsam_rwhec.pipeline.carriers import check_order, read_carriers
from gtsam_rwhec.pipeline.driver_detections import from_driver
from gtsam_rwhec.pipeline.intrinsics import cameras_of
from gtsam_rwhec.pipeline.log_metadata import DETECTION, write_cameras, write_report, write_rig
from gtsam_rwhec.pipeline.no_detections import nothing_seen
from gtsam_rwhec.pipeline.stage_output import check_not_onto, check_writable, message_count, topics_before_detection
from gtsam_rwhec.results.stage_reports import DetectionReport, TrackCount
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.vision.ambiguity import choose_over_time
from gtsam_rwhec.vision.camera import Camera
from gtsam_rwhec.vision.detection import AMBIGUOUS, Detection, Detector
from gtsam_rwhec.vision.many_images import Looked, detect_in_images, measured_corner_px
from gtsam_rwhec.vision.options import DetectionOptions

#: Under which the detections of a sensor are written.
TOPIC = "/calibration/{sensor}/detections"
#: Numbers of images after which a camera's stamps are looked at, so that nobody waits for what cannot be used.
EARLY = (10, 100, 1000, 10_000)


def detect_log(
    log_path: str | Path | list[str | Path],
    rig: Rig,
    out_path: str | Path,
    *,
    images: Images = "leave_out",
    workers: int | None = None,
    progress: Progress | None = None,
) -> DetectionReport:
    """Write a log of what the cameras saw.

    The raw messages are copied as they are (images on request); topics ``/calibration/<sensor>/detections``,
    ``.../annotations`` and ``.../poses`` are new, and the rig file, intrinsics and a report are in the metadata.

    Parameters
    ----------
    log_path
        As for ``open_log``.
    rig : Rig
    out_path
        The MCAP file to write.
    images : "copy" or "leave_out"
    workers : int, optional
        Threads; left out, one for each core.
    progress : callable, optional
        Told what is done.

    Raises
    ------
    LogError, StampError, TransformError, CameraError, FrameError
        For a log that lacks what the rig file names, the carriers' poses too, or in which nothing at all was detected.
    """
    tell = progress or silent
    check_writable(out_path)
    with open_log(log_path) as log:
        check_not_onto(log, out_path)
        cameras = cameras_of(log, rig)
        tell("reading the carriers' poses")
        carrier_at = _carrier_at(log, rig)
        seen, undecoded, counts, strangers = _look(log, rig, cameras, workers, tell)
        corner_px: dict[str, float] = {}
        found = {sensor: _chosen(seen[sensor], sensor, rig, carrier_at, corner_px) for sensor in seen}
        for sensor, source in rig.sensors.items():
            if source.detections is not None:
                found[sensor], others = from_driver(log, rig, sensor, cameras.get(sensor))
                strangers.update(others)
                counts[sensor] = message_count(log, source.detections)
        report = DetectionReport(
            sources=tuple(file.path.name for file in log.files),
            images=counts,
            undecoded={sensor: tuple(faults) for sensor, faults in undecoded.items()},
            tracks=_counts(found),
            strangers={f"{family} {number}": count for (family, number), count in sorted(strangers.items())},
            unseen=tuple(name for name in rig.targets if all(r.id != name for of in found.values() for r in of)),
            corner_px=corner_px,
        )
        if not any(track.used for track in report.tracks):
            raise LogError(nothing_seen(log, rig, report))
        tell("writing detections")
        with LogWriter(out_path) as out:
            out.copy(log, topics_before_detection(log), images)
            _write(out, found)
            write_rig(out, rig)
            write_cameras(out, cameras)
            write_report(out, DETECTION, report)
    return report


def _look(
    log: Log, rig: Rig, cameras: dict[str, Camera], workers: int | None, tell: Progress
) -> tuple[dict[str, list[_Seen]], dict[str, list[str]], dict[str, int], Counter[tuple[str, str]]]:
    """Every image once: detections, faults and counts by sensor, and the tags of no target."""
    sensor_of = {source.images: name for name, source in rig.sensors.items() if source.images is not None}
    found: dict[str, list[_Seen]] = {sensor: [] for sensor in sensor_of.values()}
    undecoded: dict[str, list[str]] = defaultdict(list)
    counts: dict[str, int] = dict.fromkeys(sensor_of.values(), 0)
    strangers: Counter[tuple[str, str]] = Counter()
    if not sensor_of:
        return found, undecoded, counts, strangers
    options = detection_options(rig)
    stamps: dict[str, list[int]] = defaultdict(list)

    def pictures() -> Iterator[ImageRecord]:
        for record in log.records(list(sensor_of)):
            if not isinstance(record, ImageRecord):
                raise LogError(f"topic {record.topic} has no images but {type(record).__name__}s")
            of_topic = stamps[record.topic]
            of_topic.append(record.stamp_ns)
            if len(of_topic) in EARLY:
                check_order(np.array(of_topic, dtype=np.int64), f"topic {record.topic}")
            yield record

    makers = {
        topic: partial(Detector, cameras[sensor], rig.target_list, options) for topic, sensor in sensor_of.items()
    }
    total = sum(topic.count for topic in log.topics() if topic.name in sensor_of)
    looked: list[Looked] = []
    for image in detect_in_images(
        pictures(), makers, workers=workers, progress=lambda done: tell(f"detecting: image {done} of {total}")
    ):
        looked.append(image)
    for image in sorted(looked, key=lambda image: (image.topic, image.stamp_ns)):
        sensor = sensor_of[image.topic]
        counts[sensor] += 1
        if image.seen is None:
            undecoded[sensor].append(image.fault)
            continue
        strangers.update({(family, str(i)): n for (family, i), n in image.seen.strangers.items()})
        found[sensor] += [_Seen(image.stamp_ns, detection) for detection in image.seen.detections]
    for topic, sensor in sensor_of.items():
        check_order(np.array(stamps[topic], dtype=np.int64), f"topic {topic}")
        faults = undecoded.get(sensor, [])
        if len(faults) == counts[sensor]:
            why = f"the first: {faults[0]}" if faults else "not one can be read as its schema says"
            raise LogError(
                f"{log.files[0].path}, topic {topic}: none of the {message_count(log, topic)} images of {sensor} can "
                f"be used; {why}"
            )
    return found, undecoded, counts, strangers


@dataclass(frozen=True, eq=False)
class _Seen:
    """A detection and when."""

    stamp_ns: int
    detection: Detection


def _chosen(
    found: list[_Seen],
    sensor: str,
    rig: Rig,
    carrier_at: Callable[[np.ndarray], Array],
    corner_px: dict[str, float],
) -> list[DetectionRecord]:
    """Detections of one sensor as records, each with the pose that its whole track speaks for."""
    options = detection_options(rig)
    records: list[DetectionRecord] = []
    for target in rig.target_list:
        mine = [seen for seen in found if seen.detection.target == target.name]
        good = [seen for seen in mine if not seen.detection.reason]
        chosen: dict[int, tuple[int, str]] = {}
        factor = 1.0
        if good:
            squared = np.array([seen.detection.squared_px for seen in good])
            noise = _corner_px(rig) or measured_corner_px(
                squared[:, 0], np.array([len(seen.detection.indices) for seen in good])
            )
            corner_px[f"{target.name}/{sensor}"] = noise
            factor = (noise / options.corner_px) ** 2
            stamps = np.array([seen.stamp_ns for seen in good], dtype=np.int64)
            choice = choose_over_time(
                stamps,
                np.array([seen.detection.T for seen in good]),
                squared,
                factor * np.array([seen.detection.covariance for seen in good]),
                noise,
                carrier_at(stamps),
            )
            for seen, which, margin in zip(good, choice.which.tolist(), choice.margin.tolist(), strict=True):
                chosen[id(seen)] = which, AMBIGUOUS if margin < options.ambiguity_margin else ""
        for seen in mine:
            which, reason = chosen.get(id(seen), (0, seen.detection.reason))
            detection = seen.detection
            has_pose = bool(np.isfinite(detection.T[which]).all() and np.isfinite(detection.covariance[which]).all())
            records.append(
                DetectionRecord(
                    logged_ns=seen.stamp_ns,
                    stamp_ns=seen.stamp_ns,
                    topic=TOPIC.format(sensor=sensor),
                    frame=rig.frame_of(sensor),
                    family=target.family,
                    id=target.name,
                    corners_px=np.asarray(detection.corners_px, dtype=np.float64),
                    T_camera_tag=detection.T[which] if has_pose else None,
                    covariance=factor * detection.covariance[which] if has_pose else None,
                    size_m=target.length_m,
                    reprojection_px=float(detection.reprojection_px[which]) if has_pose else None,
                    reason=reason,
                    corner_indices=tuple(detection.indices.tolist()),
                )
            )
    return records


def _carrier_at(log: Log, rig: Rig) -> Callable[[np.ndarray], Array]:
    """A at stamps, nan where not known; read before images are looked at, so that a log without is refused at once."""
    trajectory = read_carriers(log, rig).trajectory

    def at(stamps_ns: np.ndarray) -> Array:
        A, gap_s = trajectory.at(stamps_ns)
        return np.where((gap_s > rig.carriers.max_gap_s)[:, None, None], np.nan, A)

    return at


def _counts(found: dict[str, list[DetectionRecord]]) -> tuple[TrackCount, ...]:
    result = []
    for sensor, records in found.items():
        for target in sorted({record.id for record in records}):
            reasons = Counter(record.reason for record in records if record.id == target)
            used = reasons.pop("", 0)
            result.append(TrackCount(target=target, sensor=sensor, used=used, removed=dict(reasons)))
    return tuple(result)


def _write(out: LogWriter, found: dict[str, list[DetectionRecord]]) -> None:
    for sensor, records in found.items():
        of_image: dict[int, list[DetectionRecord]] = defaultdict(list)
        for record in records:
            of_image[record.stamp_ns].append(record)
        topic = TOPIC.format(sensor=sensor)
        base = topic.rpartition("/")[0]
        for stamp in sorted(of_image):
            seen = of_image[stamp]
            out.detections(topic, stamp, seen[0].frame, seen)
            outlines = [(label(r), r.corners_px) for r in seen if r.corners_px is not None and len(r.corners_px)]
            if outlines:
                out.annotations(f"{base}/annotations", stamp, outlines)
            used = [r.T_camera_tag for r in seen if r.T_camera_tag is not None and not r.reason]
            if used:
                out.poses(f"{base}/poses", stamp, seen[0].frame, np.array(used))


def label(record: DetectionRecord) -> str:
    """What stands beside a detection in a picture."""
    return record.id if not record.reason else f"{record.id}: {record.reason}"


def _corner_px(rig: Rig) -> float | None:
    """As the rig file has it; None: to be measured."""
    return None if rig.noise == "estimate" else rig.noise.corner_px


def detection_options(rig: Rig) -> DetectionOptions:
    """The rig file's section ``detection``.

    Raises
    ------
    OptionError
        For a value that cannot be.
    """
    return replace(DetectionOptions(), **rig.detection)
