"""What a sensor with clouds saw of an object: its clouds, registered with each other, and what is kept of them."""

from __future__ import annotations

import hashlib
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.clouds.cloud import Cloud
from gtsam_rwhec.clouds.cloud_odometry import odometry
from gtsam_rwhec.clouds.named_fields import METRE, cloud_of_depth, cloud_of_record, record_of_cloud
from gtsam_rwhec.clouds.object_views import SeenObject, seen_object
from gtsam_rwhec.clouds.surfaces import DENSE
from gtsam_rwhec.detect.detections import Rejection
from gtsam_rwhec.errors import CloudError, LogError, LogWarning
from gtsam_rwhec.files.progress import Counted, Progress, Remark
from gtsam_rwhec.logs import CloudRecord, DetectionRecord, ImageRecord, Log, PoseRecord, Record
from gtsam_rwhec.results.log_history import ObjectReport, RegisteredPair
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.rig.odometry_sections import START, odometry_topic
from gtsam_rwhec.runs.carrier_motion import CarrierMotion, check_order
from gtsam_rwhec.runs.kept_detections import KeptDetections
from gtsam_rwhec.runs.run_log import clouds_topic, detections_topic, image_key, image_name, image_names
from gtsam_rwhec.runs.sensor_detections import SensorDetections, message_count

#: Points of a view that are kept, for people who look at the log and for the report.
KEPT_POINTS = 2000
#: Poses are the same if their matrices differ by no more than files and messages round, rad and m.
SAME = 1e-9
#: Two clouds slide along a direction that has less than this share of the information of the best known one.
NOTHING = 1e-9


@dataclass(frozen=True, eq=False)
class CloudDetections:
    """The detections of one sensor with clouds."""

    seen: SensorDetections
    report: ObjectReport
    clouds: list[CloudRecord]  #: Thinned clouds, in the sensor's frame, metres, on the topic that is kept


@dataclass(frozen=True)
class _Source:
    """Where a sensor's clouds are in a log, and how they are read."""

    log: Log
    topic: str
    camera: Camera | None
    unit_m: float | None
    names: Mapping[str, str]

    def name(self, stamp_ns: int) -> str:
        """The name of a cloud's file, else its stamp."""
        return image_name(self.names, self.topic, stamp_ns)

    def each(self) -> Iterator[tuple[int, Cloud | CloudError]]:
        """Stamp and cloud of each message, in the order of the log, or why it is none."""
        for record in self.log.records([self.topic]):
            try:
                cloud = replace(self._cloud(record), source=self.name(record.stamp_ns))
            except CloudError as error:
                yield record.stamp_ns, error
            else:
                yield record.stamp_ns, cloud

    def _cloud(self, record: Record) -> Cloud:
        file = self.names.get(image_key(self.topic, record.stamp_ns), "")  # without one, errors name topic and stamp
        if isinstance(record, CloudRecord):
            # Registration thins clouds. Those of half a million points cost time and memory as they are.
            return cloud_of_record(record, self.unit_m or METRE, source=file, most=2 * DENSE)
        if not isinstance(record, ImageRecord):
            raise LogError(f"topic {self.topic} has no clouds but {type(record).__name__}s")
        if self.camera is None:
            raise LogError(f"topic {self.topic} has depth images, which need intrinsics; state them for this sensor")
        return cloud_of_depth(record, self.camera, self.unit_m, source=file)


def detect_in_clouds(
    log: Log,
    rig: Rig,
    sensor: str,
    camera: Camera | None,
    motion: CarrierMotion,
    *,
    progress: Progress,
    kept: KeptDetections | None = None,
    registered: SeenObject | None = None,
) -> CloudDetections:
    """Register the clouds of a sensor; what `kept` has of the same clouds and poses is not registered again.

    Nor is `registered`, which is of clouds of this log, if it is of as many at the same poses. Raises `LogError` if the
    topic has no clouds, or depth images without intrinsics, or no cloud can be used; `StampError` as `check_order`;
    `CloudError` as `seen_object`: views do not overlap, or too few are left.
    """
    section = rig.sensors[sensor]
    topic, target, frame = section.clouds, rig.object, rig.frame_of(sensor)
    assert topic is not None
    assert target is not None
    assert section.time_offset != "estimate"
    source = _Source(log, topic, camera, section.unit_m, image_names(log))
    total = message_count(log, topic)
    drawn, faults = dict[int, CloudRecord](), []
    for done, (stamp, cloud) in enumerate(source.each(), start=1):
        progress(Counted("reading clouds:", done, total))
        if isinstance(cloud, Cloud):
            drawn.setdefault(stamp, record_of_cloud(_thinned(cloud), clouds_topic(sensor), stamp, frame))
        else:
            faults.append(str(cloud))
            if camera is not None or not source.names:  # else it was said when the log was made of a folder
                warnings.warn(f"{cloud}. It counts as a cloud that cannot be used", LogWarning, stacklevel=3)
    stamps = np.array(list(drawn), dtype=np.int64)
    check_order(stamps, f"topic {topic}")
    if not drawn:
        why = f"the first: {faults[0]}" if faults else "none can be read as its schema says"
        path = log.files[0].path
        raise LogError(f"{path}, topic {topic}: none of the {total} clouds of {sensor} can be used; {why}")
    A = motion.A_where_known(stamps + round(1e9 * float(section.time_offset)), rig.carriers.max_gap_s)
    known = np.isfinite(A[:, 0, 0])
    inputs = hashlib.sha256(stamps.tobytes() + A.tobytes()).hexdigest()
    found = None if kept is None else kept.known_object(sensor, inputs)
    if found is None:
        wanted = dict.fromkeys(stamps[known].tolist())
        seen = registered
        if seen is None or len(seen.A) != len(wanted) or not np.allclose(seen.A, A[known], rtol=0.0, atol=SAME):
            progress(f"registering {len(wanted)} clouds of {sensor}")
            seen = seen_object(_once(source, wanted), A[known])
        found = (
            _records(seen, detections_topic(sensor), frame, target, list(wanted)),
            _report(seen, target, sensor, [source.name(stamp) for stamp in wanted]),
        )
        if kept is not None:
            kept.keep_object(sensor, inputs, *found)
    else:
        progress(Remark(f"going on with an unfinished run: the clouds of {sensor} are registered"))
    records, report = found
    nowhere = [
        DetectionRecord(stamp, stamp, detections_topic(sensor), frame, "", target, reason=Rejection.NO_POSE)
        for stamp in stamps[~known].tolist()
    ]
    of_sensor = SensorDetections([*records, *nowhere], total, Counter(), tuple(faults), remarks=report.remarks)
    return CloudDetections(of_sensor, report, list(drawn.values()))


def motion_by_clouds(log: Log, rig: Rig, sensor: str, progress: Progress) -> tuple[list[PoseRecord], list[CloudRecord]]:
    """The poses of a LiDAR that knows its motion by its own sweeps, on its `odometry_topic`, and maps that these make.

    Raises `CloudError` as `odometry`: too few sweeps can be registered; `StampError` as `check_order`.
    """
    source = rig.odometries[sensor].odometry
    assert source.clouds is not None
    topics = {each.name: each for each in log.topics()}
    if not topics[source.clouds].has_clouds:
        place = rig.source.place(("sensors", sensor, "odometry", "clouds"))
        raise LogError(
            f"{place}: topic {source.clouds} has {topics[source.clouds].schema}; give one of PointCloud2 or PointCloud"
        )
    sweeps = _Source(log, source.clouds, None, None, {})
    unread: list[CloudError] = []

    def each() -> Iterator[Cloud]:
        for stamp, cloud in sweeps.each():
            if isinstance(cloud, Cloud):
                yield replace(cloud, stamp_ns=stamp)
            else:
                unread.append(cloud)

    track = odometry(each(), progress=progress)
    where = f"{sensor}, topic {source.clouds}"
    for words, reasons in (("cannot be read", unread), ("are left out of its motion", track.left_out)):
        if reasons:
            total = len(unread) + len(track.left_out) + len(track.stamps_ns)
            said = f"{where}: {len(reasons)} of {total} sweeps {words}; the first: {reasons[0]}"
            warnings.warn(said, LogWarning, stacklevel=3)
    if track.why_no_times:
        said = (
            f"{where}: {track.why_no_times}. So the motion during each sweep stays in them, and the sensor's place is "
            "centimetres off where the vehicle is fast; let the driver write the field time, t or timestamp"
        )
        warnings.warn(said, LogWarning, stacklevel=3)
    topic, frame = odometry_topic(sensor), f"{rig.frame_of(sensor)}{START}"
    poses = zip(track.stamps_ns.tolist(), track.T_start_sensor, strict=True)
    maps = [
        record_of_cloud(each, clouds_topic(sensor), each.stamp_ns or 0, rig.frame_of(sensor)) for each in track.maps
    ]
    return [PoseRecord(stamp, stamp, topic, frame, "", T) for stamp, T in poses], maps


def _once(source: _Source, wanted: dict[int, None]) -> Iterator[Cloud]:
    """The wanted clouds by stamp, each the first of its stamp, one after the other: not all fit into memory."""
    waiting = set(wanted)
    for stamp, cloud in source.each():
        if isinstance(cloud, Cloud) and stamp in waiting:
            waiting.remove(stamp)
            yield cloud


def _thinned(cloud: Cloud) -> Cloud:
    """At most `KEPT_POINTS` of a cloud, drawn at random: every stride of an image has a pattern."""
    if len(cloud) > KEPT_POINTS:
        cloud = cloud.selected(np.sort(np.random.default_rng(0).permutation(len(cloud))[:KEPT_POINTS]))
    points = cloud.points.astype(np.float32).astype(np.float64)
    return replace(cloud, points=points, shape=None, rings=None, times_s=None, intensities=None)


def _records(seen: SeenObject, topic: str, frame: str, target: str, stamps_ns: Sequence[int]) -> list[DetectionRecord]:
    """The object's pose in each view, as a detection."""
    records = []
    for i, stamp in enumerate(stamps_ns):
        record = DetectionRecord(stamp, stamp, topic, frame, "", target, reason=Rejection.NOT_REGISTERED)
        if seen.used[i]:
            T, covariance = seen.T_sensor_object[i], seen.covariances[i]
            record = replace(record, T_camera_tag=T, covariance=covariance, reason="")
        records.append(record)
    return records


def _report(seen: SeenObject, target: str, sensor: str, names: Sequence[str]) -> ObjectReport:
    pairs, stretch = seen.registrations, seen.stretch_of(sensor)
    # The carriers' poses and the certified pose of the sensor predict each registration.
    T_target_sensor = se3.inverse(seen.A) @ seen.T_sensorcarrier_sensor
    predicted = se3.inverse(T_target_sensor[pairs.i]) @ T_target_sensor[pairs.j]
    off = se3.logmap(se3.inverse(predicted) @ pairs.B)
    tells, along = np.linalg.eigh(pairs.information)
    is_told = tells > NOTHING * tells[:, -1:]
    slides = (~is_told).sum(axis=1)
    # Where two clouds slide on each other, any motion is as good.
    off = np.einsum("nij,nj,nkj,nk->ni", along, is_told, along, off)
    return ObjectReport(
        target=target,
        sensor=sensor,
        views=len(names),
        used=int(seen.used.sum()),
        noise_mm=1e3 * float(seen.sigma_m[0]),
        spacing_mm=1e3 * seen.spacing_m,
        alike_mm=1e3 * seen.alike_m,
        alike_deg=float(np.degrees(seen.alike_rad)),
        by_groups=tuple(map(tuple, seen.by_groups.T.tolist())),
        stretch_percent=100.0 * stretch.share,
        stretch_sigma_percent=100.0 * stretch.sigma if np.isfinite(stretch.sigma) else None,
        registrations=tuple(
            RegisteredPair(
                first=names[i],
                second=names[j],
                overlap=float(overlap),
                off_mm=1e3 * float(np.linalg.norm(xi[3:])),
                off_deg=float(np.degrees(np.linalg.norm(xi[:3]))),
                slides=free,
            )
            for i, j, overlap, xi, free in zip(
                pairs.i.tolist(), pairs.j.tolist(), pairs.overlap, off, slides.tolist(), strict=True
            )
        ),
        remarks=tuple(f"{finding}." for finding in seen.left_out.values()),
    )
