"""A page as HTML: one file that needs nothing else, from disk and without network."""

from __future__ import annotations

import base64
import gzip
import json
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from gtsam_rwhec.files.atomic_write import write_atomically
from gtsam_rwhec.report.page.blocks import Number, Page, Words


def write_page(page: Page, path: str | Path) -> None:
    """Write a page.

    Raises
    ------
    FileFormatError
        The file cannot be written.
    """
    write_atomically(path, page_html(page).encode("utf-8", "replace"))


def page_html(page: Page) -> str:
    """The page's text."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("gtsam_rwhec.report.page"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters.update(base64=_base64, script_json=_script_json, pieces=_pieces)
    environment.tests.update(number=lambda piece: isinstance(piece, Number))
    has_drawing = any(block.kind == "drawing" for section in page.sections for block in section.blocks)
    return environment.get_template("page.html.j2").render(
        page=page,
        style=_own_file("page.css"),
        script=_own_file("page.js"),
        plotly=_plotly() if has_drawing else "",
    )


def _own_file(name: str) -> str:
    return files("gtsam_rwhec.report.page").joinpath("templates", name).read_text("utf-8")


@cache
def _plotly() -> str:
    """plotly's script, compressed, as base64: browsers unpack it; as it is it would be most of the page."""
    from plotly.offline import get_plotlyjs

    return _base64(gzip.compress(get_plotlyjs().encode("utf-8"), 6, mtime=0))


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _script_json(value: Any) -> str:
    """JSON that may stand inside a script element: no sign ends it."""
    text = json.dumps(value, allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _pieces(words: Words) -> tuple[str | Number, ...]:
    return words if isinstance(words, tuple) else (words,)
