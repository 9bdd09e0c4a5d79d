"""The content of a log for a rig file: cameras, tags in some of their images, drivers, and frames that move."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.detect.images import Gray, decode_gray
from gtsam_rwhec.detect.tags import BY_TRUST, SeenTag, tags_in_image
from gtsam_rwhec.errors import ImageError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import CloudRecord, DetectionRecord, ImageRecord, IntrinsicsRecord, Log, PoseRecord, Topic
from gtsam_rwhec.logs.records import schema_word
from gtsam_rwhec.rig.guessed_boards import BoardSeen, boards_seen
from gtsam_rwhec.rig.section_types import is_name, is_text
from gtsam_rwhec.rig.sections import PoseSource

#: This number of images of each topic, taken evenly from all, is searched for tags.
IMAGES = 12
#: This number of images of each topic is searched for tags of all families, which takes about a second for each image.
IMAGES_FOR_ALL = 3
#: At most this number of a driver's detections are kept, spread over the log.
DETECTIONS = 600
#: At most this many poses of each pair of frames are kept, to see whether the pair moves.
POSES = 1000
#: Metres. A frame stands still if it moves less than this and turns less than `STILL_RAD`.
STILL_M = 0.01
#: Radians; see `STILL_M`.
STILL_RAD = math.radians(1.0)


@dataclass
class Tags:
    """Tags of one family. They count in how many images each id had a single border, and a double one (AprilGrid)."""

    single: Counter[int] = field(default_factory=Counter)
    double: Counter[int] = field(default_factory=Counter)


@dataclass
class ImageTopic:
    """A topic or folder of images: its frame, and the tags in the images that were searched."""

    topic: str
    schema: str
    count: int
    frame: str = ""
    looked_at: int = 0
    undecoded: str = ""
    tags: dict[str, Tags] = field(default_factory=dict)
    wanted: frozenset[int] = frozenset()
    pictures: list[Gray] = field(default_factory=list)
    places: list[int] = field(default_factory=list)
    seen: list[list[SeenTag]] = field(default_factory=list)
    stamps_ns: list[int] = field(default_factory=list)

    @cached_property
    def boards(self) -> list[BoardSeen]:
        """The boards without tags in the images that were searched."""
        return boards_seen(self.pictures)

    def search(self, gray: Gray, place: int) -> None:
        """Search an image for tags, and keep it; `place` is its stamp in a log, or its number in a folder."""
        # The first few images show which families there are; the search for all of them takes a second for each image.
        families = BY_TRUST if self.looked_at < IMAGES_FOR_ALL else tuple(self.tags)
        self.looked_at += 1
        tags = tags_in_image(gray, families)
        for family, number, is_double in {(tag.family, tag.id, tag.is_double) for tag in tags}:
            found = self.tags.setdefault(family, Tags())
            (found.double if is_double else found.single)[number] += 1
        self.seen.append(tags)
        self.pictures.append(gray)
        self.places.append(place)


@dataclass
class DriverTopic:
    """A topic of detections: its frame, in how many messages each id was (by family), sizes, whether it has poses."""

    topic: str
    frame: str = ""
    count: int = 0
    ids: dict[str, Counter[int]] = field(default_factory=dict)
    size_m: dict[tuple[str, int], float] = field(default_factory=dict)
    has_poses: bool = True
    stride: int = 1
    kept: list[DetectionRecord] = field(default_factory=list)


@dataclass
class PoseTopic:
    """Poses of one pair of frames in one topic: their number, and some of them."""

    topic: str
    parent: str
    child: str
    is_tf: bool
    is_static: bool
    count: int = 0
    stride: int = 1
    kept: list[Array] = field(default_factory=list)

    def add(self, T: Array) -> None:
        """Count a pose, and keep every `stride`-th: the kept poses are spread evenly over the log."""
        if self.count % self.stride == 0:
            self.kept.append(T.copy())
            if len(self.kept) > POSES:
                self.kept, self.stride = self.kept[::2], 2 * self.stride
        self.count += 1

    def motion(self) -> tuple[float, float]:
        """The largest distance (m) and turn (rad) from the first pose."""
        step = se3.inverse(self.kept[0][None]) @ np.stack(self.kept)
        return (
            float(np.linalg.norm(step[:, :3, 3], axis=1).max()),
            float(np.linalg.norm(se3.so3_logmap(step[:, :3, :3]), axis=1).max()),
        )

    @property
    def is_moving(self) -> bool:
        """Whether the child moves relative to the parent."""
        if self.is_static or len(self.kept) < 2:
            return False
        moved, turned = self.motion()
        return moved > STILL_M or turned > STILL_RAD


@dataclass
class LogContents:
    """The content of a log by topic; poses by topic, parent and child."""

    topics: tuple[Topic, ...]
    images: dict[str, ImageTopic] = field(default_factory=dict)
    drivers: dict[str, DriverTopic] = field(default_factory=dict)
    cameras: dict[str, IntrinsicsRecord] = field(default_factory=dict)
    poses: dict[tuple[str, str, str], PoseTopic] = field(default_factory=dict)


def read_contents(log: Log) -> LogContents:
    """Read a log once, and search some of its images for tags."""
    topics = log.topics()
    contents = LogContents(topics)
    readable = {topic.name for topic in topics if is_text(topic.name)}
    # A message with several poses is about several objects, most often targets, and not about a carrier.
    readable -= {topic.name for topic in topics if topic.unreadable or schema_word(topic.schema) == "PosesInFrame"}
    transforms = {topic.name for topic in topics if topic.is_tf}
    for topic in topics:
        if topic.name in readable and topic.has_images:
            wanted = np.linspace(0, max(topic.count - 1, 0), IMAGES).round().astype(int)
            wanted_images = frozenset(wanted.tolist())
            contents.images[topic.name] = ImageTopic(topic.name, topic.schema, topic.count, wanted=wanted_images)
    for record in log.records(sorted(readable)):
        if isinstance(record, PoseRecord):
            key = record.topic, record.parent, record.child
            if key not in contents.poses:
                contents.poses[key] = PoseTopic(*key, is_tf=record.topic in transforms, is_static=record.is_static)
            contents.poses[key].add(record.T)
        elif isinstance(record, ImageRecord):
            _look_at(contents.images[record.topic], record)
        elif isinstance(record, IntrinsicsRecord):
            contents.cameras.setdefault(record.topic, record)
        elif isinstance(record, DetectionRecord):
            _take_detection(contents.drivers.setdefault(record.topic, DriverTopic(record.topic)), record)
    return contents


def frame_of(log: Log, topic: str) -> str:
    """The frame of a topic's first cloud or image; empty if there is none."""
    first = next(log.records([topic]), None)
    return first.frame if isinstance(first, CloudRecord | ImageRecord) else ""


def _look_at(images: ImageTopic, record: ImageRecord) -> None:
    images.frame = images.frame or record.frame
    images.stamps_ns.append(record.stamp_ns)
    if len(images.stamps_ns) - 1 not in images.wanted:
        return
    try:
        gray = decode_gray(record)
    except ImageError as error:
        images.undecoded = str(error)
        return
    images.search(gray, record.stamp_ns)


def _take_detection(driver: DriverTopic, record: DetectionRecord) -> None:
    driver.frame = driver.frame or record.frame
    driver.count += 1
    driver.has_poses &= record.T_camera_tag is not None
    if record.id.isdecimal() and len(record.id) < 10:
        number = int(record.id)
        driver.ids.setdefault(record.family, Counter())[number] += 1
        if driver.count % driver.stride == 0:
            driver.kept.append(record)
            if len(driver.kept) > DETECTIONS:
                driver.kept, driver.stride = driver.kept[::2], 2 * driver.stride
        if record.size_m is not None:
            driver.size_m[record.family, number] = record.size_m


@dataclass(frozen=True)
class MovingPair:
    """Two frames that move relative to each other."""

    source: PoseSource  #: where the log has their poses
    words: str  #: the topic, the number of poses, and how far they move
    on_child: int = 0  #: how many of the cameras' frames are fixed to the child in tf
    on_parent: int = 0  #: how many are fixed to the parent


def moving_pairs(poses: Iterable[PoseTopic], camera_frames: Iterable[str]) -> tuple[list[MovingPair], list[str]]:
    """Pairs of frames that could be the carriers, the most likely first; and remarks on pairs that cannot be used.

    Frames of tf that do not move relative to each other are one body. Each moving body that carries no other moving
    body gives a pair. The child is the body's own moving frame; the parent is the frame below the first moving link of
    its chain, such as base for base -> link -> hand.
    """
    poses = list(poses)
    cameras = list(camera_frames)
    pairs, remarks = _of_tf([p for p in poses if p.is_tf and p.child and p.child != p.parent], cameras)
    pairs += [_of_topic(series) for series in moving_topics(poses)]
    # The sort is stable: pairs of tf stay before topics, and pairs with more poses before others.
    pairs.sort(key=lambda pair: (pair.on_child, pair.on_parent), reverse=True)
    return pairs, remarks


def moving_topics(poses: Iterable[PoseTopic]) -> list[PoseTopic]:
    """The topics, not of tf, that have the poses of one pair of frames that moves."""
    by_topic: dict[str, list[PoseTopic]] = {}
    for series in poses:
        if not series.is_tf:
            by_topic.setdefault(series.topic, []).append(series)
    return [series for (series, *others) in by_topic.values() if series.is_moving and not others]


def _of_tf(series: list[PoseTopic], cameras: list[str]) -> tuple[list[MovingPair], list[str]]:
    links: dict[str, PoseTopic] = {}
    for link in series:
        links.setdefault(link.child, link)
    moving = {child for child, link in links.items() if link.is_moving}

    def up(frame: str) -> list[str]:
        chain = [frame]
        while chain[-1] in links and links[chain[-1]].parent not in chain:
            chain.append(links[chain[-1]].parent)
        return chain

    def body(frame: str) -> str:
        """The frame that represents a frame's body: its nearest moving frame, or its root."""
        chain = up(frame)
        return next((f for f in chain if f in moving), chain[-1])

    known = {frame for child in links for frame in up(child)}
    bodies = [body(camera) for camera in cameras if camera in known]
    carrying_others = {frame for child in moving for frame in up(child)[1:]}
    pairs, remarks = [], []
    for child in sorted(
        moving - carrying_others, key=lambda child: (-links[child].count, *(-x for x in links[child].motion()))
    ):
        top = [frame for frame in up(child) if frame in moving][-1]
        parent = links[top].parent
        bad = [frame for frame in (parent, child) if not is_name(frame)]
        if bad:
            remarks.append(f"tf {parent} to {child} moves, but a rig file cannot name {', '.join(map(repr, bad))}")
            continue
        words = _words(links[child], "/tf" if child == top else f"chain of {len(up(child)) - 1} links")
        pairs.append(MovingPair(PoseSource(tf=(parent, child)), words, bodies.count(child), bodies.count(body(parent))))
    return pairs, remarks


def _of_topic(series: PoseTopic) -> MovingPair:
    child = frame_name(series.child) or frame_name(series.topic) or "moving"
    parent = frame_name(series.parent) or "world"
    if parent == child:
        parent = f"{parent}_origin"
    return MovingPair(PoseSource(topic=series.topic, parent=parent, child=child), _words(series, series.topic))


def _words(series: PoseTopic, where: str) -> str:
    moved, turned = series.motion()
    return f"{where}: {series.count} poses, up to {moved:.2f} m and {math.degrees(turned):.0f} degrees"


#: Words in topic names that describe the kind of data, and not the camera.
COMMON = frozenset({
    "image", "image_raw", "image_color", "image_mono", "image_rect", "image_rect_color", "image_rect_raw", "compressed",
    "raw", "color", "colour", "rgb", "detections", "tag_detections", "apriltag_detections", "detection", "tags",
    "apriltag", "apriltags", "aruco", "aruco_markers", "aruco_detections", "markers", "marker_publisher",
    "images", "img", "imgs", "pictures", "data", ".",
})  # fmt: skip


def frame_name(text: str) -> str:
    """A valid frame name made from a text: characters that are not allowed become _; empty if none is left."""
    words = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in text)[:60].strip("_")
    return words if is_name(words) else (f"f_{words}" if words else "")


def camera_name(topic: str, frame: str) -> str:
    """Name a camera by the words of its topic or path that are not common, or else by its frame."""
    words = [word for word in topic.split("/") if word.lower() not in COMMON]
    return frame_name("_".join(words)) or frame_name(frame) or "camera"


def free_name(name: str, taken: set[str]) -> str:
    """Return the name, with a number added if it is taken. It is taken from now on."""
    numbered = (f"{name}_{number}" for number in range(2, len(taken) + 3))
    free = next(candidate for candidate in (name, *numbered) if candidate not in taken)
    taken.add(free)
    return free
