"""The blocks of a report: what a section may hold. They say what is shown; a page and a terminal say how.

Every text is shown as text: a name that is HTML comes out as it is written. A ``Number`` knows its place in the result
file or in the evidence, so that a test can read both and compare them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from string import Formatter
from typing import TYPE_CHECKING, Any, Literal
from urllib.parse import quote

from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.files.terminal_text import shown

if TYPE_CHECKING:
    from gtsam_rwhec.report.figures import SvgFigure

#: How a paragraph is meant; ``absent`` says what is not there, and why.
Tone = Literal["plain", "lead", "note", "absent", "good", "care", "bad"]
TONES: Mapping[Verdict, Literal["good", "care", "bad"]] = {
    Verdict.USE: "good",
    Verdict.CARE: "care",
    Verdict.DO_NOT_USE: "bad",
}


@dataclass(frozen=True)
class Number:
    """A number of the result's JSON as it is shown.

    ``of`` is its place, "result.json#/refined/cost": a JSON pointer in the named file. It is shown multiplied by
    ``times`` (1e3 shows metres as millimetres), formatted by ``spec``; None is an infinite number.
    """

    of: str
    value: float | None
    times: float = 1.0
    spec: str = ".4g"
    unit: str = ""

    @property
    def text(self) -> str:
        """As people read it."""
        if self.value is None or not math.isfinite(self.value):
            return "free"
        return f"{self.times * self.value:{self.spec}}"


def significant(number: Number, figures: int) -> Number:
    """The number with so many figures that count, without an exponent; a large one has no decimals."""
    value = abs(number.times * (number.value or 0.0))
    size = math.floor(math.log10(value)) if 0.0 < value < math.inf else 0
    return replace(number, spec=f".{max(figures - 1 - size, 0)}f")


@dataclass(frozen=True)
class Link:
    """A link to another file, by its place beside the page, with slashes; never to the network."""

    text: str
    place: str

    @property
    def href(self) -> str:
        """As a page has it."""
        return "./" + quote(self.place)


#: A piece of a sentence, or a cell.
Piece = str | Number | Link
#: A sentence: pieces one after the other.
Words = Piece | tuple[Piece, ...]


def pieces_of(words: Words) -> tuple[Piece, ...]:
    """The pieces of words."""
    return words if isinstance(words, tuple) else (words,)


def worded(template: str, **pieces: Piece) -> Words:
    """A sentence with pieces in the place of their names in braces."""
    said: list[Piece] = [""]
    for text, name, _, _ in Formatter().parse(template):
        for piece in (text, "" if name is None else pieces[name]):
            if isinstance(piece, str) and isinstance(said[-1], str):
                said[-1] += piece
            else:
                said.append(piece)
    return tuple(said)


def plain_text(words: Words) -> str:
    """Words as text."""
    said = (
        piece if isinstance(piece, str) else f"{piece.text} {getattr(piece, 'unit', '')}".rstrip()
        for piece in pieces_of(words)
    )
    return "".join(said).replace("\N{NO-BREAK SPACE}", " ")


@dataclass(frozen=True)
class Paragraph:
    """A paragraph."""

    words: Words
    tone: Tone = "plain"


@dataclass(frozen=True)
class Listing:
    """A list of sentences."""

    items: tuple[Words, ...]
    tone: Tone = "plain"


@dataclass(frozen=True)
class Table:
    """A table; the first cell of each row is its heading. Cells that are a ``Number`` stand to the right.

    On a page, one that ``sorts`` has a button at each heading, and moves inside itself where it is long.
    """

    caption: str
    headings: tuple[str, ...]
    rows: tuple[tuple[Words, ...], ...]
    legend: str = ""
    sorts: bool = False

    @staticmethod
    def of(
        caption: str, kind: str, headings: Iterable[str], rows: Mapping[str, tuple[Words, ...]], legend: str = ""
    ) -> Table:
        """Rows by their names, which are of a ``kind`` ("sensor")."""
        named = tuple((shown(name), *cells) for name, cells in rows.items())
        return Table(caption, (kind, *headings), named, legend)


@dataclass(frozen=True)
class Chart:
    """A figure. `says` is what it shows, for who cannot see it."""

    name: str
    title: str
    says: str
    svg: SvgFigure


@dataclass(frozen=True)
class Picture:
    """A photograph: bytes of a JPEG file."""

    name: str
    title: str
    says: str
    content: bytes
    is_wide: bool = True


@dataclass(frozen=True)
class Drawing:
    """A scene in 3D that can be turned: traces and layout of plotly, and a still picture for paper."""

    name: str
    title: str
    says: str
    traces: tuple[Mapping[str, Any], ...]
    layout: Mapping[str, Any]
    still_svg: SvgFigure


@dataclass(frozen=True)
class CopyText:
    """A text that a button copies."""

    name: str
    title: str
    text: str


@dataclass(frozen=True)
class Folded:
    """Blocks that are seen when somebody asks for them. On paper they are open."""

    title: str
    blocks: tuple[Block, ...]


Block = Paragraph | Listing | Table | Chart | Picture | Drawing | CopyText | Folded


@dataclass(frozen=True)
class Section:
    """A section. ``missing`` says why there is nothing to show, where there is not."""

    name: str
    title: str
    blocks: tuple[Block, ...] = ()
    missing: str = ""


@dataclass(frozen=True)
class Page:
    """A page: its title, the verdict's tone, its sections in order, and what is wrong with the data that it shows."""

    title: str
    tone: Literal["good", "care", "bad"]
    sections: tuple[Section, ...]
    made_by: str
    warnings: tuple[str, ...] = ()


def is_absent(block: Block) -> bool:
    """Whether a block only says what is not there."""
    return isinstance(block, Paragraph) and block.tone == "absent"


def every(blocks: Iterable[Block]) -> Iterator[Block]:
    """The blocks, and those that are folded in them."""
    for block in blocks:
        yield block
        if isinstance(block, Folded):
            yield from every(block.blocks)
