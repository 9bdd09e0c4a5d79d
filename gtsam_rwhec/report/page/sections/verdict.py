"""Section 1: whether to use the poses, how far off a point is, what to do, and the poses."""

from __future__ import annotations

import re
from collections.abc import Iterator

from gtsam_rwhec.calibration.verdict import Finding, Verdict, findings_of
from gtsam_rwhec.report.advice import Advice
from gtsam_rwhec.report.page.blocks import Block, Folded, Listing, Paragraph, Section, Table, Tone, significant
from gtsam_rwhec.report.page.sections.pose_tables import pose_blocks
from gtsam_rwhec.report.page.shown_result import ShownResult

TONES: dict[Verdict, Tone] = {Verdict.USE: "good", Verdict.CARE: "care", Verdict.DO_NOT_USE: "bad"}
#: The words in a reason between facts and advice.
BETWEEN = ". What to do: "
#: So many sensors have a large figure each; of more, the worst one has.
FEW_SENSORS = 4
POINTS = (
    "This is the error of the calibration alone, where each sensor typically saw its targets; the noise of one new "
    "measurement comes on top, and averages out over several. Section Uncertainty has other distances."
)
NOTHING_TO_DO = "Nothing has to be done first: copy the poses from the last section, Inputs and versions."
NO_NOISE_STATED = "Look at the residuals, in mm and degrees, before you trust the poses: no noise was stated."


def verdict_section(shown: ShownResult) -> Section:
    """The verdict with its grounds, how far off a point is, what to do; then the poses."""
    verdict = Verdict(shown.tree["verdict"])
    facts, _, cure = shown.tree["verdict_reason"].partition(BETWEEN)
    blocks: list[Block] = [Paragraph(f"{verdict.words}: {facts}.", TONES[verdict])]
    points = list(_points(shown))
    blocks += [block for block in points if isinstance(block, Paragraph)]
    todo = list(_todo(shown, cure))
    if todo:
        blocks += [Paragraph("What to do next", "lead"), Listing(tuple(todo))]
    else:
        blocks.append(Paragraph(NOTHING_TO_DO))
    findings = _findings(shown)
    if len(findings) > 1:
        grounds = Listing(tuple(f"{_sentence(one.words)} {_sentence(one.ground.advice)}" for one in findings))
        blocks.append(Folded("The grounds of this verdict one by one, the most serious first", (grounds,)))
    blocks += [block for block in points if not isinstance(block, Paragraph)]
    blocks += pose_blocks(shown)
    return Section("verdict", "Verdict", tuple(blocks))


def _todo(shown: ShownResult, cure: str) -> Iterator[str]:
    """What to do: the advice of the verdict, and what the terminal says below it."""
    numbered = re.split(r"(?:^|; )\(\d+\) ", cure)
    yield from (_sentence(one) for one in numbered if one)
    result = shown.result
    if result is None:
        return
    if result.calibration is None and result.solution.is_relative:
        yield NO_NOISE_STATED
    free = () if result.refined is None else result.refined.free_directions
    free = free or result.solution.identifiability.free_directions
    yield from Advice.of(free, result.log, result.judgement).sentences


def _findings(shown: ShownResult) -> list[Finding]:
    """The findings behind the verdict, in the order of its grounds, each once."""
    result = shown.result
    if result is None:
        return []
    found = findings_of(result.solution, result.refined)
    if result.calibration is not None:
        found += result.calibration.findings
    grounds = list(result.judgement.grounds)
    counted = dict.fromkeys(one for one in found if one.ground in grounds)
    return sorted(counted, key=lambda one: grounds.index(one.ground))


def _sentence(words: str) -> str:
    """Words with a capital and a full stop; a name at the beginning stays as it is."""
    first = words.split(" ", 1)[0]
    begun = words[:1].upper() + words[1:] if first.isalpha() and first.islower() else words
    return begun if begun.endswith((".", "!", "?")) else f"{begun}."


def _points(shown: ShownResult) -> Iterator[Block]:
    """How far off a point is where the targets were seen."""
    points = shown.tree.get("calibration", {}).get("points", [])
    if not points:
        return
    title = "How far off a point is where the targets were seen"
    which = range(len(points))
    if len(points) > FEW_SENSORS:
        radii = [float("inf") if point["radius_mm"] is None else point["radius_mm"] for point in points]
        which = range(worst := max(which, key=radii.__getitem__), worst + 1)
        title += ": the worst sensor"
    yield Paragraph(f"{title}:")
    for i in which:
        radius = significant(shown.number("calibration", "points", i, "radius_mm"), 2)
        level = shown.number("calibration", "points", i, "level", times=100.0, spec="g", unit="%")
        if radius.value is None:
            yield Paragraph(f"{points[i]['frame']}: not determined", "lead")
        else:
            yield Paragraph((f"{points[i]['frame']}: ", radius, " mm with ", level, " probability"), "lead")
    rows = tuple(
        (
            point["frame"],
            point["seen_from"],
            shown.number("calibration", "points", i, "level", times=100.0, spec="g"),
            significant(shown.number("calibration", "points", i, "radius_mm"), 3),
            "-"
            if point.get("measurement_mm") is None
            else significant(shown.number("calibration", "points", i, "measurement_mm"), 3),
        )
        for i, point in enumerate(points)
    )
    headings = ("sensor", "expressed in", "probability %", "within mm", "one new measurement adds mm")
    yield Table("How far off a point is", headings, rows, POINTS)
