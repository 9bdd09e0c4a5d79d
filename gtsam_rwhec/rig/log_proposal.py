"""A first rig file, proposed from the content of a log; TODO marks the values that a person must state."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gtsam_rwhec.cameras.unknown_intrinsics import CORNERS
from gtsam_rwhec.errors import RigError
from gtsam_rwhec.files.terminal_text import some
from gtsam_rwhec.files.yaml_lines import KeyPath
from gtsam_rwhec.logs import IntrinsicsRecord, Log, Topic
from gtsam_rwhec.rig.carrier_roles import Origin, Role, evidence_of_log, first_time_offset
from gtsam_rwhec.rig.guessed_boards import STATED
from gtsam_rwhec.rig.guessed_targets import first_targets, take_sizes
from gtsam_rwhec.rig.log_contents import (
    DriverTopic,
    ImageTopic,
    LogContents,
    MovingPair,
    PoseTopic,
    camera_name,
    frame_of,
    free_name,
    moving_pairs,
    moving_topics,
    read_contents,
)
from gtsam_rwhec.rig.odometry_sections import OdometrySensor, OdometrySource
from gtsam_rwhec.rig.rig import Rig
from gtsam_rwhec.rig.rig_file import first_rig_text, parse_rig
from gtsam_rwhec.rig.section_types import TimeOffset, is_name, is_text
from gtsam_rwhec.rig.sections import Carriers, Intrinsics, Sensor
from gtsam_rwhec.rig.target_sections import ObjectTarget

#: Written if a log has no intrinsics; a person must replace it.
_NO_INTRINSICS = Intrinsics(file="camera.yaml")
MISSING = "TODO no topic has them; or {kalibr: camchain.yaml, camera: cam0}"


@dataclass(frozen=True)
class _Camera:
    """A proposed sensor: name, section, its frame in the log, and the comment on its intrinsics."""

    name: str
    section: Sensor
    frame: str
    remark: str


def propose_rig(log: Log, path: str | Path) -> tuple[str, tuple[str, ...]]:
    """Propose a rig file for a log; a person completes it.

    `path` is the rig file that will be written, for messages. Returns the text of a rig file that `parse_rig` reads,
    whose lengths are guesses marked TODO, and notes: what was seen, what was chosen, and what was left out.

    Raises
    ------
    RigError
        The log has no images, clouds or detections, or no poses that move; the message has the topics of the log.
    """
    contents = read_contents(log)
    notes: list[str] = []
    cameras = _cameras(contents, notes)
    if not cameras:
        sweeps = [topic for topic in contents.topics if is_of_sweeps(topic)]
        proposed = propose_odometries(contents.poses.values(), log.files[0].path.name, sweeps)
        proposed = proposed or _of_clouds(log, contents)
        if proposed is not None:
            parse_rig(proposed[0], str(path))
            return proposed
        raise RigError(f"{_where(log)}: no images, clouds or detections that can be read; {_topics(contents)}")
    pair = _moving(log, contents, [camera.frame for camera in cameras], notes)
    text = _text(log, contents, pair, cameras, notes)
    parse_rig(text, str(path))
    return text, tuple(notes)


def _moving(log: Log, contents: LogContents, frames: Sequence[str], notes: list[str]) -> MovingPair:
    """The frames that move, of which one carries the sensors with these frames."""
    pairs, remarks = moving_pairs(contents.poses.values(), frames)
    notes += remarks
    if not pairs:
        raise RigError(
            f"{_where(log)}: no poses of anything that moves, and without the carriers' motion nothing can be "
            f"calibrated. Record the poses of the robot or of the motion capture too; {_topics(contents)}"
        )
    notes.append(f"moving: {_pair_words(pairs[0])}")
    notes += [f"moves too, not used: {_pair_words(other)}" for other in pairs[1:6]]
    return pairs[0]


def _of_clouds(log: Log, contents: LogContents) -> tuple[str, tuple[str, ...]] | None:
    """The text and the notes for a log with clouds or depth images; None without any."""
    cameras = {
        topic: _intrinsics(topic, images.frame, contents.cameras, len(contents.images))[0]
        for topic, images in contents.images.items()
        if "depth" in topic.lower() and "info" not in topic.lower()
    }
    topics = [topic for topic in contents.topics if topic.has_clouds or topic.name in cameras]
    topics = [topic for topic in topics if topic.count and is_text(topic.name) and not topic.unreadable]
    if not topics:
        return None
    # It needs an extra that images do without.
    from gtsam_rwhec.rig.cloud_proposal import OBJECT, ONE_SENSOR, evidence_of_clouds

    # a depth image's topic may show the same
    topic, *others = sorted(topics, key=lambda topic: not topic.has_clouds)
    of_topic = frame_of(log, topic.name)
    notes = [f"not used: {other.name}, {ONE_SENSOR}" for other in others]
    pair = _moving(log, contents, [of_topic], notes)
    parent, child = pair.source.parent_and_child
    taken = {parent, child, OBJECT}
    of_log = evidence_of_log(log, contents, pair.source, {}, [])
    remarks: dict[KeyPath, str] = {("targets", OBJECT): "anything that stood still in front of the sensor"}
    name = free_name(camera_name(topic.name, of_topic), taken)
    intrinsics = cameras.get(topic.name)
    if intrinsics is None and topic.name in cameras:
        intrinsics, remarks["sensors", name, "intrinsics"] = _NO_INTRINSICS, MISSING
    frame = of_topic if is_name(of_topic) and of_topic not in taken else None
    sensor, solved, words = Sensor(clouds=topic.name, frame=frame, intrinsics=intrinsics), None, ""
    if topic.has_clouds and of_log.path is not None:
        found = evidence_of_clouds(log, topic, of_log.path, parent, child)
        sensor = sensor.model_copy(update={"unit_m": found.unit_m if found.unit_m != 1.0 else None})
        solved, words = found.role, f"; {found}"
    notes.append(f"sensor {name}: {topic.count} {'clouds' if topic.has_clouds else 'depth images'} in {topic.name}")
    carriers, remarks["carriers", "poses"] = _carriers(pair, solved, words, of_log.origin)
    carriers = carriers.model_copy(update={"noise": None})  # clouds state theirs, so residuals tell it
    rig = Rig(carriers=carriers, sensors={name: sensor}, targets={OBJECT: ObjectTarget(type="object")})
    return first_rig_text("log", log.files[0].path.name, rig, remarks), tuple(notes)


def _text(log: Log, contents: LogContents, pair: MovingPair, cameras: list[_Camera], notes: list[str]) -> str:
    parent, child = pair.source.parent_and_child
    taken = {parent, child}
    names = [free_name(camera.name, taken) for camera in cameras]
    used = [contents.images[c.section.images] for c in cameras if c.section.images is not None]
    drivers = [contents.drivers[c.section.detections] for c in cameras if c.section.detections is not None]
    targets, remarks, of_targets = first_targets(used, drivers, taken)
    notes += of_targets
    has_board = any(len(section.target(name).corners()) >= CORNERS for name, section in targets.items())
    sensors: dict[str, Sensor] = {}
    for name, camera in zip(names, cameras, strict=True):
        frame = camera.frame if is_name(camera.frame) and camera.frame not in taken else None
        taken |= {frame} if frame else set()
        intrinsics, remark = camera.section.intrinsics, camera.remark
        if camera.section.images is not None and intrinsics == _NO_INTRINSICS and has_board:
            intrinsics = Intrinsics(estimate="any")
            remark = "no topic has them: a board's images say them; a file is better"
        sensors[name] = camera.section.model_copy(update={"frame": frame, "intrinsics": intrinsics})
        if remark:
            remarks["sensors", name, "intrinsics"] = remark
    of_log = evidence_of_log(log, contents, pair.source, sensors, [s.target(name) for name, s in targets.items()])
    for name, sensor in sensors.items():
        time_offset, remarks["sensors", name, "time_offset"] = first_time_offset(of_log.rest.get(sensor.images or ""))
        sensors[name] = sensor.model_copy(update={"time_offset": time_offset})
    if of_log.roles.images:
        notes.append(of_log.roles.in_words(parent, child))
    take_sizes(targets, remarks, of_log.roles.sizes)
    words = f"; {of_log.roles.in_words(parent, child)}" if of_log.roles.images else ""
    carriers, remarks["carriers", "poses"] = _carriers(pair, of_log.roles.role, words, of_log.origin)
    notes.append(f"poses: {of_log.origin.words}")
    if carriers.noise is not None:
        remarks["carriers", "noise"] = (
            f"TODO errors of these poses, a guess: {of_log.origin.words}. Leave the line out if you do not know them: "
            "residuals tell too"
        )
    rig = Rig(carriers=carriers, sensors={**sensors}, targets={**targets})
    return first_rig_text("log", log.files[0].path.name, rig, remarks)


def _carriers(pair: MovingPair, solved: Role | None, words: str, origin: Origin) -> tuple[Carriers, str]:
    """Carriers by tf, else as the data are ``solved``, with the comment; ``words`` are of the evidence in the data."""
    parent, child = pair.source.parent_and_child
    of_tf = "parent" if pair.on_parent > pair.on_child else "child" if pair.on_child else None
    role = of_tf or solved or "child"
    sensors, targets = (parent, child) if role == "parent" else (child, parent)
    if of_tf is not None and solved not in (of_tf, None):
        remark = f"TODO {sensors} carries the sensors, as tf has it, but the data say the reverse{words}"
    elif of_tf is not None:
        remark = f"{sensors} carries the sensors, as tf has it{words}"
    elif solved is not None:
        remark = f"a guess: {sensors} carries the sensors{words}"
        if pair.source.topic is not None:
            remark += f". If the poses are T_{child}_{parent}, exchange parent and child, and sensors and targets above"
    else:
        remark = f"TODO fixed camera and target on the hand: exchange the two names{words}"
    if pair.source.topic is not None:
        remark += "; TODO check the frames' names: they are guesses if the topic has none"
    return Carriers(sensors=sensors, targets=targets, poses=pair.source, noise=origin.noise), remark


def _cameras(contents: LogContents, notes: list[str]) -> list[_Camera]:
    """Sensors with images, and drivers' detections if the log has no images of the same camera."""
    taken: set[str] = set()
    cameras: list[_Camera] = []

    def add(source: ImageTopic | DriverTopic, key: str, sources: int, missing: str) -> str:
        """Add a sensor, with the comment `missing` if the log lacks the intrinsics that it needs; return its name."""
        intrinsics, remark = _intrinsics(source.topic, source.frame, contents.cameras, sources)
        if intrinsics is None and missing:
            intrinsics, remark = _NO_INTRINSICS, missing
        name = free_name(camera_name(source.topic, source.frame), taken)
        section = Sensor.model_validate({key: source.topic, "intrinsics": intrinsics})
        cameras.append(_Camera(name, section, source.frame, remark))
        return name

    for images in _without_copies(contents, notes):
        name = add(images, "images", len(contents.images), MISSING)
        notes.append(f"camera {name}: {images.count} images in {images.topic}, {images.looked_at} looked at")
    with_images = {camera.frame for camera in cameras if camera.frame}
    for driver in contents.drivers.values():
        if driver.frame in with_images:
            notes.append(f"not used: detections in {driver.topic}; the log has images of the same camera")
            continue
        missing = "" if driver.has_poses else "TODO no topic has them, and the driver gives no poses"
        name = add(driver, "detections", len(contents.drivers), missing)
        notes.append(f"driver {name}: {driver.count} detections in {driver.topic}")
    return cameras


def _without_copies(contents: LogContents, notes: list[str]) -> list[ImageTopic]:
    """One topic for each camera: the topic with most images, raw before compressed, and never of depth."""
    best: dict[tuple[str, str], ImageTopic] = {}
    ranked = sorted(contents.images.values(), key=lambda images: ("Compressed" in images.schema, images.topic))
    for images in sorted(ranked, key=lambda images: -images.looked_at):
        key = camera_name(images.topic, images.frame), images.frame
        if "depth" in images.topic.lower():
            notes.append(f"not used: {images.topic}, depth")
        elif not images.looked_at:
            notes.append(f"not used: {images.topic}, {images.undecoded or 'no images'}")
        elif key in best:
            notes.append(f"not used: {images.topic}, of the same camera as {best[key].topic}")
        else:
            best[key] = images
    return sorted(best.values(), key=lambda images: images.topic)


def _intrinsics(
    topic: str, frame: str, known: Mapping[str, IntrinsicsRecord], sensors: int
) -> tuple[Intrinsics | None, str]:
    """The intrinsics for a topic, from a topic with the same frame or with a name that begins in the same way."""
    same_frame = [name for name, record in known.items() if frame and record.frame == frame]
    candidates = same_frame or list(known)
    shared = {name: _shared(topic, name) for name in candidates}
    most = max(shared.values(), default=0)
    best = [name for name in candidates if shared[name] == most]
    if not best or (not same_frame and not most and (len(known), sensors) != (1, 1)):
        return None, ""
    remark = f"TODO or {', '.join(best[1:])}; {STATED}" if len(best) > 1 else STATED
    return Intrinsics(topic=best[0], stated="nominal"), remark


def _shared(first: str, second: str) -> int:
    """Count the common words with which two topics begin."""
    pairs = list(zip(first.strip("/").split("/"), second.strip("/").split("/"), strict=False))
    return next((i for i, (a, b) in enumerate(pairs) if a != b), len(pairs))


def _pair_words(pair: MovingPair) -> str:
    parent, child = pair.source.parent_and_child
    return f"{child} in {parent} ({pair.words})"


def _where(log: Log) -> str:
    return some([str(file.path) for file in log.files], 3)


def _topics(contents: LogContents) -> str:
    listed = ", ".join(f"{topic.name} ({topic.schema}, {topic.count} messages)" for topic in contents.topics)
    return f"topics: {listed or 'none'}"


#: Words in topic names that describe the kind of data, and not the sensor.
OF_KIND = ("odom", "odometry", "pose", "poses", "odometry_pose", "pose_stamped", "local", "filtered", "points", "cloud")
#: Words that indicate visual odometry of one camera, whose lengths are not in metres.
OF_ONE_CAMERA = {"mono", "vo", "cam", "camera", "orb", "dso", "svo"}
_SCALE = (
    "scale: estimate, inside odometry, where its lengths are not metres (visual odometry of one camera); "
    "time_offset: 0.0 for one clock"
)


#: So many clouds, at least so many a second, are the sweeps of a LiDAR that may move; few clouds are views of a thing.
MANY_SWEEPS, SWEEPS_PER_S = 50, 2.0
#: What goes farther from its first pose (m) is no arm's hand.
BEYOND_ARMS_M = 3.0


def is_of_sweeps(topic: Topic) -> bool:
    """Whether a topic has clouds, as many and as often as a LiDAR that may move on has sweeps."""
    is_read = topic.has_clouds and not topic.unreadable and is_text(topic.name)
    seconds = 1e-9 * ((topic.last_ns or 0) - (topic.first_ns or 0))
    return is_read and topic.count >= MANY_SWEEPS and topic.count - 1 >= SWEEPS_PER_S * seconds


def propose_odometries(
    poses: Iterable[PoseTopic], where: str, sweeps: Sequence[Topic] = ()
) -> tuple[str, tuple[str, ...]] | None:
    """The text of a rig file, and what was seen; None with fewer than two sensors that know how they moved.

    That are topics of poses that move, the ``sweeps`` of two LiDARs or more, or of one beside poses of a vehicle.
    `where` is the log's name, for the head of the file. Other poses in tf are of the robot's own tree: not proposed.
    """
    taken: set[str] = set()
    poses = list(poses)
    driven = [of for of in poses if sweeps and of.is_moving and of.motion()[0] > BEYOND_ARMS_M]
    if len(sweeps) > 1 or driven:
        vehicle = max(driven, key=lambda of: of.count) if len(sweeps) == 1 else None
        return _of_sweeps(sweeps, where, vehicle)
    found = {free_name(_name(s.topic), taken): s for s in moving_topics(poses) if is_text(s.topic)}
    if len(found) < 2:
        return None
    may_lack_scale = {name for name in found if set(name.lower().split("_")) & OF_ONE_CAMERA}
    with_metres = [name for name in found if name not in may_lack_scale] or found
    reference = max(with_metres, key=lambda name: found[name].count)
    remarks: dict[KeyPath, str] = {
        ("reference",): "TODO a guess: the sensor in whose frame you want the others; its lengths must be metres"
    }
    remarks |= {("sensors", name, "odometry"): f"TODO {_SCALE}" for name in may_lack_scale}
    sources = {name: OdometrySource(topic=series.topic) for name, series in found.items()}
    more = (
        "# It has no images and no detections, and several topics of poses, each taken as what one sensor says of its\n"
        "# own motion. A vehicle that moves in a plane does not tell heights: add given: {heights_m: {SENSOR: 0.5}}.\n"
    )
    notes = tuple(
        f"moves: {name}, topic {series.topic}, {series.count} poses, up to {series.motion()[0]:.2g} m from the first"
        for name, series in found.items()
    )
    text = first_rig_text("log", where, _of_odometries(sources, reference), remarks, more)
    return text, (*notes, f"reference: {reference} (of those with metres, most poses)")


def _of_sweeps(sweeps: Sequence[Topic], where: str, vehicle: PoseTopic | None) -> tuple[str, tuple[str, ...]]:
    """LiDARs that know their motion by their own sweeps; poses beside several are no other sensor's, as a rule."""
    taken: set[str] = set()
    found = {free_name(_name(topic.name), taken): topic for topic in sweeps}
    sources = {name: OdometrySource(clouds=topic.name) for name, topic in found.items()}
    reference, why = max(found, key=lambda name: found[name].count), "most clouds"
    if vehicle is not None:
        frames = (vehicle.parent, vehicle.child)
        reference, why = free_name(vehicle.child if is_name(vehicle.child) else "vehicle", taken), "the vehicle's poses"
        sources[reference] = OdometrySource(tf=frames) if vehicle.is_tf else OdometrySource(topic=vehicle.topic)
    more = (
        "# Each LiDAR's motion is found by registering its sweeps, and their poses where two saw the same. Where\n"
        "# they did not, a vehicle in a plane tells no heights: add given: {heights_m: {SENSOR: 0.5}}. A topic of\n"
        "# poses may be a sensor too: {topic: /odom}.\n"
    )
    remarks: dict[KeyPath, str] = {("reference",): "TODO a guess: the sensor in whose frame you want the others"}
    notes = tuple(f"sweeps: {name}, topic {topic.name}, {topic.count} clouds" for name, topic in found.items())
    rig = _of_odometries(sources, reference)
    return first_rig_text("log", where, rig, remarks, more), (*notes, f"reference: {reference} ({why})")


def _of_odometries(sources: Mapping[str, OdometrySource], reference: str) -> Rig:
    """Sensors with odometry, whose clocks are compared with the reference's."""
    offsets: dict[str, TimeOffset] = {name: 0.0 if name == reference else "estimate" for name in sources}
    sensors = {name: OdometrySensor(odometry=of, time_offset=offsets[name]) for name, of in sources.items()}
    return Rig(sensors={**sensors}, reference=reference)


def _name(topic: str) -> str:
    """The sensor's name: the topic without the words for the kind of data."""
    parts = [part for part in topic.strip("/").split("/") if part]
    while len(parts) > 1 and parts[-1].lower() in OF_KIND:
        parts.pop()
    name = "_".join(parts)
    return name if is_name(name) else "odometry"
