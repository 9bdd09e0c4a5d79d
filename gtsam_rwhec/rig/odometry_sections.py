"""The sections of a sensor that knows only its own motion: LiDAR odometry, visual odometry, wheels, an INS."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from gtsam_rwhec.files.yaml_lines import KeyPath, shown
from gtsam_rwhec.rig.section_types import (
    FramePair,
    Name,
    Or,
    Positive,
    Section,
    Text,
    TimeOffset,
    list_of,
    needed,
    one_of,
    optional,
)
from gtsam_rwhec.rig.sections import Carriers


def _none_for_estimate(given: Any) -> Any:
    return None if isinstance(given, str) and given == "estimate" else given


class OdometryNoiseSection(Section):
    """How the errors of an odometry grow: as a random walk, whose steps are independent of one another."""

    rotation_deg_per_sqrt_s: Positive = needed(
        "standard deviation about each axis after one second; after t seconds it is sqrt(t) times this",
        0.05,
        unit="degrees/sqrt(s)",
    )
    translation_mm_per_sqrt_s: Positive = needed(
        "standard deviation along each axis after one second", 4.0, unit="mm/sqrt(s)"
    )


class OdometrySource(Section):
    """Where an odometry's poses (in the frame in which it began) are, and what is known of the poses."""

    model_config = one_of("topic", "tf", "file", "clouds")

    topic: Text | None = optional("a topic of Odometry, PoseStamped or PoseInFrame", "/lidar_front/odom")
    tf: FramePair | None = optional("two frames of tf, [start, sensor]", ["lidar_odom", "lidar_link"])
    file: Text | None = optional(
        "a file of poses (TUM: t x y z qx qy qz qw; CSV), in the folder that is given as the log, or beside the "
        "rig file",
        "lidar_front.tum",
    )
    clouds: Text | None = optional(
        "a topic of a LiDAR's clouds (PointCloud2, PointCloud): its motion is found by registering its sweeps one "
        "after another; points with times let the motion during a sweep be taken off",
        "/lidar_front/points",
    )
    together: bool = optional(
        "whether its clouds are registered with those of other LiDARs, where both saw the same: false, if each should "
        "be calibrated by the motions alone",
        False,
        default=True,
    )
    scale: Literal["known", "estimate"] = optional(
        "known: lengths are metres. estimate: they are metres times one unknown factor, as those of visual "
        "odometry with one camera",
        "estimate",
        default="known",
    )
    noise: Annotated[OdometryNoiseSection | None, BeforeValidator(_none_for_estimate), Or(const="estimate")] = optional(
        "how its errors grow; without it, or with the word estimate, from the data",
        {"rotation_deg_per_sqrt_s": 0.05, "translation_mm_per_sqrt_s": 4.0},
    )
    max_gap_s: Positive = optional(
        "poses further apart in time than this are of two pieces: no motion is taken over the gap", 0.2, default=0.5
    )
    max_turn_deg_s: Positive = optional(
        "a step between two poses that turns faster is lost tracking (the DQ paper's 11.5 degrees a frame, at 30 "
        "frames a second)",
        120.0,
        default=345.0,
    )
    max_speed_m_s: Positive = optional(
        "a step between two poses that is faster is lost tracking, in the odometry's own lengths; the DQ paper "
        "has 0.1 m a frame, for sensors that are carried",
        3.0,
        default=70.0,
    )

    @model_validator(mode="after")
    def _is_one(self) -> OdometrySource:
        given = self._given("topic", "tf", "file", "clouds")
        self._need_one(given, "topic (of Odometry or PoseStamped), tf: [start, sensor], file (TUM), clouds (a topic)")
        return self

    @property
    def registers(self) -> bool:
        """Whether there are clouds, which may be registered with those of other LiDARs."""
        return self.clouds is not None and self.together

    @property
    def place(self) -> str:
        """Where the poses are, for messages."""
        if self.tf is not None:
            return f"tf {self.tf[0]} to {self.tf[1]}"
        if self.clouds is not None:
            return f"clouds of topic {self.clouds}"
        return f"topic {self.topic}" if self.topic is not None else f"file {self.file}"


class OdometrySensor(Section):
    """A sensor that knows only its own motion, as a LiDAR, a camera with visual odometry, wheels, an INS."""

    odometry: OdometrySource = needed(
        "{topic: ...}, {tf: [start, sensor]}, {file: ...} or {clouds: ...}, and what is known of these poses",
        {"topic": "/lidar_front/odom"},
    )
    time_offset: TimeOffset = optional(
        "the sensor's stamp t is t + offset of the carriers, or of the reference; or the word estimate",
        "estimate",
        default=0.0,
        unit="s",
    )
    frame: Name | None = optional("its frame in the results; without it the sensor's name", "lidar_front_link")


def _unit(given: tuple[float, float, float]) -> tuple[float, float, float]:
    length = float(np.linalg.norm(given))
    if not 1e-9 < length < 1e9:
        raise ValueError(f"{list(given)} has the length {length:.3g}, and no direction; give three numbers, not all 0")
    x, y, z = (np.array(given) / length).tolist()
    return given if abs(length - 1.0) < 1e-12 else (x, y, z)


#: A direction, of any length; it is stored with the length 1.
Direction: TypeAlias = Annotated[
    tuple[float, float, float], list_of(3, "a direction, [x, y, z]"), AfterValidator(_unit)
]
SensorPair: TypeAlias = Annotated[tuple[Name, Name], list_of(2, "two sensors, [one, other]")]


class GivenGround(Section):
    """The plane that the vehicle drives on, in the axes of the reference."""

    up: Direction = needed("the direction away from the ground, of any length", [0.0, 0.0, 1.0])
    below_m: float = needed("how far the plane is below the reference's origin", 0.52)
    sigma_deg: Positive = optional("standard deviation of the direction", 0.2, default=0.5)
    sigma_mm: Positive = optional("standard deviation of below_m", 2.0, default=5.0)


class GivenDirection(Section):
    """A direction that is known in the axes of the reference: of an axis of a sensor, or of the line to its origin."""

    sensor: Name = needed("the sensor", "camera_left")
    of: Literal["x", "y", "z", "lever_arm"] = needed(
        "what has the direction: an axis of the sensor, or (lever_arm) the line from the reference's origin to "
        "the sensor's",
        "z",
    )
    in_reference: Direction = needed("its direction in the axes of the reference, of any length", [1.0, 0.0, 0.0])
    sigma_deg: Positive = optional("standard deviation of the direction", 0.2, default=0.5)


class GivenDistance(Section):
    """A distance between the origins of two sensors, as a tape measure says it."""

    between: SensorPair = needed("the two sensors", ["lidar_front", "lidar_rear"])
    distance_m: Annotated[float, Field(gt=0.0, lt=1000.0)] = needed("the distance", 2.41)
    sigma_mm: Positive = optional("standard deviation of the distance", 3.0, default=5.0)


class GivenSection(Section):
    """What a person measured, where the motion does not tell: a vehicle in a plane does not tell heights."""

    heights_m: dict[Name, float] = optional(
        "heights of sensors' origins above the ground; the reference needs one too, or ground",
        {"lidar_front": 0.52, "lidar_rear": 0.71},
        default={},
    )
    height_sigma_mm: Positive = optional("standard deviation of each height", 2.0, default=5.0)
    ground: GivenGround | None = optional(
        "the ground's plane; without it heights are along the axis that the vehicle turned about",
        {"up": [0, 0, 1], "below_m": 0.52},
    )
    directions: Annotated[tuple[GivenDirection, ...], Field(max_length=1000)] = optional(
        "directions that are known in the axes of the reference",
        [{"sensor": "camera_left", "of": "z", "in_reference": [1, 0, 0]}],
        default=(),
    )
    distances: Annotated[tuple[GivenDistance, ...], Field(max_length=1000)] = optional(
        "measured distances between sensors, used in the refinement",
        [{"between": ["lidar_front", "lidar_rear"], "distance_m": 2.41}],
        default=(),
    )


#: The frame in which the reference's odometry began is named after it, with this ending.
START = "_start"


def odometry_topic(sensor: str) -> str:
    """Topic of a stage's log with an odometry from a file or from clouds: poses of the sensor in its starting frame."""
    return f"/calibration/{sensor}/odometry"


def with_what_follows(data: Any) -> Any:
    """The content of a rig file with the sections that it may leave out: see `reference_faults` for when it may.

    ``reference: NAME`` says that the sensor NAME carries the others, and that its odometry is the carrier's motion.
    """
    if not isinstance(data, Mapping):
        return data
    sensors = data.get("sensors")
    if not isinstance(sensors, Mapping) or not sensors:
        return data
    faults = list(_faults(data, sensors))
    if faults:
        raise ValidationError.from_exception_data("rig", faults)
    made = dict(data)
    name = data.get("reference")
    if name is not None and "carriers" not in data:
        made["carriers"] = carriers_of(name, sensors[name])
    if "targets" not in data and all(map(_has_odometry, sensors.values())):
        made["targets"] = {}
    return made


def carriers_of(name: str, sensor: Any) -> Any:
    """The section ``carriers`` of a rig whose reference is this sensor; as it was given where it cannot be read."""
    source, frame = _value(sensor, "odometry"), _value(sensor, "frame") or name
    tf, topic = _value(source, "tf"), _value(source, "topic")
    gap = _value(source, "max_gap_s")
    gap = OdometrySource.model_fields["max_gap_s"].default if gap is None else gap
    try:
        if isinstance(tf, tuple):
            made = {"sensors": tf[1], "targets": tf[0], "poses": {"tf": tf}}
        else:
            start = f"{frame}{START}"
            poses = {"topic": topic or odometry_topic(name), "parent": start, "child": frame}
            made = {"sensors": frame, "targets": start, "poses": poses}
        return Carriers.model_validate({**made, "max_gap_s": gap})
    except (ValidationError, IndexError):  # the faults are the sensor's own, and are said there
        poses = {"topic": "/odometry", "parent": "start", "child": "reference"}
        return Carriers.model_validate({"sensors": "reference", "targets": "start", "poses": poses})


def nearest(name: str, names: Sequence[str]) -> str:
    """``did you mean NAME?``, or which names there are."""
    close = difflib.get_close_matches(name, names, n=1)
    return f"did you mean {close[0]}?" if close else f"those with odometry are {', '.join(names) or 'none'}"


def _faults(data: Mapping[str, Any], sensors: Mapping[str, Any]) -> list[InitErrorDetails]:
    name = data.get("reference")
    with_motion = [str(key) for key, sensor in sensors.items() if _has_odometry(sensor)]
    if name is None:
        if with_motion and "carriers" not in data:
            first = shown(with_motion[0]).strip("'")
            return [
                _fault(
                    ("carriers",),
                    "is missing: the frames that carry the sensors and the targets, and their poses. Where only the "
                    f"sensors' own motions are known, name one of them in its place, such as reference: {first}",
                )
            ]
        return []
    if not isinstance(name, str):
        return [_fault(("reference",), f"{shown(name)}; give the name of a sensor")]
    if name not in sensors:
        return [_fault(("reference",), f"there is no sensor {shown(name)}; {nearest(name, with_motion)}")]
    if name not in with_motion:
        has = ", ".join(with_motion) or "none has"
        words = f"sensor {name} has no odometry, and nothing says how it moved; name one of those with odometry: {has}"
        return [_fault(("reference",), words)]
    return []


def _has_odometry(sensor: Any) -> bool:
    return (isinstance(sensor, Mapping) and "odometry" in sensor) or hasattr(sensor, "odometry")


def _value(section: Any, key: str) -> Any:
    return section.get(key) if isinstance(section, Mapping) else getattr(section, key, None)


def _fault(path: KeyPath, words: str) -> InitErrorDetails:
    return InitErrorDetails(type=PydanticCustomError("value_error", "{words}", {"words": words}), loc=path, input=None)


Fault = tuple[KeyPath, str]
#: Two statements of one length contradict one another from this many standard deviations on.
SURELY = 6.0


def odometry_contradictions(
    carriers: Carriers,
    odometries: Mapping[str, OdometrySensor],
    others: int,
    reference: str | None,
    given: GivenSection,
) -> Iterator[Fault]:
    """Yield every fault, as the path of the value and what is wrong with it; `others` counts sensors that see."""
    yield from _sources(odometries)
    if reference is not None:
        yield from _reference(carriers, odometries, others, reference)
    for path, name in _named(given):
        if name not in odometries:
            yield path, f"there is no sensor {name} with odometry; {nearest(name, list(odometries))}"
    if reference is None and given != GivenSection():
        words = "is used with reference: NAME, where only the sensors' own motions are known; leave it out"
        yield ("given",), words
    yield from _ground(given, reference)
    yield from _distances(given)


def _sources(odometries: Mapping[str, OdometrySensor]) -> Iterator[Fault]:
    first: dict[str, str] = {}
    for name, sensor in odometries.items():
        place = sensor.odometry.place
        if first.setdefault(place, name) != name:
            words = f"{place} is also the odometry of sensor {first[place]}; each sensor needs its own"
            yield ("sensors", name, "odometry"), words


def _reference(
    carriers: Carriers, odometries: Mapping[str, OdometrySensor], others: int, reference: str
) -> Iterator[Fault]:
    sensor = odometries[reference]
    if carriers != carriers_of(reference, sensor):
        yield (
            ("reference",),
            f"{reference} carries the sensors, and so does {carriers.sensors} of carriers; give one of both: "
            "carriers where other poses are known, reference where only the sensors' own motions are",
        )
    if len(odometries) + others < 2:
        yield ("sensors",), f"only {reference}, the reference; give at least one sensor that is calibrated to it"
    if sensor.odometry.scale == "estimate":
        yield (
            ("reference",),
            f"lengths of {reference} are not known (scale: estimate), and no length would be; name a sensor whose "
            "scale is known",
        )
    if sensor.time_offset != 0.0:
        yield (
            ("sensors", reference, "time_offset"),
            f"{sensor.time_offset}, and its clock is the one that all others are compared with; leave it out",
        )


def _named(given: GivenSection) -> Iterator[tuple[KeyPath, str]]:
    """The sensors that are named, and where."""
    yield from ((("given", "heights_m", name), name) for name in given.heights_m)
    yield from ((("given", "directions", i, "sensor"), one.sensor) for i, one in enumerate(given.directions))
    for i, one in enumerate(given.distances):
        yield from ((("given", "distances", i, "between", end), name) for end, name in enumerate(one.between))


def _ground(given: GivenSection, reference: str | None) -> Iterator[Fault]:
    ground = given.ground
    if ground is not None and reference in given.heights_m:
        height = given.heights_m[reference]
        if abs(height - ground.below_m) > SURELY * 1e-3 * np.hypot(given.height_sigma_mm, ground.sigma_mm):
            yield (
                ("given", "heights_m", reference),
                f"{height:g} m above the ground, and given.ground says that the ground is {ground.below_m:g} m below "
                f"{reference}; correct one of the two",
            )
    over_m = given.heights_m.get(str(reference), 0.0 if ground is None else ground.below_m)
    for name, height in given.heights_m.items():
        if height < 0.0 < over_m:  # from a reference at height 0 on they may be relative
            words = f"{height:g} m is below the ground, which is {over_m:g} m below {reference}"
            yield ("given", "heights_m", name), f"{words}; give its height over the ground"
    others = [name for name in given.heights_m if name != reference]
    if others and reference is not None and reference not in given.heights_m and ground is None:
        yield (
            ("given", "heights_m", others[0]),
            f"heights are compared with that of the reference; give the height of {reference} too, or ground",
        )
    if reference in given.heights_m and not others and ground is None:
        yield (
            ("given", "heights_m", reference),
            f"the height of {reference} alone, the reference, says nothing of another sensor; give theirs too",
        )
    for i, one in enumerate(given.directions):
        if one.sensor == reference:
            words = f"{reference} is the reference, in whose axes directions are given; name another sensor"
            yield ("given", "directions", i, "sensor"), words


def _distances(given: GivenSection) -> Iterator[Fault]:
    first: dict[tuple[str, ...], int] = {}
    for i, one in enumerate(given.distances):
        path: KeyPath = ("given", "distances", i)
        ends = tuple(sorted(one.between))
        if ends[0] == ends[1]:
            yield (*path, "between"), f"{ends[0]} twice; name two sensors"
            continue
        before = given.distances[first.setdefault(ends, i)]
        sigma_m = 1e-3 * float(np.hypot(one.sigma_mm, before.sigma_mm))
        if abs(one.distance_m - before.distance_m) > SURELY * sigma_m:
            words = f"{one.distance_m:g} m, and given.distances[{first[ends]}] says {before.distance_m:g} m"
            yield (*path, "distance_m"), f"{words} for {ends[0]} and {ends[1]}; correct one of the two"
        apart_m = [given.heights_m[name] for name in ends if name in given.heights_m]
        if len(apart_m) == 2 and abs(apart_m[0] - apart_m[1]) > one.distance_m + SURELY * 1e-3 * (
            one.sigma_mm + given.height_sigma_mm
        ):
            words = f"{one.distance_m:g} m, and the heights of {ends[0]} and {ends[1]} differ by"
            yield (*path, "distance_m"), f"{words} {abs(apart_m[0] - apart_m[1]):g} m; correct one of them"
