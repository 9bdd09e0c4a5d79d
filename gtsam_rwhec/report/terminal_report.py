"""Blocks of a report on a terminal or in a text file: the console, headings, sentences, lists and tables."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise

from rich import box
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table as RichTable
from rich.text import Text

from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.files.terminal import SafeConsole
from gtsam_rwhec.files.terminal_text import LONGEST_LINE, printable, shown
from gtsam_rwhec.report.report_blocks import (
    Block,
    CopyText,
    Folded,
    Listing,
    Number,
    Paragraph,
    Section,
    Table,
    Tone,
    plain_text,
)

#: Tables in a file have this many columns. Sentences in a file are not wrapped.
PLAIN_WIDTH = 160
#: Each verdict, and each tone, has its colour.
STYLES = {Verdict.USE: "bold green", Verdict.CARE: "bold yellow", Verdict.DO_NOT_USE: "bold red"}
TONE_STYLES: dict[Tone, str] = {
    "plain": "",
    "lead": "bold",
    "note": "dim",
    "absent": "dim",
    "good": "bold green",
    "care": "bold yellow",
    "bad": "bold red",
}
#: Signs of tables where there is ASCII alone.
ASCII_SIGNS = str.maketrans("■□·±°", "#o.+d")
#: A narrower table has this many columns beside its first.
SPLIT = 6


def report_console() -> Console:
    """A console on standard output; in a file it is plain and as wide as the tables need."""
    console = SafeConsole()
    return console if console.is_terminal else SafeConsole(width=PLAIN_WIDTH, no_color=True)


def print_sections(console: Console, sections: Iterable[Section]) -> None:
    """Print sections; those with nothing to show say why."""
    for section in sections:
        print_heading(console, section.title)
        if section.missing:
            print_sentence(console, f"Not shown: {section.missing}", "dim")
        print_blocks(console, section.blocks)


def print_blocks(console: Console, blocks: Iterable[Block]) -> None:
    """Print blocks, those that are folded too; figures and pictures are on the page alone."""
    for block in blocks:
        if isinstance(block, Paragraph):
            print_sentence(console, plain_text(block.words), TONE_STYLES[block.tone])
        elif isinstance(block, Listing):
            print_list(console, map(plain_text, block.items), TONE_STYLES[block.tone])
        elif isinstance(block, Table):
            print_tables(console, [block])
        elif isinstance(block, Folded):
            print_sentence(console, f"{block.title}:")
            print_blocks(console, block.blocks)
        elif isinstance(block, CopyText) and "\n" not in block.text:
            print_sentence(console, f"{block.title}: {block.text}")


def print_heading(console: Console, words: str, *, tight: bool = False) -> None:
    """Print the heading of a section; a ``tight`` one has no empty line below it."""
    console.print()
    console.print(Text(printable(words), style="bold"), soft_wrap=not console.is_terminal)
    if not tight:
        console.print()


def print_tables(console: Console, tables: Iterable[Table], *, tight: bool = False) -> None:
    """Print the tables that have rows, each with the meaning of its columns."""
    for table in tables:
        if table.rows:
            console.print(TerminalTable(table, tight))
            if table.legend:
                print_sentence(console, table.legend, "dim")


def print_list(console: Console, words: Iterable[str], style: str = "") -> None:
    """Print sentences as the items of a list."""
    for sentence in words:
        print_sentence(console, f"  - {sentence}", style)


def print_sentence(console: Console, words: str, style: str = "") -> None:
    """Print a sentence: wrapped on a terminal, in one line in a file, where people search for words."""
    console.print(Text(shown(words, LONGEST_LINE), style=style), soft_wrap=not console.is_terminal)


@dataclass(frozen=True)
class TerminalTable:
    """A table that prints itself to any width and never cuts a number or a name.

    It prints one table if that fits; otherwise several tables of six columns each, or a paragraph for each row. A
    ``tight`` one has no empty lines.
    """

    table: Table
    tight: bool = False

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Print the widest layout that fits."""
        yield Text(printable(self.table.caption), style="italic")
        if options.ascii_only:
            rows = tuple(tuple(plain_text(cell).translate(ASCII_SIGNS) for cell in row) for row in self.table.rows)
            self = replace(self, table=replace(self.table, rows=rows))
        number = len(self.table.headings)
        unlimited = options.update(max_width=10_000)
        for parts in (1, 2, 3):
            ends = [1, *(1 + SPLIT * k for k in range(1, parts) if 1 + SPLIT * k < number), number]
            tables = [self._columns(slice(*cut)) for cut in pairwise(ends)]
            if all(console.measure(table, options=unlimited).maximum <= options.max_width for table in tables):
                yield from tables
                return
        for name, *cells in self.table.rows:
            numbers = [f"{h} {plain_text(c)}" for h, c in zip(self.table.headings[1:], cells, strict=False)]
            yield Text("\n".join(_filled(f"{shown(plain_text(name))}:", numbers, options.max_width)))
        if not self.tight:
            yield Text()

    def _columns(self, columns: slice) -> RichTable:
        # One space between columns: with short names the table fits 80 columns.
        table = RichTable(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, show_edge=not self.tight)
        table.add_column(self.table.headings[0], no_wrap=True)
        for place, heading in enumerate(self.table.headings[columns], start=columns.start):
            has_words = any(_is_words(row[place]) for row in self.table.rows if place < len(row))
            table.add_column(heading, justify="left" if has_words else "right", no_wrap=True)
        for name, *cells in self.table.rows:
            said = (Text(shown(plain_text(cell))) for cell in cells[columns.start - 1 : columns.stop - 1])
            table.add_row(Text(shown(plain_text(name))), *said)
        return table


def _is_words(cell: object) -> bool:
    """Whether a cell is a text that is no number, of more than a word."""
    return not isinstance(cell, Number) and isinstance(cell, str) and " " in cell and not cell[:1].isdigit()


def _filled(start: str, numbers: Iterable[str], width: int) -> list[str]:
    """Fill lines up to a width; a number stays with its heading."""
    lines = [start]
    for piece in numbers:
        if len(lines[-1]) + 1 + len(piece) + 1 <= width:
            lines[-1] += f" {piece},"
        else:
            lines.append(f"  {piece},")
    lines[-1] = lines[-1].removesuffix(",")
    return lines
