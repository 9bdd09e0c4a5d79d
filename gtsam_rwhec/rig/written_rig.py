"""The text of a rig file, with comments."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import BaseModel

from gtsam_rwhec.files.yaml_lines import KeyPath
from gtsam_rwhec.rig.rig import RigFile

#: Text that no reader takes for anything else.
_PLAIN = re.compile(r"(?!(?:true|false|null|yes|no|on|off|y|n)$)[/]?[A-Za-z][A-Za-z0-9_/.]*", re.IGNORECASE)
#: The column in which comments begin, where the text before them is shorter.
_COLUMN = 30
#: Longer comments stand on lines of their own, which are no wider than this.
_WIDTH = 120
_REMARKS: dict[KeyPath, str] = {
    ("carriers",): "frames: what the sensors are mounted on, and what the targets are",
    ("carriers", "max_gap_s"): "between poses further apart in time nothing is interpolated",
    ("carriers", "noise"): "standard deviations of the carriers' poses",
    ("targets",): "lengths in metres, as measured on the print",
    ("sizes",): "are the targets' sizes right? known, check or estimate",
    ("noise",): "of detections: estimate, {rotation_deg, translation_mm} or {corner_px}",
    ("cleaning", "max_rotation_deg_s"): "faster is left out; null: nothing is",
}


def rig_text(rig: RigFile, remarks: Mapping[KeyPath, str] | None = None) -> str:
    """YAML that `parse_rig` reads back equal, with comments.

    Parameters
    ----------
    rig : Rig
        Its folder is not written: relative paths are relative to where the text will be.
    remarks : mapping of key path to str, optional
        Comments in place of the usual ones: ``("targets", "tag_0")``.
    """
    said = {**_REMARKS, **(remarks or {})}
    lines = []
    for path, text in _lines(rig):
        remark = said.get(path)
        if remark is None and path[:1] == ("sensors",) and path[2:] == ("time_offset",):
            remark = "s: the sensor's stamp t is the carriers' t + offset; or the word estimate"
        line = f"{text:<{_COLUMN}}  # {remark}" if remark else text
        if remark and len(line) > _WIDTH:
            indent = " " * (len(text) - len(text.lstrip()))
            lines += textwrap.wrap(remark, _WIDTH, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}# ")
            line = text
        lines.append(line)
    return "\n".join(lines) + "\n"


def _lines(rig: RigFile) -> Iterator[tuple[KeyPath, str]]:
    """Each line with the path of what it says."""
    carriers = rig.carriers
    yield ("carriers",), "carriers:"
    yield ("carriers", "sensors"), f"  sensors: {_scalar(carriers.sensors)}"
    yield ("carriers", "targets"), f"  targets: {_scalar(carriers.targets)}"
    yield ("carriers", "poses"), f"  poses: {_flow(carriers.poses)}"
    yield ("carriers", "max_gap_s"), f"  max_gap_s: {_scalar(carriers.max_gap_s)}"
    if carriers.noise is not None:
        yield ("carriers", "noise"), f"  noise: {_flow(carriers.noise)}"
    yield ("sensors",), "sensors:"
    for name, sensor in rig.sensors.items():
        yield ("sensors", name), f"  {name}:"
        for key, value in sensor:
            if value is not None:
                text = _flow(value) if isinstance(value, BaseModel) else _scalar(value)
                yield ("sensors", name, key), f"    {key}: {text}"
    yield ("targets",), "targets:"
    for name, target in rig.targets.items():
        yield ("targets", name), f"  {name}: {_flow(target)}"
    yield ("sizes",), f"sizes: {rig.sizes}"
    yield ("noise",), f"noise: {rig.noise if isinstance(rig.noise, str) else _flow(rig.noise)}"
    if rig.detection:
        yield ("detection",), "detection:"
        for key, value in rig.detection.items():
            yield ("detection", key), f"  {key}: {_scalar(value)}"
    yield ("cleaning",), "cleaning:"
    for key, value in rig.cleaning:
        yield ("cleaning", key), f"  {key}: {_scalar(value)}"


def _flow(section: BaseModel) -> str:
    """A section in one line, without what is not given."""
    given = {key: value for key, value in section if value is not None}
    return "{" + ", ".join(f"{key}: {_value(value)}" for key, value in given.items()) + "}"


def _value(value: Any) -> str:
    if isinstance(value, tuple):
        return "[" + ", ".join(map(_scalar, value)) + "]"
    return _scalar(value)


def _scalar(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, float):
        mantissa, e, exponent = repr(value).partition("e")
        # With a point, for YAML 1.1 too, which takes 1e-05 for text.
        return f"{mantissa}{'' if '.' in mantissa else '.0'}{e}{exponent}" if e else mantissa
    if isinstance(value, str) and not _PLAIN.fullmatch(value):
        return json.dumps(value, ensure_ascii=False)
    return str(value)
