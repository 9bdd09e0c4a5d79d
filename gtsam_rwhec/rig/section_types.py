"""Types of single values of a rig file: names, lengths, positive numbers, with messages for wrong values."""

from __future__ import annotations

import json
import re
from typing import Annotated, Any, Literal, TypeAlias, get_args

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, GetJsonSchemaHandler
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema

from gtsam_rwhec.cameras.targets import LARGEST_M
from gtsam_rwhec.files.yaml_lines import shown

#: A frame's name must match this pattern.
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z0-9_]+)*")
#: A name has at most this many characters.
LONGEST_NAME = 100
#: A topic or a path has at most this many characters.
LONGEST_TEXT = 1000
#: Seconds. Offsets are at most this, because larger offsets in nanoseconds do not fit into 64 bits.
LARGEST_OFFSET_S = 4e9

#: Units that keys end with, longest first.
UNITS = {
    "_deg_s": "degrees/s", "_m_s": "m/s", "_deg": "degrees", "_mm": "mm", "_px": "pixels", "_m": "m", "_s": "s",
}  # fmt: skip


class InSchema:
    """Keywords for the JSON Schema of a value, in addition to its type, for values that a function checks."""

    def __init__(self, **keywords: Any) -> None:
        self.keywords = keywords

    def __get_pydantic_json_schema__(self, core: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return handler(core) | self.keywords


class Or:
    """In the JSON Schema: a value of this schema may stand in place of a section."""

    def __init__(self, **schema: Any) -> None:
        self.schema = schema

    def __get_pydantic_json_schema__(self, core: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"anyOf": [self.schema, handler(core)]}


def or_text(words: str) -> Or:
    """Text may stand in place of a section, and is described by these words."""
    return Or(type="string", minLength=1, description=words)


def unit_of(key: str, field: FieldInfo | None = None) -> str:
    """The unit of a key: the end of its name, or what its field states; empty if it has none."""
    extra = field.json_schema_extra if field is not None else None
    if isinstance(extra, dict) and "unit" in extra:
        return str(extra["unit"])
    return next((unit for end, unit in UNITS.items() if key.endswith(end)), "")


#: Every YAML reader reads these strings as strings without quotes.
_PLAIN = re.compile(r"(?!(?:true|false|null|yes|no|on|off|y|n)$)[/]?[A-Za-z][A-Za-z0-9_/.]*", re.IGNORECASE)


def in_yaml(value: Any) -> str:
    """A value as YAML in one line; what a section does not have is left out."""
    if isinstance(value, BaseModel):
        value = {key: item for key, item in value if item is not None}
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {in_yaml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(in_yaml, value)) + "]"
    if isinstance(value, float):
        return number(value)
    return value if isinstance(value, str) and _PLAIN.fullmatch(value) else json.dumps(value, ensure_ascii=False)


def number(value: float) -> str:
    """The fewest digits (at most 17) that are read as the same double, always with a decimal point.

    Without the point, YAML 1.1 takes 1e-05 for text and 1 for an integer.
    """
    text = repr(float(value) + 0.0)  # + 0.0: no -0.0
    mantissa, e, exponent = text.partition("e")
    return f"{mantissa}.0e{exponent}" if e and "." not in mantissa else text


def models_in(annotation: Any) -> list[type[BaseModel]]:
    """The section classes inside a field's annotation."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in models_in(part)]


def is_name(text: str) -> bool:
    """Whether this can be the name of a frame."""
    return len(text) <= LONGEST_NAME and NAME.fullmatch(text) is not None


def is_text(text: str) -> bool:
    """Whether this can be a topic or a path."""
    return 0 < len(text) <= LONGEST_TEXT and text.isprintable()


def _name(text: str) -> str:
    if not is_name(text):
        raise ValueError(
            f"{shown(text)} cannot be a frame's name: a name has first a letter, then letters, digits and _, in parts "
            f"joined by /, and at most {LONGEST_NAME} characters"
        )
    return text


def _text(text: str) -> str:
    if not text:
        raise ValueError("'' is empty")
    if not is_text(text):
        raise ValueError(f"{shown(text)} has unprintable characters, or more than {LONGEST_TEXT} characters")
    return text


def _length(number: float) -> float:
    if not number > 0.0:
        raise ValueError(f"{number:g} is not a length; give metres, above 0")
    if number >= LARGEST_M:
        raise ValueError(f"{number:g} m is {LARGEST_M:g} m or more; if it is in millimetres, write {number / 1000.0:g}")
    return number


def list_of(count: int, words: str) -> BeforeValidator:
    """A list of `count` values, which `words` describe."""

    def check(given: Any) -> Any:
        if not isinstance(given, (tuple, list)) or len(given) != count:
            raise ValueError(f"{shown(given)}; give {words}")
        return tuple(given)

    return BeforeValidator(check)


def _axes(text: str) -> str:
    if not re.fullmatch(r"rotation_vector|[xyz]{3}|[XYZ]{3}", text) or text[0] == text[1] or text[1] == text[2:3]:
        raise ValueError(
            f"{shown(text)}; give three axes in the order of the turns, capitals for turning axes and small letters "
            "for fixed ones (ZYX: yaw, pitch, roll; xyz: roll, pitch, yaw about fixed axes), or rotation_vector"
        )
    return text


def _offset(given: Any) -> Any:
    number = isinstance(given, (int, float)) and not isinstance(given, bool) and abs(given) <= LARGEST_OFFSET_S
    if given != "estimate" and not number:
        raise ValueError(f"{shown(given)}; give seconds, or the word estimate")
    return given


Name: TypeAlias = Annotated[str, AfterValidator(_name), InSchema(pattern=f"^{NAME.pattern}$", maxLength=LONGEST_NAME)]
Text: TypeAlias = Annotated[str, AfterValidator(_text), InSchema(minLength=1, maxLength=LONGEST_TEXT)]
FramePair: TypeAlias = Annotated[tuple[Name, Name], list_of(2, "two frames, [parent, child]")]
EulerAxes: TypeAlias = Annotated[str, AfterValidator(_axes), InSchema(pattern="^(rotation_vector|[xyz]{3}|[XYZ]{3})$")]
Positive: TypeAlias = Annotated[float, Field(gt=0)]
Length: TypeAlias = Annotated[float, AfterValidator(_length), InSchema(exclusiveMinimum=0, exclusiveMaximum=LARGEST_M)]
TimeOffset: TypeAlias = Annotated[float | Literal["estimate"], BeforeValidator(_offset)]


class Section(BaseModel):
    """Rules for all sections: no unknown keys, no conversion, only finite numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    def _given(self, *names: str) -> list[str]:
        """The keys among `names` that the section has."""
        return [name for name in names if getattr(self, name) is not None]

    def _need_one(self, given: list[str], words: str) -> None:
        """Raise unless one key is given; `words` say of which."""
        if len(given) != 1:
            raise ValueError(f"{' and '.join(given) or 'nothing'} given; give one of {words}")


def one_of(*choices: str | tuple[str, ...], together: tuple[tuple[str, ...], ...] = ()) -> ConfigDict:
    """For the JSON Schema of a section: exactly one of these keys, or sets of keys, must be there.

    In each tuple of `together`, the first key needs the others.
    """
    said: dict[str, Any] = {"oneOf": [{"required": [keys] if isinstance(keys, str) else [*keys]} for keys in choices]}
    if together:
        said["dependencies"] = {first: others for first, *others in together}
    return ConfigDict(json_schema_extra=said)


def keys_of(section: type[BaseModel]) -> dict[str, FieldInfo]:
    """The fields of a section by the keys that rig files have for them."""
    return {field.alias or name: field for name, field in section.model_fields.items()}


def needed(words: str, *examples: Any, unit: str = "", **limits: Any) -> Any:
    """A key that must be given: what it is, examples, and its unit where the end of its name does not say it."""
    return optional(words, *examples, default=..., unit=unit, **limits)


def optional(words: str, *examples: Any, default: Any = None, unit: str = "", **limits: Any) -> Any:
    """A key that may be left out: as `needed`, with its default."""
    said: Any = {"unit": unit} if unit else None
    return Field(default, description=words, examples=[*examples] or None, json_schema_extra=said, **limits)
