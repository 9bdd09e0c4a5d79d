"""The JSON Schema of rig files, made of their sections: editors complete and check with it."""

from __future__ import annotations

import inspect
import json
import re
from dataclasses import fields
from pathlib import Path
from typing import Any

from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

from gtsam_rwhec.detect.detections import DetectionOptions
from gtsam_rwhec.rig.rig import RigFile

#: Editors know this version of JSON Schema, all of them.
DIALECT = "http://json-schema.org/draft-07/schema#"
#: The schema as the package ships it; `schema_text` makes its content.
SCHEMA_FILE = Path(__file__).with_name("rig_file.schema.json")


class _Draft07(GenerateJsonSchema):
    """Lists of a fixed length as draft 07 has them, and no titles: the keys say as much."""

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
    """Take a schema's own words with this key away; keys of rig files stand under ``properties``."""
    if isinstance(node, dict):
        node.pop(key, None)
        for name, value in node.items():
            for part in value.values() if name in ("properties", "$defs") else [value]:
                _without(part, key)
    elif isinstance(node, list):
        for part in node:
            _without(part, key)
