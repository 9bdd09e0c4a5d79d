"""The short report: the verdict, what to do, how far off a point is, and the poses, in as many lines as a screen has.

What a person must act on is never left out: the verdict and what to do come first and take what they need, and the
poses get the lines that are left. Where they do not fit, the short report says how many more there are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console, RenderableType
from rich.text import Text

from gtsam_rwhec.calibration.point_uncertainty import PointUncertainty, is_of_no_sensor
from gtsam_rwhec.calibration.verdict import Judgement
from gtsam_rwhec.files.terminal_text import LONGEST_LINE, counted, rounded, shown, shown_path
from gtsam_rwhec.report.advice import Styled
from gtsam_rwhec.report.report_blocks import Table, plain_text
from gtsam_rwhec.report.terminal_report import STYLES, TerminalTable, print_heading, print_sentence, report_console

#: Lines of a short report, with what a command says besides.
LINES = 40
#: Sentences in a file are not wrapped, and count as on a terminal of this width.
NARROW = 80
#: The verdict has at most this share of the lines; of a longer one the middle is left out.
VERDICT_SHARE = 0.4
#: Advice has at most these lines, with its heading, unless there is room for all poses beside more.
ADVICE_LINES = 9
#: So many sensors have lines of their own.
MOST_POINTS = 4
#: Lines for the poses of at least one sensor and one target, with headings, and for what the columns mean.
POSE_LINES = 14
#: Scales, clocks and warnings have at most these lines, unless there is room.
SENTENCE_LINES = 4


@dataclass(frozen=True)
class PoseTables:
    """The tables of sensors and targets, in one choice of columns, with the meaning of these columns."""

    tables: tuple[Table, ...]
    legend: str

    def first(self, number: int, marked: frozenset[str]) -> tuple[tuple[Table, ...], list[str]]:
        """The tables with this many rows in all, shared out, and what was left out: "92 more targets".

        Rows that are ``marked`` come before others.
        """
        wanted = [len(table.rows) for table in self.tables]
        kept, spare = [0] * len(wanted), number
        while spare > 0 and kept != wanted:
            i = min((i for i in range(len(wanted)) if kept[i] < wanted[i]), key=lambda i: kept[i])
            kept[i] += 1
            spare -= 1
        tables = tuple(_first_rows(table, count, marked) for table, count in zip(self.tables, kept, strict=True))
        left = [
            counted(all_ - count, f"more {table.headings[0]}")
            for table, all_, count in zip(self.tables, wanted, kept, strict=True)
            if all_ > count
        ]
        return tables, left


def _first_rows(table: Table, number: int, marked: frozenset[str]) -> Table:
    """The table with this many rows, in their order: those that are ``marked``, then the first of the others."""
    order = sorted(range(len(table.rows)), key=lambda i: plain_text(table.rows[i][0]) not in marked)
    return replace(table, rows=tuple(table.rows[i] for i in sorted(order[:number])))


@dataclass(frozen=True)
class ShortReport:
    """What the short report says."""

    judgement: Judgement
    proof: str = ""  #: What is proven of the answer, on one line beside the verdict
    advice: tuple[Styled, ...] = ()  #: What to do besides
    points: tuple[PointUncertainty, ...] = ()  #: How far off a point is, by sensor
    #: The poses, in the choices of columns that there are, the most telling one first
    poses: tuple[PoseTables, ...] = ()
    #: Frames whose pose is not to be used, warnings, scales, clocks: as many as fit, with their styles
    sentences: tuple[Styled, ...] = ()
    marked: frozenset[str] = frozenset()  #: Labels of frames whose poses are not to be used: they are among the rows

    def print(self, console: Console, *, lines: int = LINES, page: Path | None = None, whole: str) -> None:
        """Print at most so many lines; ``whole`` is how to see everything, and ``page`` the page that was written."""
        elsewhere = whole if page is None else f"{shown_path(page)}, or {whole}"
        closing = f"Everything else: {elsewhere}."
        room = _Room(console, lines)
        room.take(closing)
        verdict = _cut(room, str(self.judgement), math.floor(VERDICT_SHARE * lines))
        room.take(verdict, *([self.proof] if self.proof else []))
        all_poses = min((_height_of_all(room, poses) for poses in self.poses), default=0)
        poses_need = min(POSE_LINES, all_poses)
        most = max(min(ADVICE_LINES, room.left - poses_need - 2), room.left - all_poses - MOST_POINTS - 2)
        advice = _first(room, [(f"  - {words}", style) for words, style in self.advice], most - 2)
        room.take(*(words for words, _ in advice), more=2 if advice else 0)
        heading, points = _point_lines(self.points, MOST_POINTS)
        if room.lines_of(heading, *points) + 1 > room.left - poses_need:
            heading, points = _point_lines(self.points, 1)
        room.take(heading, *points, more=1 if points else 0)
        most = max(min(SENTENCE_LINES, room.left - poses_need), room.left - all_poses)
        sentences = _first(room, self.sentences, most)
        room.take(*(words for words, _ in sentences))
        print_sentence(console, verdict, STYLES[self.judgement.verdict])
        if self.proof:
            print_sentence(console, self.proof)
        if advice:
            print_heading(console, "What to do", tight=True)
            for words, style in advice:
                print_sentence(console, words, style)
        if points:
            print_heading(console, heading, tight=True)
            for words in points:
                print_sentence(console, words)
        if self.poses:
            console.print()
            _print_poses(console, room, self.poses, self.marked)
        for words, style in sentences:
            print_sentence(console, words, style)
        print_sentence(console, closing, "bold")


def lines_beside(messages: Sequence[str], console: Console | None = None) -> int:
    """The lines that a short report may take where a command says these messages too, on one screen.

    Parameters
    ----------
    messages : sequence of str
        What else is said.
    """
    room = _Room(report_console() if console is None else console, LINES)
    room.take(*messages)
    return max(room.left, LINES // 2)


class _Room:
    """The lines that are left, and how many lines words and tables take on this console."""

    def __init__(self, console: Console, lines: int) -> None:
        self.left = lines
        self._console = console
        self._width = console.width if console.is_terminal else min(console.width, NARROW)

    def lines_of(self, *things: RenderableType) -> int:
        """Number of lines of sentences and tables; in a file, as on a narrow terminal."""
        return sum(map(self._height, things))

    def take(self, *things: RenderableType, more: int = 0) -> None:
        """These are to be printed, and ``more`` empty lines and headings."""
        self.left -= self.lines_of(*things) + more

    def _height(self, thing: RenderableType) -> int:
        if isinstance(thing, str):
            return len(Text(shown(thing, LONGEST_LINE)).wrap(self._console, self._width))
        lines = self._console.render_lines(thing, pad=False)
        widths = (len("".join(segment.text for segment in line).rstrip()) for line in lines)
        return sum(max(1, -(-width // self._width)) for width in widths)


def _cut(room: _Room, words: str, most: int) -> str:
    """The words, without their middle where they take more lines than ``most``."""
    longest = LONGEST_LINE
    cut = shown(words, longest)
    while room.lines_of(cut) > most and longest > NARROW:
        longest -= NARROW // 2
        cut = shown(words, longest)
    return cut


def _first(room: _Room, items: Sequence[Styled], most: int) -> list[Styled]:
    """The items that fit into so many lines; where some do not, the last line says how many more there are."""
    if room.lines_of(*(words for words, _ in items)) <= most:
        return list(items)
    kept: list[Styled] = []
    for words, style in items:
        if room.lines_of(*(said for said, _ in kept), words) > most - 1:
            break
        kept.append((words, style))
    if not kept and items:  # the first is said all the same, as far as it fits
        kept = [(_cut(room, items[0][0], max(most - 1, 1)), items[0][1])]
    left = len(items) - len(kept)
    return [*kept, (f"  - and {left} more", "")] if left else kept


def _point_lines(points: Sequence[PointUncertainty], most: int) -> tuple[str, list[str]]:
    """The heading, and a line for each sensor; of more than ``most``, one line for the worst and the span of the rest.

    The first point's level of probability stands for all: a calibration has one.
    """
    if not points:
        return "", []
    heading = f"How far off a point is, by the calibration's error alone ({100.0 * points[0].level:g} %)"
    if len(points) <= most:
        return heading, [f"  - {_point(point)}" for point in points]
    worst = max(points, key=lambda point: point.radius_mm if np.isfinite(point.radius_mm) else np.inf)
    others = [point.radius_mm for point in points if point is not worst]
    known = [f"{rounded(mm)} mm" for mm in (min(others), max(others)) if np.isfinite(mm)]
    span = f" The other {len(others)}: {' to '.join(known)}." if len(known) == 2 else ""
    return heading, [f"  - {_point(worst)}", f"    This is the worst of {len(points)} sensors.{span}"]


def _point(point: PointUncertainty) -> str:
    distance_m = float(np.linalg.norm(point.point_m))
    if not np.isfinite(point.radius_mm):
        return f"{shown(point.frame)}: not determined, {distance_m:.2f} m away"
    said = f"{shown(point.frame)}: within {rounded(point.radius_mm)} mm, {distance_m:.2f} m away"
    if point.measurement_mm is None:
        return said
    if is_of_no_sensor(point.measurement_mm, distance_m):
        return f"{said}; noise of one new measurement: not told (the residuals are smaller than a sensor's)"
    return f"{said}; noise of one new measurement: {rounded(point.measurement_mm)} mm"


def _height_of_all(room: _Room, poses: PoseTables) -> int:
    """Lines of all rows and what the columns mean; of more rows than lines, as many as rows."""
    rows = sum(len(table.rows) for table in poses.tables)
    return rows if rows > room.left else room.lines_of(*_tight(poses.tables), poses.legend) + 1


def _tight(tables: Iterable[Table]) -> list[TerminalTable]:
    return [TerminalTable(table, tight=True) for table in tables]


def _print_poses(console: Console, room: _Room, choices: Sequence[PoseTables], marked: frozenset[str]) -> None:
    """The poses in the first choice of columns that shows all frames, or most of them."""

    def said(poses: PoseTables, number: int) -> tuple[list[TerminalTable], str]:
        tables, left = poses.first(number, marked)
        more = f"{' and '.join(left)} not shown here. " if left else ""
        return _tight(table for table in tables if table.rows), f"{more}{poses.legend}"

    def fits(poses: PoseTables, number: int) -> bool:
        tables, legend = said(poses, number)
        return room.lines_of(*tables, legend) <= room.left - 1

    rows = sum(len(table.rows) for table in choices[0].tables)
    fitting = [_most(partial(fits, poses), min(rows, room.left)) for poses in choices]
    chosen = choices[int(np.argmax(fitting))]  # the first of those that show most
    rows = max(max(fitting), min(rows, len(chosen.tables)))
    tables, legend = said(chosen, rows)
    for table in tables:
        console.print(table)
    print_sentence(console, legend, "dim")


def _most(fits: Callable[[int], bool], largest: int) -> int:
    """The largest number up to ``largest`` for which ``fits`` holds, by halving; 0 if none."""
    low, high = 0, largest
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if fits(middle) else (low, middle - 1)
    return low
