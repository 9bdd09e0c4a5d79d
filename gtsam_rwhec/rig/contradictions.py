"""Contradictions between values of a rig file: a name given twice, targets that look alike."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from typing import Any

from gtsam_rwhec.cameras.targets import Checkerboard, CircleGrid, Target, print_of
from gtsam_rwhec.detect.detections import DetectionOptions
from gtsam_rwhec.errors import OptionError, TargetError
from gtsam_rwhec.files.yaml_lines import KeyPath, suggestion
from gtsam_rwhec.rig.odometry_section import OdometrySensor
from gtsam_rwhec.rig.sections import Carriers, Sensor
from gtsam_rwhec.rig.target_sections import TargetSection

Fault = tuple[KeyPath, str]


def contradictions(
    carriers: Carriers,
    all_sensors: Mapping[str, Sensor | OdometrySensor],
    targets: Mapping[str, TargetSection],
    detection: Mapping[str, Any],
    reference: str | None = None,
) -> Iterator[Fault]:
    """Yield every fault of a rig file's sections, as the path of the value and what is wrong with it."""
    sensors = {name: sensor for name, sensor in all_sensors.items() if isinstance(sensor, Sensor)}
    yield from _carriers(carriers)
    yield from _sensors(sensors, all_sensors)
    yield from _poses(carriers, sensors)
    printed = []
    if not targets and (sensors or not all_sensors):
        yield ("targets",), "none; give at least one target"
    if targets and all_sensors and not sensors:
        yield ("targets",), "no sensor sees them: all have odometry; leave targets out, or give a camera"
    for name, section in targets.items():
        try:
            printed.append(section.target(name))
        except TargetError as error:
            yield ("targets", name), error.fault
    yield from _names(carriers, {name: s for name, s in all_sensors.items() if name != reference}, targets)
    yield from _detection(detection)
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


def _sensors(sensors: Mapping[str, Sensor], all_sensors: Mapping[str, Sensor | OdometrySensor]) -> Iterator[Fault]:
    if not all_sensors:
        yield ("sensors",), "none; give at least one sensor"
    for key in ("images", "detections"):
        first: dict[str, str] = {}
        for name, sensor in sensors.items():
            topic = getattr(sensor, key)
            if topic is not None and first.setdefault(topic, name) != name:
                words = f"{topic} is also the topic or path of sensor {first[topic]}; each sensor needs its own"
                yield ("sensors", name, key), words


def _poses(carriers: Carriers, sensors: Mapping[str, Sensor]) -> Iterator[Fault]:
    """Poses in files are those of a folder, and need the frames."""
    for name, sensor in sensors.items():
        if sensor.poses is not None and carriers.poses.frames is None:
            yield (
                ("sensors", name, "poses"),
                "poses in files beside images, and carriers.poses is of a log; write carriers.poses: "
                "{frames: [parent, child]} for these files",
            )


def _names(
    carriers: Carriers, sensors: Mapping[str, Sensor | OdometrySensor], targets: Mapping[str, TargetSection]
) -> Iterator[Fault]:
    """Names that two frames have."""
    named: list[tuple[str, KeyPath, str]] = [(carriers.sensors, ("carriers", "sensors"), "the sensors' carrier")]
    if carriers.targets != carriers.sensors:
        named.append((carriers.targets, ("carriers", "targets"), "the targets' carrier"))
    for name, sensor in sensors.items():
        named.append((name, ("sensors", name), f"sensor {name}"))
        if sensor.frame not in (None, name):
            named.append((str(sensor.frame), ("sensors", name, "frame"), f"the frame of sensor {name}"))
        if isinstance(sensor, Sensor) and sensor.link is not None:
            named.append((sensor.link.frame, ("sensors", name, "link"), f"the link of sensor {name}"))
    named += [(name, ("targets", name), f"target {name}") for name in targets]
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
            some = ", ".join(map(str, sorted(ids)[:5])) + (", ..." if len(ids) > 5 else "")
            yield (
                ("targets", target.name),
                f"tags {some} of {target.family} also belong to target {other}: the targets look the same in "
                "images; print targets with different ids",
            )
