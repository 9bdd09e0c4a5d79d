"""A rig whose carrier is one of its own odometries: the sections ``carriers`` and ``targets`` that follow from it."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from gtsam_rwhec.files.yaml_lines import KeyPath, shown
from gtsam_rwhec.rig.odometry_section import OdometrySource
from gtsam_rwhec.rig.sections import Carriers

#: The frame in which the reference's odometry began is named after it, with this ending.
START = "_start"


def odometry_topic(sensor: str) -> str:
    """Topic of a stage's log with an odometry that came from a file: poses of the sensor in its starting frame."""
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
