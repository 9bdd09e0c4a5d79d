"""Numbers of a page against the JSON that they name: each is read from both, and compared."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from html.parser import HTMLParser
from typing import Any, NamedTuple


class ShownNumber(NamedTuple):
    """A ``data`` element of a page."""

    of: str
    value: str
    times: float
    spec: str
    text: str


class _Numbers(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[ShownNumber] = []
        self._open: dict[str, str | None] | None = None

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "data":
            self._open = dict(attrs)

    def handle_data(self, data: str) -> None:
        if self._open is not None:
            of, value, times, spec = (str(self._open[name]) for name in ("data-of", "value", "data-times", "data-spec"))
            self.found.append(ShownNumber(of, value, float(times), spec, data))
            self._open = None


def numbers_of(page: str) -> list[ShownNumber]:
    """All numbers of a page that name their place."""
    parser = _Numbers()
    parser.feed(page)
    return parser.found


def wrong_numbers(page: str, files: Mapping[str, Any]) -> Iterator[str]:
    """Numbers that are not those of the JSON; `files` has the parsed content by the name that numbers give."""
    for shown in numbers_of(page):
        name, _, pointer = shown.of.partition("#")
        value: Any = files[name]
        for step in pointer.removeprefix("/").split("/"):
            step = step.replace("~1", "/").replace("~0", "~")
            value = value[int(step)] if isinstance(value, list) else value[step]
        if json.loads(shown.value) != value:
            yield f"{shown}: the file has {value}"
            continue
        text = "free" if value is None or not math.isfinite(value) else f"{shown.times * value:{shown.spec}}"
        if shown.text != text:
            yield f"{shown}: it should read {text}"
