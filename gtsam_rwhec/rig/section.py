"""The rules that all sections of a rig file share."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict
from pydantic.fields import FieldInfo


class Section(BaseModel):
    """Rules for all sections: no unknown keys, no conversion, only finite numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    def _given(self, *names: str) -> list[str]:
        """Those of these keys that the section has."""
        return [name for name in names if getattr(self, name) is not None]


def one_of(*choices: str | tuple[str, ...], together: tuple[tuple[str, ...], ...] = ()) -> ConfigDict:
    """For the JSON Schema of a section: exactly one of these keys, or sets of keys, must be there.

    Of each tuple in `together`, the first key needs the others.
    """
    said: dict[str, Any] = {"oneOf": [{"required": [keys] if isinstance(keys, str) else [*keys]} for keys in choices]}
    if together:
        said["dependencies"] = {first: others for first, *others in together}
    return ConfigDict(json_schema_extra=said)


def keys_of(section: type[BaseModel]) -> dict[str, FieldInfo]:
    """The fields of a section by the keys that rig files have for them."""
    return {field.alias or name: field for name, field in section.model_fields.items()}
