"""What an acceptance test showed: on the terminal, and in the verdict of a result's report."""

from __future__ import annotations

import math
from collections.abc import Iterator

from gtsam_rwhec.files.terminal_text import printable, rounded
from gtsam_rwhec.report.report_blocks import Block, Listing, Paragraph, Table, Tone, Words, significant
from gtsam_rwhec.report.shown_result import ShownResult
from gtsam_rwhec.report.terminal_report import print_blocks, print_heading, report_console
from gtsam_rwhec.results.acceptance_record import Acceptance, Answer

TONES: dict[Answer, Tone] = {
    Answer.ACCEPTED: "good",
    Answer.NOT_YET: "care",
    Answer.NOT_DETERMINED: "care",
    Answer.REJECTED: "bad",
}
TITLE = "Tested with known points that are new to the calibration"
HEADINGS = (
    "limit mm",
    "probability %",
    "n",
    "estimate mm",
    "below mm",
    "above mm",
    "noise across mm",
    "noise along mm",
)
LEGEND = (
    "estimate: the largest error in the volume by least squares. below, above: the largest error is below, or above, "
    "this with the probability. noise: standard deviation of one measurement along each axis across the sensor's line "
    "of sight, and along it. A calibration that is off by the limit is accepted in at most (100 - probability) %."
)


def acceptance_blocks(shown_result: ShownResult) -> Iterator[Block]:
    """The answers of all acceptance tests of a result, and their numbers; nothing where there are none."""
    found = () if shown_result.result is None else shown_result.result.acceptance
    rows: list[tuple[Words, ...]] = []
    for index, one in enumerate(found):
        yield Paragraph(str(one), TONES[one.answer])
        yield from _remarks(one)
        at = ("acceptance", index)
        rows.append(
            (
                one.sensor,
                shown_result.number(*at, "limit_mm", spec="g"),
                shown_result.number(*at, "level", times=100.0, spec="g"),
                shown_result.number(*at, "count", spec=".0f"),
                *(significant(shown_result.number(*at, f"{name}_mm"), 3) for name in ("estimate", "upper", "lower")),
                *(significant(each, 3) for each in shown_result.numbers(*at, "noise_mm")),
            )
        )
    if rows:
        yield Table(TITLE, ("sensor", *HEADINGS), tuple(rows), LEGEND)


def print_acceptance(found: Acceptance) -> None:
    """Print the answer of an acceptance test: the answer first, then its numbers, then what to keep in mind."""
    console = report_console()
    numbers = (found.estimate_mm, found.upper_mm, found.lower_mm, *found.noise_mm)
    cells = (f"{found.limit_mm:g}", f"{100.0 * found.level:g}", str(found.count), *map(rounded, numbers))
    print_blocks(console, [Paragraph(str(found), TONES[found.answer])])
    console.print()
    if math.isfinite(found.upper_mm):
        print_blocks(console, [Table.of(TITLE, "sensor", HEADINGS, {found.sensor: cells}, LEGEND)])
    if found.remarks:
        print_heading(console, "Keep in mind")
        print_blocks(console, _remarks(found))


def _remarks(found: Acceptance) -> Iterator[Block]:
    if found.remarks:
        yield Listing(tuple(f"{words[0].upper()}{words[1:]}." for words in map(printable, found.remarks)))
