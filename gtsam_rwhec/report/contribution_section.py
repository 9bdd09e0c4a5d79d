"""Section 8: how much each image contributed, and which could be left out."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Literal

import numpy as np

from gtsam_rwhec.report.figures import LIGHT_BLUE, SvgFigure, svg_figure
from gtsam_rwhec.report.report_blocks import Block, Chart, Paragraph, Section, Table, Words, significant, worded
from gtsam_rwhec.report.shown_result import ShownResult
from gtsam_rwhec.results.contribution import ContributionEvidence

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLE = "What each image contributed"
ABOUT = (
    "At the level of poses, with errors that are independent from image to image: where errors vary slowly, or are the "
    "same in all images, fewer images tell less than this says. An image here is all that one camera saw at one stamp."
)
WITHOUT_STAMPS = " There are no stamps, so each measurement counts by itself."
LEGEND = (
    "share: of all that was learnt. moves: without it the pose that moves most moves by so many of its standard "
    "deviations, and millimetres. grows: the standard deviation that grows most without it."
)
#: An image without which a pose moves more than this many of its deviations deserves a look.
MOVES = 2.0


def contribution_section(shown: ShownResult) -> Section:
    """Information by image, leave-one-out, and how few images tell nearly as much."""
    found = None if shown.evidence is None else shown.evidence.contribution
    if found is None:
        why = shown.why_missing(found, "the calibration has no covariances, and so no information to divide.")
        return Section("contribution", TITLE, missing=why)
    what = "images" if found.has_stamps else "measurements"
    blocks: list[Block] = [*_fewer(shown, found, what)]
    caption = f"The {len(found.important)} {what} that tell most"
    blocks.append(_table(shown, found, "important", caption, LEGEND))
    blocks += _influential(shown, found, what)
    blocks.append(Paragraph(ABOUT + ("" if found.has_stamps else WITHOUT_STAMPS), "note"))
    return Section("contribution", TITLE, tuple(blocks))


def _fewer(shown: ShownResult, found: ContributionEvidence, what: str) -> Iterator[Block]:
    at = ("contribution", "fewer")
    for i, one in enumerate(found.fewer):
        if one.growth == 0.1:
            of = what if found.bundle == 1 else f"bundles of {found.bundle} {what}"
            words = (
                "{enough} of {bundles} {of}, chosen well, tell nearly as much as all: no standard deviation is larger "
                "by more than {growth} %. The others could be left out."
            )
            enough, bundles = (shown.evident(*each, "bundles", spec=".0f") for each in ((*at, i), ("contribution",)))
            growth = shown.evident(*at, i, "growth", times=100.0, spec=".0f")
            yield Paragraph(worded(words, enough=enough, bundles=bundles, of=of, growth=growth), "lead")
    rows = tuple(
        ((shown.evident(*at, i, "growth", times=100.0, spec=".0f"), " %"), shown.evident(*at, i, "bundles", spec=".0f"))
        for i in range(len(found.fewer))
    )
    chosen = what if found.bundle == 1 else "bundles"
    yield Table(f"How many {chosen} are enough", ("no deviation larger by", f"{chosen} needed"), rows)
    yield Chart(
        "contribution-curve",
        f"With fewer {chosen}",
        f"The largest growth of a standard deviation, if {chosen} are added in the best order found.",
        _curve(found, chosen),
    )


def _curve(found: ContributionEvidence, what: str) -> SvgFigure:
    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        growth = 100.0 * np.array(found.curve)
        at = np.arange(1, len(growth) + 1)
        low = growth <= 200.0
        axes.plot(at[low], growth[low], color=LIGHT_BLUE, lw=2)
        axes.set_xlabel(f"{what} used, of {found.bundles}")
        axes.set_ylabel("worst deviation larger by (%)")
        axes.set_ylim(0.0, 200.0)
        axes.set_xlim(0.0, found.bundles)

    return svg_figure(draw, 2.8)


def _influential(shown: ShownResult, found: ContributionEvidence, what: str) -> Iterator[Block]:
    if not found.influential:
        return
    worst = found.influential[0]
    at = ("contribution", "influential")
    said = (
        f"Look at these {what} first if you doubt the answer."
        if worst.moved > MOVES
        else f"No single one of the {what} decides the answer."
    )
    words = (
        "Without the one that matters most, {frame} would move by {moved} of its standard deviations ({moved_mm} mm). "
        f"{said}"
    )
    numbers = {field: significant(shown.evident(*at, 0, field), 2) for field in ("moved", "moved_mm")}
    yield Paragraph(worded(words, frame=worst.moved_frame, **numbers))
    caption = f"The {len(found.influential)} {what} without which the answer moves most"
    yield _table(shown, found, "influential", caption)


def _table(
    shown: ShownResult, found: ContributionEvidence, which: Literal["important", "influential"], caption: str,
    legend: str = "",
) -> Table:  # fmt: skip
    time, spec = ("time s", ".2f") if found.has_stamps else ("place", ".0f")
    rows: list[tuple[Words, ...]] = []
    for i, one in enumerate(getattr(found, which)):
        at = ("contribution", which, i)
        share, growth = (significant(shown.evident(*at, field, times=100.0), 2) for field in ("share", "growth"))
        moved = (significant(shown.evident(*at, field), 2) for field in ("moved", "moved_mm"))
        when = shown.evident(*at, "time", spec=spec)
        rows.append((one.sensor, when, ", ".join(one.targets), share, one.moved_frame, *moved, growth))
    return Table(caption, ("sensor", time, "targets", "share %", "moves", "", "mm", "grows %"), tuple(rows), legend)
