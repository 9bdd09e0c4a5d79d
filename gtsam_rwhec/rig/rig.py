"""A whole rig file: its sections, with a check for contradictions between them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import ConfigDict, Discriminator, Field, ValidationError, model_validator
from pydantic import Tag as UnionTag
from pydantic_core import InitErrorDetails, PydanticCustomError

from gtsam_rwhec.cameras.targets import Checkerboard, CircleGrid, Target, print_of
from gtsam_rwhec.detect.detections import DetectionOptions
from gtsam_rwhec.errors import OptionError, TargetError
from gtsam_rwhec.files.terminal_text import some
from gtsam_rwhec.files.yaml_lines import KeyPath, dotted, suggestion
from gtsam_rwhec.fitting.fit_options import Stated
from gtsam_rwhec.rig.odometry_sections import GivenSection, OdometrySensor, odometry_contradictions, with_what_follows
from gtsam_rwhec.rig.section_types import Name, Section, needed, optional
from gtsam_rwhec.rig.sections import Carriers, Cleaning, DetectionNoise, Sensor
from gtsam_rwhec.rig.target_sections import ObjectTarget, PrintedTarget, TargetSection

#: Sensors that see targets have images, detections or clouds; others have odometry.
AnySensor: TypeAlias = Annotated[
    Annotated[Sensor, UnionTag("sees")] | Annotated[OdometrySensor, UnionTag("moves")],
    Discriminator(
        lambda given: "moves" if "odometry" in (given if isinstance(given, dict) else dir(given)) else "sees"
    ),
]


def _may_leave_out(schema: dict[str, Any]) -> None:
    """In the JSON Schema: a reference takes the place of carriers, and odometries alone need no targets."""
    schema["required"] = ["sensors"]
    schema["oneOf"] = [{"required": ["carriers"]}, {"required": ["reference"]}]
    alone = {"properties": {"sensors": {"additionalProperties": {"required": ["odometry"]}}}}
    schema |= {"if": alone, "then": {}, "else": {"required": ["targets"]}}


class RigFile(Section):
    """The content of a rig file."""

    model_config = ConfigDict(json_schema_extra=_may_leave_out)

    carriers: Carriers = needed("the frames that carry the sensors and the targets, and their poses")
    all_sensors: dict[Name, AnySensor] = Field(
        alias="sensors",
        description="by name, each with images, detections or clouds of targets, or with odometry, its own motion",
    )
    targets: dict[Name, TargetSection] = needed(
        "by name, each with type and sizes; sensors that all have odometry need none"
    )
    sizes: Literal["known", "check", "estimate"] = optional(
        "known: the targets' sizes are right. check: they are taken as stated if the motion agrees, else "
        "estimated and named. estimate: from the motion",
        "known",
        default="check",
    )
    noise: Annotated[
        Annotated[DetectionNoise, UnionTag("numbers")] | Annotated[Literal["estimate"], UnionTag("word")],
        Discriminator(lambda given: "word" if isinstance(given, str) else "numbers"),
    ] = optional(
        "of the detections: the word estimate, from the residuals, or a section", {"corner_px": 0.1}, default="estimate"
    )
    detection: dict[str, Any] = optional("limits beyond which a detection is not used", {"min_side_px": 20}, default={})
    cleaning: Cleaning = optional(
        "which measurements are left out before solving", {"max_rotation_deg_s": 60.0}, default=Cleaning()
    )
    reference: Name | None = optional(
        "in place of carriers: the sensor with odometry in whose frame all others are calibrated", "lidar_front"
    )
    given: GivenSection = optional(
        "what a person measured where the motion does not tell: heights, directions, distances",
        {"heights_m": {"lidar_front": 0.52, "lidar_rear": 0.71}},
        default=GivenSection(),
    )

    @cached_property
    def sensors(self) -> dict[str, Sensor]:
        """The sensors that see targets, by name."""
        return {name: sensor for name, sensor in self.all_sensors.items() if isinstance(sensor, Sensor)}

    @cached_property
    def odometries(self) -> dict[str, OdometrySensor]:
        """The sensors that know only their own motion, by name; with the reference."""
        return {name: sensor for name, sensor in self.all_sensors.items() if isinstance(sensor, OdometrySensor)}

    @property
    def is_of_odometries(self) -> bool:
        """Whether no sensor sees a target, and only the sensors' own motions are known."""
        return self.reference is not None and not self.sensors

    @cached_property
    def calibrated(self) -> tuple[str, ...]:
        """The names of all sensors whose poses are estimated: all but the reference."""
        return tuple(name for name in self.all_sensors if name != self.reference)

    @cached_property
    def printed(self) -> dict[str, PrintedTarget]:
        """The targets that images show, by name: all but objects."""
        return {name: one for name, one in self.targets.items() if not isinstance(one, ObjectTarget)}

    @cached_property
    def target_list(self) -> tuple[Target, ...]:
        """The printed targets with their names, in the order of the file, for the vision package."""
        return tuple(section.target(name) for name, section in self.printed.items())

    @cached_property
    def object(self) -> str | None:
        """The target that clouds show; None without one."""
        return next((name for name in self.targets if name not in self.printed), None)

    @property
    def corner_px(self) -> float | None:
        """Standard deviation of a corner along each axis, pixels; None if the rig file does not state it."""
        return None if self.noise == "estimate" else self.noise.corner_px

    @property
    def detection_options(self) -> DetectionOptions:
        """The options of detection, with the values of the section ``detection``."""
        return DetectionOptions(**self.detection)

    def stated_of(self, sensor: str) -> Stated:
        """Where a sensor's intrinsics come from; of a shared camera those of the other sensor."""
        of = self.sensors[sensor]
        return self.sensors[of.shared].stated if of.shared is not None else of.stated

    @property
    def shared(self) -> tuple[tuple[str, ...], ...]:
        """Groups of sensors with one camera; the first of each has its intrinsics."""
        groups: dict[str, list[str]] = {}
        for name, sensor in self.sensors.items():
            if sensor.shared is not None:
                groups.setdefault(sensor.shared, [sensor.shared]).append(name)
        return tuple(map(tuple, groups.values()))

    def frame_of(self, sensor: str) -> str:
        """The name of a sensor's frame."""
        return self.carriers.sensors if sensor == self.reference else self.all_sensors[sensor].frame or sensor

    @model_validator(mode="before")
    @classmethod
    def _what_follows(cls, data: Any) -> Any:
        return with_what_follows(data)

    @model_validator(mode="after")
    def _is_consistent(self) -> RigFile:
        # pydantic keeps the fault locations of a ValidationError that is raised here.
        faults = [
            InitErrorDetails(type=PydanticCustomError("value_error", "{words}", {"words": words}), loc=path, input=None)
            for path, words in (
                *contradictions(self),
                *odometry_contradictions(self.carriers, self.odometries, len(self.sensors), self.reference, self.given),
            )
        ]
        if faults:
            raise ValidationError.from_exception_data("rig", faults)
        return self


@dataclass(frozen=True)
class Lines:
    """The lines of a rig file's values, for messages; they do not count when rig files are compared."""

    where: str = field(default="", compare=False)  #: The file; empty for a rig that was made in Python
    lines: Mapping[KeyPath, int] = field(default_factory=dict, compare=False)  #: The line of each value

    def place(self, *paths: KeyPath) -> str:
        """``FILE, lines N and M: a.b and a.c``, as far as known; for a value that is not written, the section's."""
        names = " and ".join(map(dotted, paths))
        numbers = list(dict.fromkeys(filter(None, map(self._line, paths))))
        if not self.where or not numbers:
            return names
        return f"{self.where}, line{'s' * (len(numbers) > 1)} {' and '.join(map(str, numbers))}: {names}"

    def _line(self, path: KeyPath) -> int | None:
        while path and path not in self.lines:
            path = path[:-1]
        return self.lines.get(path)


class Rig(RigFile):
    """A rig file that was read: its content, the folder that its relative paths start from, and its lines."""

    folder: Path = Path()
    source: Lines = Lines()


Fault = tuple[KeyPath, str]


def contradictions(rig: RigFile) -> Iterator[Fault]:
    """Yield every fault of a rig file's sections, as the path of the value and what is wrong with it."""
    yield from _carriers(rig.carriers)
    yield from _sensors(rig)
    printed = []
    if not rig.targets and (rig.sensors or not rig.all_sensors):
        yield ("targets",), "none; give at least one target"
    if rig.targets and rig.all_sensors and not rig.sensors:
        yield ("targets",), "no sensor sees them: all have odometry; leave targets out, or give a camera"
    for name, section in rig.printed.items():
        try:
            printed.append(section.target(name))
        except TargetError as error:
            yield ("targets", name), error.fault
    yield from _clouds(rig)
    yield from _names(rig)
    yield from _detection(rig.detection)
    yield from _lookalikes(printed)


def _carriers(carriers: Carriers) -> Iterator[Fault]:
    if carriers.sensors == carriers.targets:
        yield ("carriers", "targets"), f"{carriers.targets!r} also carries the sensors; name two different frames"
    elif set(carriers.poses.parent_and_child) != {carriers.sensors, carriers.targets}:
        poses = carriers.poses
        key = "tf" if poses.tf is not None else "frames" if poses.frames is not None else "parent"
        parent, child = carriers.poses.parent_and_child
        yield (
            ("carriers", "poses", key),
            f"poses of {child} in {parent} are not poses of the carriers; name {carriers.sensors} and "
            f"{carriers.targets}, in either order",
        )


def _sensors(rig: RigFile) -> Iterator[Fault]:
    if not rig.all_sensors:
        yield ("sensors",), "none; give at least one sensor"
    for key in ("images", "detections"):
        first: dict[str, str] = {}
        for name, sensor in rig.sensors.items():
            topic = getattr(sensor, key)
            if topic is not None and first.setdefault(topic, name) != name:
                words = f"{topic} is also the topic or path of sensor {first[topic]}; each sensor needs its own"
                yield ("sensors", name, key), words
    for name, sensor in rig.sensors.items():
        if sensor.shared is not None:
            other = rig.sensors.get(sensor.shared)
            there = [each for each, of in rig.sensors.items() if of.intrinsics is not None and of.shared is None]
            if other is None or other.intrinsics is None or other.shared is not None:
                known = f"these sensors do: {', '.join(there)}" if there else "no sensor does"
                what = (
                    "states no intrinsics of its own" if sensor.shared in rig.sensors else "is no sensor of this file"
                )
                words = f"{sensor.shared} {what}; {known}"
                yield ("sensors", name, "intrinsics", "shared"), words
        if sensor.poses is not None and rig.carriers.poses.frames is None:
            yield (
                ("sensors", name, "poses"),
                f"poses in files beside {'images' if sensor.images else 'clouds'}, and carriers.poses is of a log; "
                "write carriers.poses: {frames: [parent, child]} for these files",
            )


def _clouds(rig: RigFile) -> Iterator[Fault]:
    """Sensors with clouds that have nothing to see, and the reverse."""
    of_clouds = [name for name, sensor in rig.sensors.items() if sensor.clouds is not None]
    objects = [name for name in rig.targets if name not in rig.printed]
    if of_clouds and not objects:
        words = "clouds, and no target that they show; give one: targets: {object: {type: object}}"
        yield ("sensors", of_clouds[0], "clouds"), words
    for name in of_clouds[1:]:
        yield (
            ("sensors", name, "clouds"),
            f"{of_clouds[0]} has clouds too, and each sensor's clouds give the object a frame of its own; make a rig "
            "file for each",
        )
    for name in objects[1:]:
        yield (
            ("targets", name),
            f"clouds show one object, and {objects[0]} is one; all that stands still is that object",
        )
    if objects and not of_clouds and rig.sensors:
        yield (("targets", objects[0]), "an object is seen in clouds, and no sensor has any; give one: clouds: PATH")


def _names(rig: RigFile) -> Iterator[Fault]:
    """Names that two frames have."""
    carriers = rig.carriers
    named: list[tuple[str, KeyPath, str]] = [(carriers.sensors, ("carriers", "sensors"), "the sensors' carrier")]
    if carriers.targets != carriers.sensors:
        named.append((carriers.targets, ("carriers", "targets"), "the targets' carrier"))
    for name in rig.calibrated:
        sensor = rig.all_sensors[name]
        named.append((name, ("sensors", name), f"sensor {name}"))
        if sensor.frame not in (None, name):
            named.append((str(sensor.frame), ("sensors", name, "frame"), f"the frame of sensor {name}"))
        if isinstance(sensor, Sensor) and sensor.link is not None:
            named.append((sensor.link.frame, ("sensors", name, "link"), f"the link of sensor {name}"))
    named += [(name, ("targets", name), f"target {name}") for name in rig.targets]
    first: dict[str, str] = {}
    for name, path, what in named:
        if first.setdefault(name, what) != what:
            yield path, f"{name!r} is already the name of {first[name]}; each frame needs its own name"


def _detection(detection: Mapping[str, Any]) -> Iterator[Fault]:
    known = [field.name for field in fields(DetectionOptions)]
    for key, value in detection.items():
        if key not in known:
            yield ("detection", key), suggestion(key, known)
            continue
        try:
            replace(DetectionOptions(), **{key: value})
        except OptionError as error:
            yield ("detection", key), str(error)


def _lookalikes(targets: list[Target]) -> Iterator[Fault]:
    boards: dict[tuple[str, tuple[int, ...], bool], str] = {}
    prints: dict[tuple[str, int], str] = {}
    for target in targets:
        if isinstance(target, (Checkerboard, CircleGrid)):
            is_checkerboard = isinstance(target, Checkerboard)
            what, of = ("checkerboard", "inner corners") if is_checkerboard else ("grid", "circles")
            dot = isinstance(target, CircleGrid) and bool(target.larger_dot)
            counts: tuple[int, ...] = (target.columns, target.rows)
            if isinstance(target, CircleGrid) and target.asymmetric:
                what = "asymmetric grid"
            else:
                counts = tuple(sorted(counts))
            other = boards.setdefault((what, counts, dot), target.name)
            if other != target.name:
                yield (
                    ("targets", target.name),
                    f"a {what} of {target.columns} x {target.rows} {of}, like {other}: the boards "
                    "look the same in images; use boards with tags",
                )
            continue
        shared: dict[str, list[int]] = {}
        for id_ in target.ids:
            other = prints.setdefault((print_of(target.family), id_), target.name)
            if other != target.name:
                shared.setdefault(other, []).append(id_)
        for other, ids in shared.items():
            tags = some([str(i) for i in sorted(ids)], 5)
            yield (
                ("targets", target.name),
                f"tags {tags} of {target.family} also belong to target {other}: the targets look the same in "
                "images; print targets with different ids",
            )
