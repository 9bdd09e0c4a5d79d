"""The least known direction of each frame in words, with the motion that would make it known better."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gtsam_rwhec.report.page.blocks import Block, Folded, Listing, Paragraph, Table, Words, significant
from gtsam_rwhec.report.page.shown_result import ShownResult
from gtsam_rwhec.results.weak_poses import MORE, TURN_RAD, WEAK, WeakDirection

NO_TURN = "No such turn would help clearly more than measuring on."
#: A direction is called after a coordinate axis within 8 degrees of it.
AXIS_COSINE = np.cos(np.radians(8.0))
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
        yield Paragraph(NOT_KNOWN, "note")
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
    deviation = significant(shown.evident("weak", i, "deviation"), 2)
    words: tuple[str | object, ...] = (
        f"{one.frame} {along} {axis_words(one.axis_in_carrier, one.carrier)}: ± ",
        deviation,
        f"{unit}.",
    )
    if one.turn is not None:
        words += (
            f" Turn by {np.degrees(TURN_RAD):.0f} degrees to both sides about "
            f"{axis_words(one.turn, sensor_carrier(shown))}, with {_in_view(shown, one)}: {MORE} "
            "measurements would bring it to about ± ",
            significant(shown.evident("weak", i, "after_turning"), 2),
            f"{unit}, as many like those there are to ± ",
            significant(shown.evident("weak", i, "after_more"), 2),
            f"{unit}.",
        )
    elif one.after_more is not None:
        words += (
            f" No turn helps more than measuring on: {MORE} more measurements would bring it to about ± ",
            significant(shown.evident("weak", i, "after_more"), 2),
            f"{unit}.",
        )
    return words  # type: ignore[return-value]


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
