"""The text of a rig file, with comments."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from pydantic import BaseModel

from gtsam_rwhec.files.yaml_lines import KeyPath
from gtsam_rwhec.rig.given_section import GivenSection
from gtsam_rwhec.rig.intrinsics_section import ESTIMATE, Intrinsics
from gtsam_rwhec.rig.rig import RigFile

#: Every YAML reader reads these strings as strings without quotes.
_PLAIN = re.compile(r"(?!(?:true|false|null|yes|no|on|off|y|n)$)[/]?[A-Za-z][A-Za-z0-9_/.]*", re.IGNORECASE)
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


def _sections(rig: RigFile) -> Iterator[tuple[str, Any]]:
    """The sections by their keys, without what follows from the others."""
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
            yield here, f"{indent}{key}: {_value(value)}"


def _value(value: Any) -> str:
    if isinstance(value, Intrinsics) and value.estimate == "any":
        return ESTIMATE
    if isinstance(value, BaseModel):  # in one line, without what is not given
        return "{" + ", ".join(f"{key}: {_value(item)}" for key, item in value if item is not None) + "}"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_value(item)}" for key, item in value.items()) + "}"
    if isinstance(value, tuple):
        return "[" + ", ".join(map(_value, value)) + "]"
    return _scalar(value)


def _scalar(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, float):
        mantissa, e, exponent = repr(value).partition("e")
        # With a decimal point: YAML 1.1 takes 1e-05 for text.
        return f"{mantissa}{'' if '.' in mantissa else '.0'}{e}{exponent}" if e else mantissa
    if isinstance(value, str) and not _PLAIN.fullmatch(value):
        return json.dumps(value, ensure_ascii=False)
    return str(value)
