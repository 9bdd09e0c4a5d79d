"""Reading rig files; an error names every fault with its line."""

from __future__ import annotations

import re
import textwrap
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from gtsam_rwhec.errors import FileFormatError, RigError, UnfinishedRigWarning
from gtsam_rwhec.files.yaml_lines import KeyPath, YamlFile, parse_yaml, read_text, shown, suggestion
from gtsam_rwhec.rig.odometry_sections import GivenSection
from gtsam_rwhec.rig.rig import Lines, Rig, RigFile
from gtsam_rwhec.rig.section_types import in_yaml, is_text, keys_of, models_in, unit_of
from gtsam_rwhec.rig.sections import ESTIMATE, Intrinsics
from gtsam_rwhec.rig.target_sections import KINDS, with_kalibr_targets

#: A message names at most this many faults.
MOST_FAULTS = 20

#: What to do about a fault, by pydantic's name for its kind.
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
    around = _section(path[:-1], file.data)
    field = keys_of(around).get(str(path[-1])) if around else None
    if kind == "missing":
        return f"is missing{'' if field is None else _about(str(path[-1]), field)}"
    if kind == "extra_forbidden":
        return suggestion(str(path[-1]), list(keys_of(around)) if around else [])
    if kind == "literal_error":
        section = " or a section" if path == ("noise",) else ""
        return f"{shown(given)}; give {context['expected']}{section}"
    if kind == "union_tag_invalid":
        return f"{shown(given['type'])}; give one of {', '.join(KINDS)}"
    if kind == "union_tag_not_found":
        return f"is missing: give one of {', '.join(KINDS)}"
    if kind in ("model_type", "model_attributes_type"):
        model = _section(path, file.data)
        keys = f" with {', '.join(keys_of(model))}" if model else " with type and sizes"
        return f"{shown(given)}; give a section{keys}{_such_as(str(path[-1]), field)}"
    if kind == "greater_than":
        return f"{given:g} must be above {context['gt']:g}"
    if kind in _KINDS:
        return f"{shown(given)}; {_KINDS[kind]}"
    return str(context.get("error", fault["msg"]))


def _about(key: str, field: FieldInfo) -> str:
    """What a key is, its unit, and an example."""
    unit = unit_of(key, field)
    return f": {field.description}{f', {unit}' if unit else ''}{_such_as(key, field)}" if field.description else ""


def _such_as(key: str, field: FieldInfo | None) -> str:
    return f", such as {key}: {in_yaml(field.examples[0])}" if field and field.examples else ""


def _section(path: KeyPath, data: Any) -> type[BaseModel] | None:
    """The section at a place; None where there is none."""
    model: type[BaseModel] | None = RigFile
    models: list[type[BaseModel]] = []
    for key in path:
        try:
            data = data[key]
        except (TypeError, LookupError):
            data = None
        field = keys_of(model).get(str(key)) if model else None
        if field is not None:  # else the key is the name or the number of an item
            models = models_in(field.annotation)
        holds_items = field is not None and get_origin(field.annotation) in (dict, tuple)
        model = None if holds_items else _meant(models, data if isinstance(data, dict) else {})
    return model


def _meant(models: list[type[BaseModel]], given: dict[str, Any]) -> type[BaseModel] | None:
    """The section that these keys mean, among those that may stand at a place."""
    if models == [*KINDS.values()]:
        return KINDS.get(str(given.get("type")))
    fitting = [each for each in models if ("odometry" in given) == ("odometry" in keys_of(each))]
    return next(iter(fitting or models), None)


#: The mark in a comment.
TODO = "TODO"
#: A comment with the mark: # begins a comment at the start of a line or after a blank.
_COMMENT = re.compile(rf"(?:^|\s)#(?P<comment>.*\b{TODO}\b.*)$")
#: The key of a line.
_KEY = re.compile(r"\s*(?P<key>[^\s#:][^:]*):(?:\s|$)")


@dataclass(frozen=True)
class TodoLine:
    """A line that a person must complete; ``str()`` says which, and what is to be done."""

    number: int  #: From 1 on. A comment on lines of its own belongs to the line after it.
    key: str  #: The line's key; empty where it has none
    words: str  #: The comment from the mark on

    def __str__(self) -> str:
        return f"line {self.number}{f', {self.key}' if self.key else ''}: {self.words}"


def todo_lines(text: str) -> tuple[TodoLine, ...]:
    """The lines of a rig file's text that are marked TODO. Comments at its head are about the whole file."""
    found = []
    waiting: list[str] = []
    is_head = True
    for number, line in enumerate(text.splitlines(), 1):
        bare = line.strip()
        if bare.startswith("#"):
            words = bare.lstrip("# ")
            if not is_head and (waiting or TODO in words.split()):
                waiting.append(words)
            continue
        if not bare:
            continue
        is_head = False
        match = _COMMENT.search(line)
        said = [*waiting, match["comment"]] if match else waiting
        waiting = []
        if said:
            key = _KEY.match(line)
            words = " ".join(" ".join(said).split())
            found.append(TodoLine(number, key["key"] if key else "", words[words.index(TODO) :]))
    return tuple(found)


#: Comments begin in this column if the text before them is shorter.
_COLUMN = 30
#: A line has at most this many characters; longer comments stand on lines of their own.
_WIDTH = 120
#: These sections are written key by key, each on its line. All others are written in one line.
_BLOCKS = ("carriers", "sensors", "targets", "detection", "cleaning", "given")
#: This section is not written: nothing is given.
NONE = GivenSection()
#: Each line gets this comment.
_REMARKS: dict[KeyPath, str] = {
    ("carriers",): "the frames that carry the sensors and the targets",
    ("carriers", "max_gap_s"): "s; between poses further apart in time nothing is interpolated",
    ("carriers", "noise"): "standard deviations of the carriers' poses",
    ("carriers", "accuracy"): "how far off poses near each other are alike",
    ("targets",): "lengths in metres, as measured on the print",
    ("sizes",): "of the targets: known, check or estimate",
    ("noise",): "of the detections: estimate, {rotation_deg, translation_mm} or {corner_px}",
    ("reference",): "the sensor that carries the others: poses are in its frame",
    ("given",): "what a person measured",
    ("cleaning", "max_rotation_deg_s"): "measurements in faster motion are removed; null: none is",
}


def rig_text(rig: RigFile, remarks: Mapping[KeyPath, str] | None = None) -> str:
    """The YAML text of a rig file, with comments. `parse_rig` reads it back equal.

    Parameters
    ----------
    rig : Rig
        Its folder is not written: relative paths start from the folder of the new file.
    remarks : mapping of key path to str, optional
        Comments that replace the usual ones, by the path of the line: ``("targets", "tag_0")``.
    """
    said = {**_REMARKS, **(remarks or {})}
    lines = []
    for path, text in _lines(_sections(rig)):
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


def first_rig_text(kind: str, source: str, rig: RigFile, remarks: Mapping[KeyPath, str], more: str = "") -> str:
    """The text of a rig file that was made from a log or a folder (`kind`) of this name; `more` ends its head."""
    head = (
        f"# A first rig file, made from the {kind} {source if is_text(source) else repr(source)}.\n"
        "# TODO marks what only a person knows, above all the sizes of the targets: the sizes here are guesses.\n"
    )
    return head + more + rig_text(rig, remarks)


def _sections(rig: RigFile) -> Iterator[tuple[str, Any]]:
    """The sections by their keys, without those that follow from others."""
    for name, field in RigFile.model_fields.items():
        follows = name == "carriers" and rig.reference is not None
        if not follows and not (name == "targets" and not rig.targets) and not (name == "given" and rig.given == NONE):
            yield field.alias or name, getattr(rig, name)


def _lines(items: Iterable[tuple[str, Any]], path: KeyPath = ()) -> Iterator[tuple[KeyPath, str]]:
    """Each line with its path. Values that are not given are left out, except in ``cleaning``."""
    indent = "  " * len(path)
    for key, value in items:
        here = (*path, key)
        if (value is None and path != ("cleaning",)) or (here == ("detection",) and not value):
            continue
        if (not path and key in _BLOCKS) or path == ("sensors",):
            yield here, f"{indent}{key}:"
            yield from _lines(value.items() if isinstance(value, dict) else value, here)
        else:
            in_short = isinstance(value, Intrinsics) and value.estimate == "any"
            yield here, f"{indent}{key}: {ESTIMATE if in_short else in_yaml(value)}"


TemplateName = Literal["eye-in-hand", "eye-to-hand", "rig", "several-cameras", "clouds", "odometry"]
#: Names of the templates.
TEMPLATES: tuple[TemplateName, ...] = get_args(TemplateName)
_FOLDER = Path(__file__).with_name("template_files")


def template_text(name: TemplateName) -> str:
    """The text of a template; TODO marks values that differ for every robot cell."""
    return (_FOLDER / f"{name}.yaml").read_text(encoding="utf-8")
