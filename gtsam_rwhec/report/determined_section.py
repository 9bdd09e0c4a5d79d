"""Section 4: which sensor and target determine each other, and which directions are free or weak, with their cures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from gtsam_rwhec.files.terminal_text import natural_key
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.report.report_blocks import (
    Block,
    Folded,
    Listing,
    Number,
    Paragraph,
    Section,
    Table,
    Words,
    significant,
    worded,
)
from gtsam_rwhec.report.shown_result import ShownResult
from gtsam_rwhec.results.weak_poses import MORE, TURN_RAD, WEAK, WeakDirection
from gtsam_rwhec.solver.free_directions import AXIS_COSINE, FreeReason, all_slide

#: A grid with more targets has a row for each target, and a column for each sensor.
MOST_COLUMNS = 10
#: A blank at which no line is broken.
TOGETHER = "\N{NO-BREAK SPACE}"
#: A grid with more rows is folded.
MOST_ROWS = 40
#: A direction with less than this many times the information at which it would be free is near to it.
NEAR = 10.0
#: What settles a free direction, by the reason for which it is free.
CURES: Mapping[FreeReason, str] = {
    FreeReason.CONTRADICTION: "First correct how A and B are read; the motion may be good.",
    FreeReason.FEW: "Measure these frames at three poses or more, which turn about two different axes.",
    FreeReason.NO_ROTATION: "Turn the carriers, by 30 degrees or more, about two axes that are far from parallel.",
    FreeReason.ONE_AXIS: "Turn the carriers about a second axis, across the first, by 30 degrees or more.",
    FreeReason.NOISE: "Turn by larger angles about the axes that were used least, or measure far more often.",
    FreeReason.COMPENSATED: "Turn about a second axis, or state what is known: a size, a scale, or one of the poses.",
    FreeReason.STANDSTILL: "Measure while the carriers move and turn, faster and with changes of direction.",
    FreeReason.SLIDES: "Nothing, if only the sensors' poses are wanted; else show another side, or another thing.",
    FreeReason.SYMMETRY: "Turn by other angles than half a turn, and about axes that are not in one plane.",
}
#: What the sign of a pair means. The shapes differ, so that nobody needs to see colours.
DETERMINED, NOT_DETERMINED, NOT_OBSERVED = "■", "□", "·"
SIGNS = {
    DETERMINED: "determined by its own measurements",
    NOT_DETERMINED: "seen, but not determined by its own measurements",
    NOT_OBSERVED: "not seen",
}
ALL_DETERMINED = "The measurements determine every direction beyond their noise: none is free."
NO_ANSWER = "the calibration has no answer."


Count = tuple[Number | str, ...]


def determines_section(shown: ShownResult) -> Section:
    """The grid of the RWHEC paper's Figure 8 with counts; free and weak directions, with motions that settle them."""
    title = "Who determines whom"
    if shown.result is None:
        return Section("determines", title, missing=NO_ANSWER)
    known = shown.result.solution.identifiability
    blocks: list[Block] = [Paragraph(_what_was_measured(shown)), Paragraph(str(known)), *_grid(shown), *_motions(shown)]
    free = shown.result.free_directions
    if free:
        blocks.append(Paragraph("Free directions: the poses can move along them and fit as well.", "bad"))
        blocks.append(Listing(tuple(f"Not determined: {one}. {CURES[one.reason]}" for one in free)))
    else:
        blocks.append(Paragraph(ALL_DETERMINED))
        blocks += _distance_to_free(shown)
    blocks += weak_blocks(shown)
    return Section("determines", title, tuple(blocks))


def _what_was_measured(shown: ShownResult) -> str:
    """How many frames, pairs and measurements the certified answer is from."""
    assert shown.result is not None
    solution = shown.result.solution
    measurements = sum(residual.number_of_measurements for residual in solution.residuals.values())
    return (
        f"{len(solution.X)} targets, {len(solution.Y)} sensors, {len(solution.residuals)} pairs, {measurements} "
        "measurements."
    )


def _distance_to_free(shown: ShownResult) -> Iterator[Block]:
    """How far the least known direction is from being free, by the test against noise."""
    at = ("certified", "identifiability")
    weakest, threshold = (significant(shown.number(*at, name), 2) for name in ("weakest", "threshold"))
    if weakest.value is None or threshold.value is None:
        return
    near = " That is near: turn more before you rely on it." if weakest.value < NEAR * threshold.value else ""
    words = (
        "The least known direction of all holds {weakest} times the information that noise alone would make; up to "
        f"{{threshold}} times it would count as free.{near}"
    )
    yield Paragraph(worded(words, weakest=weakest, threshold=threshold))


def _grid(shown: ShownResult) -> Iterator[Block]:
    """The grid: in each cell a sign, and the measurements that are used."""
    assert shown.result is not None
    alone = shown.result.solution.identifiability.pairs
    counts = _counts(shown)
    pairs = [pair for pair in counts if not pair.is_motion]
    if not pairs:
        return
    targets = sorted({pair.target for pair in pairs}, key=natural_key)
    sensors = sorted({pair.sensor for pair in pairs}, key=natural_key)

    def cell(target: str, sensor: str) -> Words:
        pair = Pair(target, sensor)
        found = alone.get(pair)
        is_known = found is not None and all_slide(found.free_directions)
        sign = NOT_OBSERVED if found is None else DETERMINED if is_known else NOT_DETERMINED
        return (f"{sign}{TOGETHER}", *counts[pair]) if pair in counts else sign

    by_targets = len(targets) > MOST_COLUMNS and len(targets) > len(sensors)
    across, down = (sensors, targets) if by_targets else (targets, sensors)
    rows = tuple((name, *(cell(name, other) if by_targets else cell(other, name) for other in across)) for name in down)
    caption = "Sensors and targets (RWHEC paper, Figure 8)"
    kind = "target" if by_targets else "sensor"
    table = Table(caption, (kind, *across), rows, _legend(any(len(count) > 1 for count in counts.values())))
    yield table if len(rows) <= MOST_ROWS else Folded(f"{caption}: {len(rows)} rows", (table,))


def _legend(has_outliers: bool) -> str:
    signs = "; ".join(f"{sign} {meaning}" for sign, meaning in SIGNS.items())
    more = ", out of how many where some were left out" if has_outliers else ""
    return f"{signs}. The number beside a sign is that of the measurements in the answer{more}."


def _counts(shown: ShownResult) -> dict[Pair, Count]:
    """The measurements of each pair in the answer, and how many there were, as the result has them."""
    tree, certified = shown.tree, ("certified", "identifiability", "pairs")
    counts: dict[Pair, Count] = {
        Pair(row["target"], row["sensor"]): (shown.number(*certified, i, "number_of_measurements", spec=".0f"),)
        for i, row in enumerate(tree["certified"]["identifiability"]["pairs"])
    }
    for i, row in enumerate((tree.get("log") or {}).get("outliers", ())):
        if row.get("left_out", 0):
            used, left_out = (shown.number("log", "outliers", i, name, spec=".0f") for name in ("used", "left_out"))
            counts[Pair(row["target"], row["sensor"])] = (used, f"{TOGETHER}(-", left_out, ")")
    for i, row in enumerate((tree.get("refined") or {}).get("inlier_counts", ())):
        kept, of = row["value"]
        if kept < of:
            kept, of = (shown.number("refined", "inlier_counts", i, "value", k, spec=".0f") for k in range(2))
            counts[Pair(row["target"], row["sensor"])] = (kept, "/", of)
    return counts


def _motions(shown: ShownResult) -> Iterator[Block]:
    """A sentence for each sensor's own motion, which sees no target."""
    assert shown.result is not None
    sentences = [
        f"{pair.sensor} from its own motion: {'determined' if alone.is_unique else 'not determined'}."
        for pair, alone in shown.result.solution.identifiability.pairs.items()
        if pair.is_motion
    ]
    if sentences:
        yield Listing(tuple(sentences))


NO_TURN = "No such turn would help clearly more than measuring on."
NOT_KNOWN = (
    "Not shown: the least known directions beside those that are free. They need evidence.json beside the result, and "
    "covariances that are finite for some frame."
)
NONE_IS_WEAK = (
    f"No direction is weak: none has a standard deviation above {WEAK:g} times the median of all. The table has the "
    "least known direction of each frame."
)
LEGEND = (
    f"Least known first. With turns: {MORE} more measurements with the named partner in view, one carrier turned "
    f"against the other by {np.degrees(TURN_RAD):.0f} degrees to both sides about an axis of the sensors' carrier, "
    f"through the target. With more: {MORE} more like those there are. Both count for as much as those there are do, "
    "correlation counted; errors that all measurements share stay."
)


def weak_blocks(shown: ShownResult) -> Iterator[Block]:
    """The weak directions as sentences, and the least known direction of every frame as a table."""
    weak = () if shown.evidence is None else shown.evidence.weak
    if not weak:
        yield Paragraph(NOT_KNOWN, "absent")
        return
    said = tuple(_sentence(shown, i, one) for i, one in enumerate(weak) if one.is_weak)
    if said:
        yield Paragraph("Weak directions: determined, but far less well than the others.")
        yield Listing(said)
    else:
        yield Paragraph(NONE_IS_WEAK)
    can_help = any(one.turn is not None for one in weak)
    turning = ("turn about", "with turns") if can_help else ()
    tables = [
        Table(
            f"Least known {'directions' if kind == 'translation' else 'rotation axes'}",
            ("frame", "along" if kind == "translation" else "about", unit, "measured with", *turning, "with more"),
            tuple(_row(shown, i, one, can_help) for i, one in enumerate(weak) if one.kind == kind),
            LEGEND if can_help else f"{NO_TURN} {LEGEND}",
        )
        for kind, unit in (("translation", "±mm"), ("rotation", "±°"))
    ]
    yield Folded("The least known direction of each frame, and the motion that would help", tuple(tables))


def axis_words(axis: tuple[float, float, float], frame: str) -> str:
    """Words for a direction: "hand's z axis", or "(0.60, 0.80, 0.00) of hand"."""
    k = int(np.abs(axis).argmax())
    if abs(axis[k]) > AXIS_COSINE:
        return f"{frame}'s {'xyz'[k]} axis"
    rounded = np.round(np.array(axis) * np.sign(axis[k]), 2) + 0.0
    vector = ",\N{NO-BREAK SPACE}".join(f"{value:.2f}" for value in rounded)
    return f"({vector}) of {frame}"


def _sentence(shown: ShownResult, i: int, one: WeakDirection) -> Words:
    """A weak direction and its cure."""
    along, unit = ("along", " mm") if one.kind == "translation" else ("about", "°")
    numbers = {
        field: significant(shown.evident("weak", i, field), 2) for field in ("deviation", "after_turning", "after_more")
    }
    words = "{frame} {along} {axis}: ± {deviation}{unit}."
    turn = view = ""
    if one.turn is not None:
        turn, view = axis_words(one.turn, sensor_carrier(shown)), _in_view(shown, one)
        words += (
            f" Turn by {np.degrees(TURN_RAD):.0f} degrees to both sides about {{turn}}, with {{view}}: {MORE} "
            "measurements would bring it to about ± {after_turning}{unit}, as many like those there are to ± "
            "{after_more}{unit}."
        )
    elif one.after_more is not None:
        words += (
            f" No turn helps more than measuring on: {MORE} more measurements would bring it to about ± "
            "{after_more}{unit}."
        )
    axis = axis_words(one.axis_in_carrier, one.carrier)
    return worded(words, frame=one.frame, along=along, axis=axis, unit=unit, turn=turn, view=view, **numbers)


def _in_view(shown: ShownResult, one: WeakDirection) -> str:
    """Which target is to be in view of which sensor."""
    is_target = any(row["child"] == one.frame for row in shown.tree["targets"])
    target, sensor = (one.frame, one.partner) if is_target else (one.partner, one.frame)
    return f"{target} in view of {sensor}"


def _row(shown: ShownResult, i: int, one: WeakDirection, can_help: bool) -> tuple[Words, ...]:
    turning: tuple[Words, ...] = (
        "-" if one.turn is None else axis_words(one.turn, sensor_carrier(shown)),
        "-" if one.after_turning is None else significant(shown.evident("weak", i, "after_turning"), 2),
    )
    return (
        one.frame,
        axis_words(one.axis_in_carrier, one.carrier),
        significant(shown.evident("weak", i, "deviation"), 2),
        one.partner or "-",
        *(turning if can_help else ()),
        "-" if one.after_more is None else significant(shown.evident("weak", i, "after_more"), 2),
    )


def sensor_carrier(shown: ShownResult) -> str:
    """The name of the frame that carries the sensors."""
    return str(shown.tree["sensors"][0]["parent"])
