"""Section 1: whether to use the poses, how far off a point is, what to do, and the poses."""

from __future__ import annotations

import re
from collections.abc import Iterator

import gtsam
import numpy as np

from gtsam_rwhec.calibration.verdict import Finding, Verdict, findings_of
from gtsam_rwhec.files.terminal_text import natural_key
from gtsam_rwhec.report.acceptance_section import acceptance_blocks
from gtsam_rwhec.report.advice import advice_of
from gtsam_rwhec.report.report_blocks import (
    TONES,
    Block,
    Folded,
    Listing,
    Paragraph,
    Section,
    Table,
    Words,
    significant,
)
from gtsam_rwhec.report.shown_result import ShownResult

POSE_HEADINGS = ("x m", "y m", "z m", "roll°", "pitch°", "yaw°")
DEVIATION_HEADINGS = ("±x mm", "±y mm", "±z mm", "±x°", "±y°", "±z°")
#: Beside the name of a frame whose pose is not to be used.
MARK = "(!)"
#: The words in a reason between facts and advice.
BETWEEN = ". What to do: "
#: So many sensors have a large figure each; of more, the worst one has.
FEW_SENSORS = 4
POINTS = (
    "This is the error of the calibration alone, where each sensor typically saw its targets; the noise of one new "
    "measurement comes on top, and averages out over several."
)
OTHER_POINTS = "Section Uncertainty has other distances."
OTHER_POINTS_IN_PYTHON = "In Python, calibration.uncertainty_at(point, frame) tells of any other point."
NOTHING_TO_DO = "Nothing has to be done first."
WHERE_TO_COPY = "Copy the poses from the last section, Inputs and versions."
NO_NOISE_STATED = "Look at the residuals, in mm and degrees, before you trust the poses: no noise was stated."


def verdict_section(shown: ShownResult) -> Section:
    """The verdict with its grounds, how far off a point is, what to do; then the poses."""
    verdict = Verdict(shown.tree["verdict"])
    facts, _, cure = shown.tree["verdict_reason"].partition(BETWEEN)
    blocks: list[Block] = [Paragraph(f"{verdict.words}: {facts}.", TONES[verdict])]
    points = list(_points(shown))
    blocks += [block for block in points if isinstance(block, Paragraph)]
    blocks += acceptance_blocks(shown)
    todo = list(_todo(shown, cure))
    if todo:
        blocks += [Paragraph("What to do next", "lead"), Listing(tuple(todo))]
    else:
        blocks.append(Paragraph(NOTHING_TO_DO if shown.in_memory else f"{NOTHING_TO_DO} {WHERE_TO_COPY}"))
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
    yield from (words for words, _ in advice_of(result.free_directions, result.log, shown.judgement))


def _findings(shown: ShownResult) -> list[Finding]:
    """The findings behind the verdict, in the order of its grounds, each once."""
    result = shown.result
    if result is None:
        return []
    found = [*findings_of(result.solution, result.refined), *shown.findings]
    if result.calibration is not None:
        found += result.calibration.findings
    grounds = list(shown.judgement.grounds)
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
    rows: list[tuple[Words, ...]] = []
    for i, point in enumerate(points):
        at = ("calibration", "points", i)
        level, radius = (
            shown.number(*at, "level", times=100.0, spec="g"),
            significant(shown.number(*at, "radius_mm"), 3),
        )
        has_noise = point.get("measurement_mm") is not None
        noise: Words = significant(shown.number(*at, "measurement_mm"), 3) if has_noise else "-"
        distance = f"{np.linalg.norm(point['point_m']):.2f}"
        rows.append((point["frame"], point["seen_from"], distance, level, radius, noise))
    headings = ("sensor", "expressed in", "targets at m", "probability %", "within mm", "one new measurement adds mm")
    elsewhere = OTHER_POINTS_IN_PYTHON if shown.in_memory else OTHER_POINTS
    yield Table("How far off a point is", headings, tuple(rows), f"{POINTS} {elsewhere}")


LEGEND = (
    "±: one standard deviation, along and about the axes of the frame itself; free: infinite, because the measurements "
    "leave a direction free."
)
LEGEND_ANGLES = "Metres and degrees. Roll, pitch, yaw: R = Rz(yaw) Ry(pitch) Rx(roll). "
SCALARS = {"scale": "scale", "time_offset": "clock offset"}
SCALARS_LEGEND = (
    "Scale: measured length / true length. Clock offset: a stamp of the sensor + this = the carriers' time. ±: one "
    "standard deviation."
)
FIXED = "fixed"


def pose_blocks(shown: ShownResult) -> Iterator[Block]:
    """A table of the sensors' poses, and one of the targets'; a word on those that are not to be used."""
    tree = shown.tree
    sides = (("Sensors", "sensor", "sensors"), ("Targets", "target", "targets"))
    if not any(tree.get(side) for *_, side in sides):
        yield Paragraph("There are no poses: the calibration has no answer.")
        return
    wrong = [row["child"] for *_, side in sides for row in tree[side] if row.get("contradicted")]
    for title, kind, side in sides:
        if tree[side]:
            yield _table(shown, f"{title} in the frame {tree[side][0]['parent']}", kind, side)
    yield from _scalars(shown)
    if wrong:
        names = ", ".join(sorted(wrong, key=natural_key))
        yield Paragraph(f"{MARK}: do not use this pose, because its own measurements contradict it: {names}.", "bad")


def _scalars(shown: ShownResult) -> Iterator[Block]:
    """Scales and clock offsets that were estimated; without evidence, without their deviations."""
    known = (shown.evidence_tree.get("derived") or {}).get("scalars", ())
    rows: list[tuple[Words, ...]] = []
    for i, scalar in enumerate(known):
        times, spec, unit = (1.0, ".6f", "") if scalar["kind"] == "scale" else (1e3, "+.3f", "ms")
        of = f" of {scalar['owner']}" if scalar["owner"] else ""
        value = shown.evident("derived", "scalars", i, "value", times=times, spec=spec)
        deviation = shown.evident("derived", "scalars", i, "deviation", times=times, spec=spec.removeprefix("+"))
        rows.append((SCALARS[scalar["kind"]] + of, value, deviation, unit))
    if not known and shown.tree.get("scale_mode") != "known":
        scale = shown.tree.get("scale")
        names = list(scale) if isinstance(scale, dict) else []
        rows += [(f"scale of {name}", shown.number("scale", name, spec=".6f"), "-", "") for name in names]
        if isinstance(scale, float):
            rows.append(("scale", shown.number("scale", spec=".6f"), "-", ""))
    if rows:
        yield Table("Scales and clocks", ("of", "value", "±", "unit"), tuple(rows), SCALARS_LEGEND)


def _table(shown: ShownResult, title: str, kind: str, side: str) -> Table:
    rows = shown.tree[side]
    frames = (shown.tree.get("refined") or {}).get("frames", {})
    cells = []
    for i in sorted(range(len(rows)), key=lambda i: natural_key(rows[i]["child"])):
        name = rows[i]["child"]
        row: list[Words] = [f"{name} {MARK}" if rows[i].get("contradicted") else name]
        row += shown.numbers(side, i, "translation_m", spec="z.4f")
        row += [f"{angle:z.2f}" for angle in np.degrees(gtsam.Rot3(np.array(rows[i]["rotation_matrix"])).rpy())]
        cells.append((*row, *(deviation_cells(shown, name) if frames else ())))
    headings = (kind, *POSE_HEADINGS, *(DEVIATION_HEADINGS if frames else ()))
    return Table(title, headings, tuple(cells), LEGEND_ANGLES + (LEGEND if frames else ""))


def deviation_cells(shown: ShownResult, name: str) -> list[Words]:
    """Standard deviations of a frame: along x, y, z in millimetres, then about them in degrees."""
    if name not in known_unknowns(shown):
        return [FIXED] * 6
    at = ("refined", "frames", name)
    along, about = (f"standard_deviations_{unit}" for unit in ("mm", "deg"))
    return [
        significant(number, 1) if 0.0 < (number.value or 0.0) < 10.0**-decimals else number
        for field, decimals in ((along, 2), (about, 3))
        for number in shown.numbers(*at, field, spec=f".{decimals}f")
    ]


def known_unknowns(shown: ShownResult) -> frozenset[str]:
    """The names of all that was estimated; a frame that is not among them was stated."""
    return frozenset(shown.tree["refined"]["joint"]["slots"])
