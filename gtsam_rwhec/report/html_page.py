"""A page as HTML: one file that needs nothing else, from disk and without network."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import re
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from gtsam_rwhec.files.whole_files import write_atomically
from gtsam_rwhec.report.figures import SvgFigure
from gtsam_rwhec.report.report_blocks import Drawing, Link, Number, Page, Words, every, pieces_of


def write_page(page: Page, path: str | Path) -> None:
    """Write a page; a `FileFormatError` says that the file cannot be written."""
    write_atomically(path, f"{page_html(page)}\n".encode("utf-8", "replace"))


def page_html(page: Page) -> str:
    """The page's text."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("gtsam_rwhec.report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters.update(
        base64=_base64, script_json=_script_json, pieces=pieces_of, signs=_signs, own_ids=_own_ids,
        kind=lambda block: type(block).__name__,
    )  # fmt: skip
    environment.tests.update(number=lambda piece: isinstance(piece, Number), link=lambda piece: isinstance(piece, Link))
    has_drawing = any(isinstance(block, Drawing) for section in page.sections for block in every(section.blocks))
    script = _own_file("page.js")
    return environment.get_template("page.html.j2").render(
        page=page,
        style=_own_file("page.css"),
        script=script,
        plotly=_packed_plotly() if has_drawing else "",
        policy=_policy([script, *([_plotly()] if has_drawing else [])]),
    )


def _policy(scripts: Sequence[str]) -> str:
    """What the browser may do with the page: run these scripts, and no other; and fetch nothing from anywhere."""
    sums = " ".join(f"'sha256-{_base64(hashlib.sha256(script.encode()).digest())}'" for script in scripts)
    return (
        f"default-src 'none'; script-src {sums}; style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'; "
        "form-action 'none'"
    )


def _own_file(name: str) -> str:
    return files("gtsam_rwhec.report").joinpath("templates", name).read_text("utf-8")


@cache
def _plotly() -> str:
    """plotly's script."""
    from plotly.offline import get_plotlyjs

    return str(get_plotlyjs())


@cache
def _packed_plotly() -> str:
    """The same, compressed, as base64: browsers unpack it; as it is it would be most of the page.

    By level 4: level 6 takes twice as long for 4 % less.
    """
    return _base64(gzip.compress(_plotly().encode("utf-8"), 4, mtime=0))


def _own_ids(figure: SvgFigure, name: str) -> str:
    """A figure whose ids are its own: several on one page have parts of the same name. Ids without use are left out."""
    svg = figure.in_page
    used = set(re.findall(r'(?:href="#|url\(#)([^")]+)', svg))
    svg = re.sub(r' id="([^"]*)"', lambda m: f' id="{name}-{m[1]}"' if m[1] in used else "", svg)
    return re.sub(r'(href="#|url\(#)', rf"\g<1>{name}-", svg)


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _script_json(value: Any) -> str:
    """JSON for a script element: `<`, `>` and `&` are escaped."""
    text = json.dumps(value, allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _signs(words: Words) -> int:
    """The number of characters that a reader sees."""
    return sum(len(piece if isinstance(piece, str) else piece.text) for piece in pieces_of(words))
