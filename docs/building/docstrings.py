"""Docstrings and signatures as this library writes them, for autodoc and napoleon.

- A signature is shown as the source has it: autodoc would show what ``NDArray[np.floating]`` stands for.
- Attributes that share a description (``A, B : (N, 4, 4) array``) get it each.
- |x| is a norm, and no name of a text that is defined elsewhere.
"""

from __future__ import annotations

import inspect
import re
from typing import Any

from sphinx.application import Sphinx
from sphinx.util.inspect import stringify_signature

_HEADER = re.compile(r"(\w+(?:, \w+)+) : (.*)")
#: Stands for a colon that napoleon shall not read.
_COLON = "\ue000"


def _each_attribute(lines: list[str]) -> list[str]:
    """The lines with an entry for each of the names that share one."""
    found, place, inside = [], 0, False
    while place < len(lines):
        line = lines[place]
        if place + 1 < len(lines) and re.fullmatch(r"-+", lines[place + 1]):
            inside = line == "Attributes"
        header = _HEADER.fullmatch(line) if inside else None
        if header is None:
            found.append(line)
            place += 1
            continue
        end = place + 1
        while end < len(lines) and (not lines[end] or lines[end].startswith(" ")):
            end += 1
        for name in header[1].split(", "):
            found += [f"{name} : {header[2]}", *lines[place + 1 : end]]
        place = end
    return found


def _before_napoleon(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    if lines and lines[0].startswith("Alias for field number"):  # what Python says of a named tuple's field
        lines.clear()
    lines[:] = [re.sub(r"(``.*?``)|\|", lambda found: found[1] or r"\|", line) for line in _each_attribute(lines)]
    if what in ("property", "attribute", "data") and lines:
        lines[0] = lines[0].replace(":", _COLON)  # else what is before it would be the type


def _after_napoleon(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    lines[:] = [line.replace(_COLON, ":") for line in lines]


def _as_written(
    app: Sphinx, what: str, name: str, obj: Any, options: object, signature: str | None, returned: str | None
) -> tuple[str, str] | None:
    """The signature with annotations as the source has them; None leaves it to autodoc."""
    if signature is None or what not in ("class", "function", "method"):
        return None
    try:
        found = inspect.signature(obj)
    except (TypeError, ValueError):
        return None
    parameters = [each for each in found.parameters.values() if each.name != "self"]
    if all(isinstance(each.annotation, str) or each.annotation is each.empty for each in parameters):
        found = found.replace(parameters=parameters)
        arguments = stringify_signature(found, show_return_annotation=False)
        with_result = isinstance(found.return_annotation, str) and what != "class"
        return arguments, str(found.return_annotation) if with_result else ""
    return None


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect to Sphinx; napoleon's own priority is 500."""
    app.connect("autodoc-process-docstring", _before_napoleon, priority=400)
    app.connect("autodoc-process-docstring", _after_napoleon, priority=600)
    app.connect("autodoc-process-signature", _as_written)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
