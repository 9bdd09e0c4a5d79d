"""What a session knows of its streams now: the latest image of each camera with what is seen in it, poses, stillness.

Only the newest image of a camera waits to be looked at; those that it takes the place of are counted.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.capture.sources import Message, Reader, Source, is_of_transforms
from gtsam_rwhec.detect.detector import Detector
from gtsam_rwhec.detect.images import decode_gray, decode_small
from gtsam_rwhec.detect.many_images import look
from gtsam_rwhec.detect.pictures import jpeg_of
from gtsam_rwhec.errors import CameraError, FileFormatError, ImageError, TransformError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import DetectionRecord, ImageRecord, IntrinsicsRecord, PoseRecord, Record, TfBuffer
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.carrier_motion import BACKWARDS_S
from gtsam_rwhec.runs.measured_pairs import target_of
from gtsam_rwhec.runs.sensor_intrinsics import intrinsics_of

#: Seconds of poses that are kept, and those around an image that a take has.
KEPT_S, AROUND_S = 20.0, 0.5
#: At most this many poses are kept, whatever their stamps say.
MOST_POSES = 50_000
#: A stamp that is this much (seconds) further on than the time that passed was set by somebody.
FORWARD_S = 5.0
#: Poses and images whose stamps are this far apart (seconds) are of two clocks.
APART_S = 1.0
#: Seconds that a camera's search rests at most, after as long a search.
LONGEST_REST_S = 0.25
#: A picture for the page has at most this width, pixels, and bytes; a smaller JPEG or PNG goes as it is.
PICTURE_PX, PICTURE_BYTES = 960, 250_000


@dataclass(frozen=True)
class StillOptions:
    """When the robot stands still: for some seconds of the stamps, pose and corners move by less than these."""

    seconds: float = 0.5
    mm: float = 0.5  #: of the carriers' pose, with `deg`
    deg: float = 0.05
    px: float = 0.7  #: of each corner


@dataclass(frozen=True, eq=False)
class Seen:
    """What is seen in one image, or in one message of a driver."""

    sensor: str
    stamp_ns: int
    number: int  #: of its message among all that came
    message: Message
    records: tuple[DetectionRecord, ...]  #: with the rig file's names; one that is not used has a reason
    fault: str = ""  #: why the image could not be used
    picture: bytes = b""  #: JPEG or PNG for the page
    size: tuple[int, int] | None = None  #: width, height in which corners are
    at_s: float = field(default_factory=time.time)  #: when it was seen, seconds since 1970

    @property
    def used(self) -> dict[str, Array]:
        """Corners (n, 2) of the targets that count, by name."""
        return {
            record.id: record.corners_px
            for record in self.records
            if not record.reason and record.corners_px is not None
        }

    @property
    def counts(self) -> bool:
        """Whether a target is seen that can be used."""
        return any(not record.reason for record in self.records)


@dataclass
class SensorStream:
    """A sensor's stream."""

    sensor: str
    camera: Camera | None = None
    waiting: tuple[int, Message, ImageRecord] | None = None  #: the newest image, which nobody looks at yet
    is_looked_at: bool = False  #: whether one of its images is being searched
    latest: Seen | None = None
    #: When the search of an image began; until when none begins, so that half of the time is left to others.
    begun_s: float = -np.inf
    rests_until_s: float = -np.inf
    skipped: int = 0  #: images in whose place a newer one was searched
    looked: int = 0
    received_s: float = -np.inf  #: when the last message came, by a clock of this process
    ahead_s: float = 0.0  #: of the last message: its stamp less that of the pose that came before it
    fault: str = ""  #: why there can be no detections
    #: Stamps and corners of the last images, for stillness
    recent: deque[tuple[int, dict[str, Array]]] = field(default_factory=lambda: deque(maxlen=100))


@dataclass(frozen=True)
class Stillness:
    """How still the robot stands; ``str()`` says it."""

    is_still: bool
    why: str  #: what moves, or is not known; empty where it is still

    def __str__(self) -> str:
        return "stands still" if self.is_still else self.why


class Streams:
    """Takes messages in, and answers what a session asks of them."""

    def __init__(self, source: Source, rig: Rig, still: StillOptions) -> None:
        self._source, self._rig, self._still = source, rig, still
        self._read = Reader(source)
        self.sensors = {name: SensorStream(name) for name in rig.sensors}
        self._sensor_of = {s.images or s.detections: name for name, s in rig.sensors.items()}
        self._announced: dict[str, IntrinsicsRecord] = {}
        self._constant: dict[tuple[object, ...], Message] = {}  # camera infos, static transforms
        self._static: dict[tuple[str, str], PoseRecord] = {}
        self._poses: deque[tuple[int, Message, PoseRecord]] = deque(maxlen=MOST_POSES)
        self._unread_poses: list[Message] = []
        self._clocks: dict[str, tuple[int, int]] = {}  # stamp and time of arrival of a topic's last message
        self.number = 0  #: messages that came
        self.latest_pose_ns: int | None = None
        self._set_cameras()

    def take_in(self, message: Message) -> list[Seen]:
        """Take a message; what is seen in it, where a driver says so."""
        self.number += 1
        topic, schema = message.channel.topic, message.schema.name if message.schema else ""
        if topic == self._rig.carriers.poses.topic or is_of_transforms(topic, schema):
            self._unread_poses.append(message)
            return []
        self.read_poses()
        sensor = self._sensor_of.get(topic)
        records = next((records for _, records in self._read([message])), ())
        for record in records[:1]:
            self._check_clock(message, record)
        if sensor is not None and records:
            stream = self.sensors[sensor]
            stream.received_s = time.monotonic()
            if self.latest_pose_ns is not None:
                stream.ahead_s = 1e-9 * (records[0].stamp_ns - self.latest_pose_ns)
        for record in records:
            if isinstance(record, ImageRecord) and sensor is not None:
                stream.skipped += stream.waiting is not None
                stream.waiting = self.number, message, record
            elif isinstance(record, IntrinsicsRecord) and record.topic not in self._announced:
                self._announced[record.topic] = record
                self._constant[record.topic,] = message
                self._set_cameras()
        driver = [record for record in records if isinstance(record, DetectionRecord)]
        if sensor is not None and driver:
            return [self._of_driver(sensor, message, driver)]
        return []

    def read_poses(self) -> None:
        """Read the poses that came since the last call: many at once take a tenth of the time."""
        of_channel: dict[tuple[str, str], list[Message]] = {}
        for message in self._unread_poses:
            key = message.channel.topic, message.schema.name if message.schema else ""
            of_channel.setdefault(key, []).append(message)
        self._unread_poses.clear()
        for messages in of_channel.values():
            for message, records in self._read(messages):
                poses = [record for record in records if isinstance(record, PoseRecord)]
                if poses:
                    self._check_clock(message, poses[0])
                    self._take_poses(message, poses)

    def next_to_look_at(self) -> Iterator[tuple[SensorStream, Callable[[], Seen]]]:
        """Images that can be searched now, each with the function that does so, for another thread."""
        for stream in self.sensors.values():
            is_free = not stream.is_looked_at and time.monotonic() >= stream.rests_until_s
            if stream.waiting is not None and stream.camera is not None and is_free:
                work = partial(_looked_at, self._rig, stream.sensor, stream.camera, *stream.waiting)
                stream.waiting, stream.is_looked_at, stream.begun_s = None, True, time.monotonic()
                yield stream, work

    def looked(self, seen: Seen) -> None:
        """Take what was seen in an image, or in a driver's message."""
        stream = self.sensors[seen.sensor]
        stream.latest, stream.is_looked_at, stream.looked = seen, False, stream.looked + 1
        stream.recent.append((seen.stamp_ns, seen.used))
        now_s = time.monotonic()
        stream.rests_until_s = now_s + min(now_s - stream.begun_s, LONGEST_REST_S)

    def stillness(self, stamp_ns: int | None = None) -> Stillness:
        """Whether the robot stood still for a while up to a stamp; by default up to the last pose."""
        end = self.latest_pose_ns if stamp_ns is None else stamp_ns
        if end is None:
            return Stillness(False, "no poses have come yet")
        begin = end - round(1e9 * self._still.seconds)
        stamps = sorted({stamp for stamp, _, _ in self._between(begin, end)} | {begin, end})
        try:
            T, gap_s = self._at(np.array(stamps, dtype=np.int64))
        except TransformError as error:
            return Stillness(False, str(error))
        if not (gap_s[:-1] <= max(self._rig.carriers.max_gap_s, self._still.seconds)).all():
            return Stillness(False, f"poses of {self._still.seconds:g} s are not there yet")
        step = se3.logmap(se3.inverse(T[-1:]) @ T)
        deg = float(np.degrees(np.linalg.norm(step[:, :3], axis=1)).max())
        mm = 1e3 * float(np.linalg.norm(T[:, :3, 3] - T[-1, :3, 3], axis=1).max())
        if mm > self._still.mm or deg > self._still.deg:
            return Stillness(False, f"the robot moves ({mm:.1f} mm, {deg:.2f} degrees in {self._still.seconds:g} s)")
        px = max((_moved_px(stream.recent, begin, end) for stream in self.sensors.values()), default=0.0)
        return Stillness(px <= self._still.px, f"the targets move in the images ({px:.1f} px)")

    def pose_at(self, stamp_ns: int) -> Array | None:
        """T_parent_child (4, 4) of the carriers at a stamp; None where poses do not tell it (yet)."""
        try:
            T, gap_s = self._at(np.array([stamp_ns], dtype=np.int64))
        except TransformError:
            return None
        return np.array(T[0]) if gap_s[0] <= self._rig.carriers.max_gap_s else None

    def carriers_stamp(self, seen: Seen) -> int:
        """The stamp of an image on the carriers' clock, as far as the rig file states the offset."""
        offset = self._rig.sensors[seen.sensor].time_offset
        return seen.stamp_ns + (0 if offset == "estimate" else round(1e9 * offset))

    def of_take(self, seen: Sequence[Seen]) -> list[tuple[int, Message]]:
        """The messages of a take, with log times: images, the poses around them, and what holds all the time."""
        images = [(each.message.received_ns, each.message) for each in seen]
        stamps = [self.carriers_stamp(each) for each in seen]
        first, last = min(stamps) - round(1e9 * AROUND_S), max(stamps) + round(1e9 * AROUND_S)
        before = max((stamp for stamp, _, _ in self._poses if stamp <= min(stamps)), default=first)
        after = min((stamp for stamp, _, _ in self._poses if stamp >= max(stamps)), default=last)
        poses = {
            id(message): (message.received_ns, message)
            for stamp, message, _ in self._poses
            if min(first, before) <= stamp <= max(last, after)
        }
        begin = min(received for received, _ in [*images, *poses.values()])
        return [*((begin, message) for message in self._constant.values()), *poses.values(), *images]

    def troubles(self) -> list[str]:
        """What keeps the session from working, in words."""
        said = [f"{name}: {stream.fault}" for name, stream in self.sensors.items() if stream.fault]
        if self._poses:
            try:
                self._at(np.array([self._poses[-1][0]], dtype=np.int64))
            except TransformError as error:
                said.append(
                    f"{error} ({self._rig.source.place(('carriers', 'poses'))}); is the rig file of this robot?"
                )
        for name, stream in self.sensors.items():
            if stream.latest is not None and stream.latest.fault:
                said.append(f"{name}: {stream.latest.fault}")
            if abs(stream.ahead_s) > APART_S and not self._source.is_at_rest:
                way = "ahead of" if stream.ahead_s > 0 else "behind"
                said.append(
                    f"the stamps of {name} are {abs(stream.ahead_s):.1f} s {way} "
                    "those of the poses that come with them: two clocks, which must be set alike (chrony, ptp)"
                )
        return said

    def _set_cameras(self) -> None:
        for name, stream in self.sensors.items():
            try:
                stream.camera = intrinsics_of(self._rig, name, self._announced)
            except (CameraError, FileFormatError) as error:
                stream.fault = str(error)

    def _check_clock(self, message: Message, record: Record) -> None:
        topic, stamp = message.channel.topic, record.stamp_ns
        before = self._clocks.get(topic)
        self._clocks[topic] = stamp, message.received_ns
        if (
            before is None
            or isinstance(record, IntrinsicsRecord)
            or (isinstance(record, PoseRecord) and record.is_static)
        ):
            return
        step_s = 1e-9 * (stamp - before[0])
        jump_s = step_s - 1e-9 * (message.received_ns - before[1])
        if step_s < -BACKWARDS_S or (jump_s > FORWARD_S and not self._source.is_at_rest):
            way = "back" if step_s < 0 else "forward"
            self._source.say(f"topic {topic}, clock set {way}", f"by {abs(step_s):.1f} s, to {stamp} ns")
            if isinstance(record, PoseRecord):
                self._poses.clear()  # poses of two times would be mixed
            elif (sensor := self._sensor_of.get(topic)) is not None:
                self.sensors[sensor].recent.clear()

    def _take_poses(self, message: Message, poses: Sequence[PoseRecord]) -> None:
        source = self._rig.carriers.poses
        if source.topic is not None:
            if message.channel.topic != source.topic:
                return
            parent, child = source.parent_and_child
            poses = [replace(record, parent=parent, child=child) for record in poses]
        if poses[0].is_static:
            self._static.update({(record.parent, record.child): record for record in poses})
            self._constant[message.channel.topic, *((record.parent, record.child) for record in poses)] = message
            return
        for record in poses:
            self._poses.append((record.stamp_ns, message, record))
            self.latest_pose_ns = record.stamp_ns
        oldest = poses[-1].stamp_ns - round(1e9 * KEPT_S)
        while self._poses[0][0] < oldest:
            self._poses.popleft()

    def _at(self, stamps_ns: np.ndarray) -> tuple[Array, Array]:
        """T_parent_child and gaps at stamps near one another, from the poses around them."""
        around_ns = round(1e9 * max(self._rig.carriers.max_gap_s, self._still.seconds))
        first, last = int(stamps_ns[0]) - around_ns, int(stamps_ns[-1]) + around_ns
        buffer = TfBuffer([*self._static.values(), *(record for _, _, record in self._between(first, last))])
        return buffer.at(*self._rig.carriers.poses.parent_and_child, stamps_ns)

    def _between(self, first_ns: int, last_ns: int) -> list[tuple[int, Message, PoseRecord]]:
        """The poses between two stamps, as they came."""
        found = []
        for each in reversed(self._poses):
            if each[0] < first_ns - 10**9:
                break  # links come nearly in the order of their stamps
            if first_ns <= each[0] <= last_ns:
                found.append(each)
        return found[::-1]

    def _of_driver(self, sensor: str, message: Message, records: Sequence[DetectionRecord]) -> Seen:
        named = ((record, target_of(record, self._rig.target_list)) for record in records)
        known = tuple(replace(record, id=target.name) for record, target in named if target is not None)
        camera = self.sensors[sensor].camera
        size = None if camera is None else (camera.width, camera.height)
        return Seen(sensor, records[0].stamp_ns, self.number, message, known, size=size)


def _looked_at(rig: Rig, sensor: str, camera: Camera, number: int, message: Message, image: ImageRecord) -> Seen:
    """What is seen in an image. Runs in a thread, which keeps its detectors."""
    (found,) = look([image], partial(Detector, camera, rig.target_list, rig.detection_options))
    stamp, families = image.stamp_ns, {target.name: target.family for target in rig.target_list}
    records = tuple(
        DetectionRecord(
            stamp, stamp, image.topic, rig.frame_of(sensor), families[one.target], one.target,
            np.asarray(one.corners_px, dtype=np.float64), reason=one.reason(one.rejection),
            corner_indices=tuple(one.indices.tolist()),
        )
        for one in (found.found.detections if found.found is not None else ())
    )  # fmt: skip
    size = camera.width, camera.height
    return Seen(sensor, stamp, number, message, records, found.fault, _picture(image), size)


def _picture(image: ImageRecord) -> bytes:
    """A picture for the page; none of an image that cannot be decoded."""
    if image.data[:3] in (b"\xff\xd8\xff", b"\x89PN") and len(image.data) <= PICTURE_BYTES:
        return image.data
    try:
        gray = decode_gray(image)
        return jpeg_of(gray if gray.shape[1] <= PICTURE_PX else decode_small(image, PICTURE_PX), PICTURE_BYTES)
    except ImageError:
        return b""


def _moved_px(recent: Iterable[tuple[int, dict[str, Array]]], begin_ns: int, end_ns: int) -> float:
    """How far any corner moved in the images between two stamps, pixels."""
    inside = [used for stamp, used in recent if begin_ns <= stamp <= end_ns]
    moved = [
        float(np.linalg.norm(other[name] - corners, axis=1).max())
        for other in inside[1:]
        for name, corners in inside[0].items()
        if name in other and other[name].shape == corners.shape
    ]
    return max(moved, default=0.0)
