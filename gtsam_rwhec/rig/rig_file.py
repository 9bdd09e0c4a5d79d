"""Rig files read, with every fault and its line, and written."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from gtsam_rwhec.errors import FileFormatError, RigError
from gtsam_rwhec.files.yaml_lines import KeyPath, YamlFile, parse_yaml, read_text, shown, suggestion
from gtsam_rwhec.rig import schema
from gtsam_rwhec.rig.rig import Rig, RigFile

#: Faults that one message has, at most.
MOST_FAULTS = 20

_TARGETS: dict[str, type[BaseModel]] = {
    "tag": schema.TagTarget,
    "charuco": schema.CharucoTarget,
    "aprilgrid": schema.AprilGridTarget,
    "checkerboard": schema.CheckerboardTarget,
}
#: Which section is where; * is any name.
_SECTIONS: dict[KeyPath, type[BaseModel]] = {
    (): RigFile,
    ("carriers",): schema.Carriers,
    ("carriers", "poses"): schema.PoseSource,
    ("carriers", "noise"): schema.PoseNoise,
    ("sensors", "*"): schema.Sensor,
    ("sensors", "*", "intrinsics"): schema.Intrinsics,
    ("noise",): schema.Noise,
    ("cleaning",): schema.Cleaning,
}
_KINDS = {
    "float_type": "give a number",
    "int_type": "give a whole number",
    "int_from_float": "give a whole number",
    "string_type": "give text (in quotes if it looks like a number)",
    "bool_type": "give true or false",
    "finite_number": "give a finite number",
    "tuple_type": "give a list, [..., ...]",
    "dict_type": "give a section: names, each with what belongs to it",
}


def read_rig(path: str | Path) -> Rig:
    """Read a rig file.

    Parameters
    ----------
    path
        YAML in UTF-8; relative paths in it are relative to its folder.

    Raises
    ------
    RigError
        It cannot be read, is not YAML, or says what cannot be: every fault with its line.
    """
    try:
        text = read_text(path)
    except FileFormatError as error:
        raise RigError(str(error)) from error
    return parse_rig(text, str(path), Path(path).parent)


def parse_rig(text: str, where: str, folder: Path = Path()) -> Rig:
    """Read the text of a rig file.

    Parameters
    ----------
    text : str
    where : str
        The file, for messages.
    folder : Path
        What relative paths are relative to.

    Raises
    ------
    RigError
        As `read_rig`.
    """
    try:
        file = parse_yaml(text, where)
    except FileFormatError as error:
        raise RigError(str(error)) from error
    if not isinstance(file.data, dict):
        raise RigError(file.fault((), f"{shown(file.data)} in place of the sections carriers, sensors and targets"))
    try:
        said = RigFile.model_validate(file.data)
    except ValidationError as error:
        faults = sorted({(file.line(path), file.fault(path, words)) for path, words in _in_words(error, file)})
        rest = [f"and {len(faults) - MOST_FAULTS} more faults"] if len(faults) > MOST_FAULTS else []
        raise RigError("\n".join([words for _, words in faults[:MOST_FAULTS]] + rest)) from error
    return Rig(**{name: getattr(said, name) for name in RigFile.model_fields}, folder=folder)


def _in_words(error: ValidationError, file: YamlFile) -> Iterator[tuple[KeyPath, str]]:
    for fault in error.errors(include_url=False):
        path = _path(fault["loc"])
        if fault["type"].startswith("union_tag") and path[0] == "targets":
            path = (*path, "type")
        yield path, _words(fault, path, file)


def _path(loc: tuple[str | int, ...]) -> KeyPath:
    """A fault's place without the names that pydantic gives to a union's choices and to keys."""
    if loc[:1] == ("targets",) and len(loc) > 2:
        loc = (*loc[:2], *loc[3:])
    elif loc[:1] == ("noise",) and len(loc) > 1:
        loc = (*loc[:1], *loc[2:])
    return loc[:-1] if loc[-1:] == ("[key]",) else loc


def _words(fault: ErrorDetails, path: KeyPath, file: YamlFile) -> str:
    kind, given = fault["type"], fault["input"]
    context: dict[str, Any] = fault.get("ctx", {})
    if kind == "missing":
        model = _section(path[:-1], file.data)
        field = model.model_fields.get(str(path[-1])) if model else None
        about = f": {field.description}" if field is not None and field.description else ""
        return f"is missing{about}"
    if kind == "extra_forbidden":
        model = _section(path[:-1], file.data)
        return suggestion(str(path[-1]), list(model.model_fields) if model else [])
    if kind == "literal_error":
        section = " or a section" if path == ("noise",) else ""
        return f"{shown(given)}; give {context['expected']}{section}"
    if kind == "union_tag_invalid":
        return f"{shown(given['type'])}; give one of {', '.join(_TARGETS)}"
    if kind == "union_tag_not_found":
        return f"is missing: one of {', '.join(_TARGETS)}"
    if kind in ("model_type", "model_attributes_type"):
        model = _section(path, file.data)
        keys = f" with {', '.join(model.model_fields)}" if model else " with type and sizes"
        return f"{shown(given)}; give a section{keys}"
    if kind in _KINDS:
        return f"{shown(given)}; {_KINDS[kind]}"
    return fault["msg"].removeprefix("Value error, ")


def _section(path: KeyPath, data: Any) -> type[BaseModel] | None:
    """The section that is at a place."""
    if len(path) == 2 and path[0] == "targets":
        target = data["targets"][path[1]]
        kind = target.get("type") if isinstance(target, dict) else None
        return _TARGETS.get(kind) if isinstance(kind, str) else None
    general = tuple("*" if i == 1 and path[0] == "sensors" else key for i, key in enumerate(path))
    return _SECTIONS.get(general)


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


#: Where comments begin, where lines are shorter; beyond this width they stand on lines of their own.
_COLUMN, _WIDTH = 30, 120
_REMARKS: dict[KeyPath, str] = {
    ("carriers",): "frames: what the sensors are mounted on, and what the targets are",
    ("carriers", "max_gap_s"): "between poses further apart in time nothing is interpolated",
    ("carriers", "noise"): "standard deviations of the carriers' poses",
    ("targets",): "lengths in metres, as measured on the print",
    ("sizes",): "are the targets' sizes right? known, check or estimate",
    ("noise",): "of detections: estimate, {rotation_deg, translation_mm} or {corner_px}",
    ("cleaning", "max_rotation_deg_s"): "faster is left out; null: nothing is",
}


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


#: Text that no reader takes for anything else.
_PLAIN = re.compile(r"(?!(?:true|false|null|yes|no|on|off|y|n)$)[/]?[A-Za-z][A-Za-z0-9_/.]*", re.IGNORECASE)
