"""Reading rig files; an error names every fault with its line."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from gtsam_rwhec.errors import FileFormatError, RigError, UnfinishedRigWarning
from gtsam_rwhec.files.yaml_lines import KeyPath, YamlFile, parse_yaml, read_text, shown, suggestion
from gtsam_rwhec.rig import given_section, intrinsics_section, odometry_section, sections, target_sections
from gtsam_rwhec.rig.field_types import in_yaml, unit_of
from gtsam_rwhec.rig.kalibr_targets import with_kalibr_targets
from gtsam_rwhec.rig.rig import Lines, Rig, RigFile
from gtsam_rwhec.rig.section import keys_of
from gtsam_rwhec.rig.unfinished import todo_lines

#: A message names at most this many faults.
MOST_FAULTS = 20

#: Each type of target has this section.
_TARGETS: dict[str, type[BaseModel]] = {
    "tag": target_sections.TagTarget,
    "charuco": target_sections.CharucoTarget,
    "aprilgrid": target_sections.AprilGridTarget,
    "tag_grid": target_sections.TagGridTarget,
    "bundle": target_sections.BundleTarget,
    "checkerboard": target_sections.CheckerboardTarget,
    "circle_grid": target_sections.CircleGridTarget,
}
#: Each place has this section; * stands for any name.
_SECTIONS: dict[KeyPath, type[BaseModel]] = {
    (): RigFile,
    ("carriers",): sections.Carriers,
    ("carriers", "poses"): sections.PoseSource,
    ("carriers", "noise"): sections.PoseNoise,
    ("sensors", "*", "intrinsics"): intrinsics_section.Intrinsics,
    ("sensors", "*", "link"): sections.Link,
    ("sensors", "*", "odometry"): odometry_section.OdometrySource,
    ("sensors", "*", "odometry", "noise"): odometry_section.OdometryNoiseSection,
    ("noise",): sections.DetectionNoise,
    ("cleaning",): sections.Cleaning,
    ("given",): given_section.GivenSection,
    ("given", "ground"): given_section.GivenGround,
    ("given", "directions", "*"): given_section.GivenDirection,
    ("given", "distances", "*"): given_section.GivenDistance,
}
#: These words say what to do about a fault, by pydantic's name for its kind.
_KINDS = {
    "float_type": "give a number",
    "int_type": "give a whole number",
    "int_from_float": "give a whole number",
    "string_type": "give text (in quotes if it looks like a number)",
    "bool_type": "give true or false",
    "finite_number": "give a finite number",
    "tuple_type": "give a list, [..., ...]",
    "dict_type": "give a section of names, each with its own keys",
}


def read_rig(path: str | Path) -> Rig:
    """Read a rig file.

    Parameters
    ----------
    path
        YAML in UTF-8. Relative paths in it start from its folder.

    Raises
    ------
    RigError
        The file cannot be read, is not YAML, or has faults: the message names every fault with its line.

    Warns
    -----
    UnfinishedRigWarning
        Lines are still marked TODO.
    """
    try:
        text = read_text(path)
    except FileFormatError as error:
        raise RigError(str(error)) from error
    rig = parse_rig(text, str(path), Path(path).parent)
    lines = todo_lines(text)
    if lines:
        said = "\n".join(map(str, lines[:MOST_FAULTS]))
        warnings.warn(
            f"{path} has lines that are marked TODO, whose values are guesses. State them, and take the mark away:\n"
            f"{said}",
            UnfinishedRigWarning,
            stacklevel=2,
        )
    return rig


def parse_rig(text: str, where: str, folder: Path = Path()) -> Rig:
    """Read the text of a rig file.

    Parameters
    ----------
    text : str
    where : str
        The file, for messages.
    folder : Path
        The folder that relative paths start from.

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
    file = with_kalibr_targets(file, folder)
    try:
        said = RigFile.model_validate(file.data)
    except ValidationError as error:
        raise RigError(_in_words(error, file)) from error
    content = {field.alias or name: getattr(said, name) for name, field in RigFile.model_fields.items()}
    return Rig(**content, folder=folder, source=Lines(where, file.lines))


def _in_words(error: ValidationError, file: YamlFile) -> str:
    """The faults in the order of their lines: the first `MOST_FAULTS`, and how many more there are."""
    faults = [(_place(fault), fault) for fault in error.errors(include_url=False)]
    faults.sort(key=lambda entry: file.line(entry[0]))
    named: set[tuple[int, str]] = set()
    rest: set[tuple[KeyPath, str]] = set()
    for path, fault in faults:
        if len(named) < MOST_FAULTS:
            named.add((file.line(path), file.fault(path, _words(fault, path, file))))
        else:  # no words for the rest: there may be thousands
            rest.add((path, fault["type"]))
    return "\n".join([words for _, words in sorted(named)] + ([f"and {len(rest)} more faults"] if rest else []))


def _place(fault: ErrorDetails) -> KeyPath:
    path = _path(fault["loc"])
    return (*path, "type") if fault["type"].startswith("union_tag") and path[0] == "targets" else path


def _path(loc: tuple[str | int, ...]) -> KeyPath:
    """The place of a fault, without pydantic's names for the choices of a union and for keys."""
    if (loc[:1] == ("targets",) and len(loc) > 2) or (loc[:1] == ("sensors",) and loc[2:3] in (("sees",), ("moves",))):
        loc = (*loc[:2], *loc[3:])
    elif loc[:1] == ("noise",) and len(loc) > 1:
        loc = (*loc[:1], *loc[2:])
    return loc[:-1] if loc[-1:] == ("[key]",) else loc


def _words(fault: ErrorDetails, path: KeyPath, file: YamlFile) -> str:
    kind, given = fault["type"], fault["input"]
    context: dict[str, Any] = fault.get("ctx", {})
    if kind == "missing":
        model = _section(path[:-1], file.data)
        field = keys_of(model).get(str(path[-1])) if model else None
        return f"is missing{'' if field is None else _about(str(path[-1]), field)}"
    if kind == "extra_forbidden":
        model = _section(path[:-1], file.data)
        counted = getattr(model, "counted", "")
        if counted and path[-1] in ("columns", "rows"):
            return f"not a key any more; {_counts_before(file.data['targets'][path[1]], counted)}"
        return suggestion(str(path[-1]), list(keys_of(model)) if model else [])
    if kind == "literal_error":
        section = " or a section" if path == ("noise",) else ""
        return f"{shown(given)}; give {context['expected']}{section}"
    if kind == "union_tag_invalid":
        return f"{shown(given['type'])}; give one of {', '.join(_TARGETS)}"
    if kind == "union_tag_not_found":
        return f"is missing: give one of {', '.join(_TARGETS)}"
    if kind in ("model_type", "model_attributes_type"):
        model = _section(path, file.data)
        keys = f" with {', '.join(keys_of(model))}" if model else " with type and sizes"
        return f"{shown(given)}; give a section{keys}"
    if kind in _KINDS:
        return f"{shown(given)}; {_KINDS[kind]}"
    return str(context.get("error", fault["msg"]))


def _about(key: str, field: FieldInfo) -> str:
    """What a key is, its unit, and an example."""
    unit = unit_of(key, field)
    example = f", such as {key}: {in_yaml(field.examples[0])}" if field.examples else ""
    return f": {field.description}{f', {unit}' if unit else ''}{example}" if field.description else ""


def _counts_before(target: dict[str, Any], counted: str) -> str:
    """What replaces columns and rows of rig files of before."""
    across, down = (target.get(key) for key in ("columns", "rows"))
    if isinstance(across, int) and isinstance(down, int):
        return f"columns: {across}, rows: {down} is now {counted}: [{across}, {down}]"
    return f"columns and rows are now {counted}: [across, down]"


def _section(path: KeyPath, data: Any) -> type[BaseModel] | None:
    """The section at a place."""
    if len(path) == 2 and path[0] == "targets":
        target = data["targets"][path[1]]
        kind = target.get("type") if isinstance(target, dict) else None
        return _TARGETS.get(kind) if isinstance(kind, str) else None
    if len(path) == 4 and path[0] == "targets" and path[2] == "layout":
        return target_sections.BundleTagPlace
    if len(path) == 2 and path[0] == "sensors":
        sensor = data["sensors"][path[1]]
        has_odometry = isinstance(sensor, dict) and "odometry" in sensor
        return odometry_section.OdometrySensor if has_odometry else sections.Sensor
    lists = path[:1] == ("given",)
    general = tuple(
        "*" if (i == 1 and path[0] == "sensors") or (i == 2 and lists) else key for i, key in enumerate(path)
    )
    return _SECTIONS.get(general)
