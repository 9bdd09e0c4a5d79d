"""Whole rig files of the usual cells, with comments, for a person to complete."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, get_args

TemplateName = Literal["eye-in-hand", "eye-to-hand", "rig", "several-cameras", "odometry"]
#: Names of the templates.
TEMPLATES: tuple[TemplateName, ...] = get_args(TemplateName)
_FOLDER = Path(__file__).with_name("template_files")


def template_text(name: TemplateName) -> str:
    """The text of a template; TODO marks what is different in every cell."""
    return (_FOLDER / f"{name}.yaml").read_text(encoding="utf-8")
