"""Makes the reference of rig files in Markdown from the sections: every key, its unit, default and an example."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

from gtsam_rwhec.cameras.targets import FAMILIES
from gtsam_rwhec.detect.detections import DetectionOptions
from gtsam_rwhec.rig.odometry_sections import OdometrySensor
from gtsam_rwhec.rig.rig import RigFile
from gtsam_rwhec.rig.section_types import in_yaml, keys_of, models_in, unit_of
from gtsam_rwhec.rig.target_sections import KINDS

#: Before the tables.
HEAD = """\
# The rig file: every key

<!-- Written by `gtsam-rwhec init --reference > docs/rig_file.md`: change the fields in gtsam_rwhec/rig. -->

A rig file names the sensors and the targets, what carries them, and where the log or the folder has the data of each.
[from_a_log.md](from_a_log.md) says how it is used; `gtsam-rwhec init LOG -o rig.yaml` writes a first one,
`gtsam-rwhec init --template NAME -o rig.yaml` one of the usual cells.

- It is YAML. A key that is not in the tables is an error that names the line and the nearest key.
- No value is converted: `"0.1"` in quotes is text, and not a number.
- A unit is the end of the key's name, as in `size_m`; else the table has it. Lengths of targets are in metres.
- Frames are right-handed, and T_a_b maps coordinates in b to a. `[parent, child]` means poses T_parent_child.
- **Every board is counted [across, down]**, as it is printed upright, and the key says what is counted: whole `squares`
  of a ChArUco board, `inner_corners` of a checkerboard (one less than its squares each way), `tags`, `circles`.
- Paths start from the rig file's folder; with images in a folder (`carriers.poses: {frames: ...}`), from that folder.
- Editors complete and check with the JSON Schema, [rig_file.schema.json](../gtsam_rwhec/rig/rig_file.schema.json)
  (`gtsam-rwhec init --schema` prints it). Rig files that `init` writes name it in their first line; in one of your own,
  write `# yaml-language-server: $schema=PATH`.
"""
#: Before the sections of targets.
OF_TARGETS = (
    "## `targets: NAME`\n\nA target's frame has its origin in the middle of what is printed, x to the right, y up, z "
    "towards who looks\nat it. `type` says which keys there are. Families of tags: "
    + ", ".join(f"`{family}`" for family in FAMILIES)
    + "."
)


def reference_text() -> str:
    """The text of ``docs/rig_file.md``."""
    schema = rig_file_schema()
    parts = [HEAD, "## The file\n\n" + _table(RigFile, schema)]
    for heading, section in _sections(RigFile):
        if section is next(iter(KINDS.values())):
            parts.append(OF_TARGETS)
        parts.append(f"{heading}\n\n{_about(section)}\n\n{_table(section, schema['$defs'][section.__name__])}")
    rows = [
        (f"`{key}`", words, "number above 0", unit_of(key), f"`{default:g}`", f"`{key}: {default:g}`")
        for key, default, words in detection_keys()
    ]
    parts.append("## `detection`\n\nLimits beyond which a detection is not used.\n\n" + _markdown(rows))
    return "\n".join(part.rstrip("\n") + "\n" for part in parts)


def _sections(model: type[BaseModel], where: str = "") -> Iterator[tuple[str, type[BaseModel]]]:
    """All sections below one, with their headings."""
    for key, field in keys_of(model).items():
        place = f"{where}{key}" + (": NAME" if get_origin(field.annotation) is dict else "")
        for section in models_in(field.annotation):
            kind = next((kind for kind, of in KINDS.items() if of is section), None)
            odometry = " (with odometry)" if section is OdometrySensor else ""
            level = "###" if place.startswith("targets: ") else "##"
            yield f"{level} `{f'type: {kind}' if kind else place + odometry}`", section
            yield from _sections(section, f"{place}: ")


def _about(section: type[BaseModel]) -> str:
    return " ".join((section.__doc__ or "").split())


def _table(section: type[BaseModel], schema: dict[str, Any]) -> str:
    rows = []
    for key, field in keys_of(section).items():
        said = schema["properties"][key]
        rows.append((
            f"`{key}`", field.description or _kind(said), _kind(said), unit_of(key, field), _default(field),
            f"`{key}: {_example(said, field)}`",
        ))  # fmt: skip
    return _markdown(rows)


def _markdown(rows: Sequence[tuple[str, ...]]) -> str:
    head = ("key", "is", "value", "unit", "default", "example")
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |"
        for row in (head, ("---",) * len(head), *rows)
    )


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "must be given"
    given = field.default
    if isinstance(given, BaseModel):
        given = {}
    return "" if given is None or given == {} else f"`{in_yaml(given)}`"


def _example(said: dict[str, Any], field: FieldInfo) -> str:
    if field.examples:
        return in_yaml(field.examples[0])
    return in_yaml(said["const"]) if "const" in said else "..."


def _kind(said: dict[str, Any]) -> str:
    """The kind of a value in words, from its schema."""
    return " or ".join(dict.fromkeys(_kinds(said)))


def _kinds(said: dict[str, Any]) -> Iterator[str]:
    for choice in said.get("anyOf", said.get("oneOf", ())):
        yield from _kinds(choice)
    if "anyOf" in said or "oneOf" in said or said.get("type") == "null":
        return
    if "const" in said:
        yield f"`{said['const']}`"
    elif "enum" in said:
        is_family = said["enum"] == list(FAMILIES)
        yield "a family, see above" if is_family else ", ".join(f"`{name}`" for name in said["enum"])
    elif said.get("type") == "array":
        item = _kind(said["items"])
        many = said.get("minItems")
        yield f"[{', '.join([item] * many)}]" if many else f"list of {item}s"
    elif "$ref" in said or said.get("type") == "object":
        yield "section"
    elif said.get("type") == "number":
        yield "number" + (" above 0" if "exclusiveMinimum" in said else "")
    else:
        yield {"string": "text", "integer": "whole number", "boolean": "true or false"}[said["type"]]


#: All editors know this version of JSON Schema.
DIALECT = "http://json-schema.org/draft-07/schema#"
#: The schema as the package ships it; `schema_text` makes its content.
SCHEMA_FILE = Path(__file__).with_name("rig_file.schema.json")


class _Draft07(GenerateJsonSchema):
    """Writes lists of fixed length as in draft 07, and no titles, because the keys say the same."""

    def tuple_schema(self, schema: core_schema.TupleSchema) -> JsonSchemaValue:
        made = super().tuple_schema(schema)
        items = made.pop("prefixItems", None)
        if items:  # lists of rig files have items of one kind
            made["items"] = items[0]
        return made

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


def rig_file_schema() -> dict[str, Any]:
    """The JSON Schema of rig files, of draft 07.

    It knows every key, its type, its limits, and which keys exclude or need each other within a section. Faults between
    sections, as one name for two frames, are found when the file is read.
    """
    schema = RigFile.model_json_schema(schema_generator=_Draft07)
    schema["properties"]["detection"] |= {
        "additionalProperties": False,
        "properties": {
            key: {"type": "number", "exclusiveMinimum": 0, "default": default, "description": words}
            for key, default, words in detection_keys()
        },
    }
    _without(schema, "title")
    return {"$schema": DIALECT, "title": "Rig file of gtsam-rwhec", **schema}


def schema_text() -> str:
    """The content of `SCHEMA_FILE`."""
    return json.dumps(rig_file_schema(), indent=2, ensure_ascii=False) + "\n"


def editor_line() -> str:
    """The first line of a rig file that names the schema for editors, with the line's end."""
    return f"# yaml-language-server: $schema={SCHEMA_FILE.as_uri()}\n"


def detection_keys() -> list[tuple[str, float, str]]:
    """Key, default and description of each key of the section ``detection``, from `DetectionOptions`' own words."""
    said = inspect.cleandoc(DetectionOptions.__doc__ or "").partition("Attributes\n----------\n")[2]
    words = {
        name: " ".join(text.split()) for name, text in re.findall(r"^(\w+) : \w+\n((?:    .*\n?)+)", said, re.MULTILINE)
    }
    return [(field.name, float(str(field.default)), words[field.name]) for field in fields(DetectionOptions)]


def _without(node: Any, key: str) -> None:
    """Remove this keyword from a schema; keys of rig files, which stand under ``properties``, stay."""
    if isinstance(node, dict):
        node.pop(key, None)
        for name, value in node.items():
            for part in value.values() if name in ("properties", "$defs") else [value]:
                _without(part, key)
    elif isinstance(node, list):
        for part in node:
            _without(part, key)
