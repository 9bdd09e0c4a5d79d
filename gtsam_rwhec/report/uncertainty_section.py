"""Section 7: how well poses are known: deviations, correlation, points at several distances, intrinsics and clocks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from gtsam_rwhec.files.terminal_text import natural_key
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.report.figures import AXIS_COLOURS, AXIS_NAMES, INK, plain_decades, shortened, svg_figure
from gtsam_rwhec.report.report_blocks import Block, Chart, Folded, Number, Paragraph, Section, Table, Words, significant
from gtsam_rwhec.report.shown_result import ShownResult
from gtsam_rwhec.report.verdict_section import (
    DEVIATION_HEADINGS,
    LEGEND,
    POSE_HEADINGS,
    deviation_cells,
    known_unknowns,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: So many frames have a column of their own in a table of what moves them.
MOST_COLUMNS = 12
NOT_REFINED = "the result has no covariances, because it was not refined."
NO_EVIDENCE = "Not shown: {what}, for the result has no evidence.json beside it."
BY_CLOCKS = (
    "Were the offset of a clock off by 1 ms, the poses that fit best would be these much elsewhere: the regression of "
    "the pose on the offset, cov(pose, offset) / var(offset)."
)
BY_INTRINSICS = (
    "How far the best poses would move if the intrinsics, taken as exact, were off by so much; or by that noise of A."
)


def uncertainty_section(shown: ShownResult) -> Section:
    """Standard deviations, correlation, task units; what intrinsics and clocks would do to the poses."""
    title = "Uncertainty"
    if shown.result is None or shown.result.refined is None:
        return Section("uncertainty", title, missing=NOT_REFINED)
    blocks: list[Block] = [*_points(shown), *deviations_chart(shown.result.refined)]
    blocks += correlation_chart(shown.result.refined)  # beside one another where the page is wide
    blocks += _deviations(shown)
    blocks += [*_relative(shown), *_intrinsics(shown), *_clocks(shown)]
    return Section("uncertainty", title, tuple(blocks))


def _points(shown: ShownResult) -> Iterator[Block]:
    """How far off a point is at several distances, a row for each sensor."""
    derived = shown.evidence_tree.get("derived") or {}
    points = derived.get("points", ())
    if not points:
        yield Paragraph(NO_EVIDENCE.format(what="points at several distances"), "absent")
        return
    fixed = sorted({point["distance_m"] for point in points if not point["is_seen"]})
    rows: dict[str, dict[float | str, Words]] = {}
    for i, point in enumerate(points):
        radius = significant(shown.evident("derived", "points", i, "radius_mm"), 2)
        at = rows.setdefault(point["sensor"], {"from": point["seen_from"]})
        if point["is_seen"]:
            at |= {"seen": shown.evident("derived", "points", i, "distance_m", spec=".2f"), "there": radius}
        if not point["is_seen"] or point["distance_m"] in fixed:
            at[point["distance_m"]] = radius
    headings = ("sensor", "expressed in", *(f"{distance:g} m" for distance in fixed), "targets at m", "there")
    table_rows = tuple(
        (sensor, *(at.get(key, "-") for key in ("from", *fixed, "seen", "there"))) for sensor, at in rows.items()
    )
    level = shown.evident("derived", "level", times=100.0, spec="g")
    yield Paragraph(("A point that a sensor sees is within this many millimetres with ", level, " % probability."))
    yield Table(
        "How far off a point is, mm, by its distance",
        headings,
        table_rows,
        "In the direction in which the sensor saw its targets: the error of the calibration, without the noise of a "
        "new measurement. In Python, calibration.uncertainty_at(point, frame) tells of any other point.",
    )


def _deviations(shown: ShownResult) -> Iterator[Block]:
    """The standard deviations as a table: the same numbers as in the tables of poses."""
    tree = shown.tree
    names = [row["child"] for side in ("sensors", "targets") for row in tree[side]]
    rows = tuple(
        (name, *deviation_cells(shown, name))
        for name in sorted(names, key=natural_key)
        if name in known_unknowns(shown)
    )
    table = Table("Standard deviations", ("frame", *DEVIATION_HEADINGS), rows, LEGEND)
    yield Folded("The standard deviations as numbers", (table,))


def _relative(shown: ShownResult) -> Iterator[Block]:
    """The poses of the other sensors in the frame of the first."""
    relative = (shown.evidence_tree.get("derived") or {}).get("relative", ())
    if not relative:
        return
    rows = tuple(
        (
            pose["second"],
            *shown.evidents("derived", "relative", i, "translation_m", spec="z.4f"),
            *shown.evidents("derived", "relative", i, "rpy_deg", spec="z.2f"),
            *shown.evidents("derived", "relative", i, "deviations_mm", spec=".2f"),
            *shown.evidents("derived", "relative", i, "deviations_deg", spec=".3f"),
        )
        for i, pose in enumerate(relative)
    )
    yield Table(
        f"Other sensors in the frame of {relative[0]['first']}",
        ("sensor", *POSE_HEADINGS, *DEVIATION_HEADINGS),
        rows,
        "Sensors on one carrier are often known far better relative to each other than on the carrier.",
    )


def _intrinsics(shown: ShownResult) -> Iterator[Block]:
    """What wrong intrinsics would do, by cause."""
    path = ("refined", "reprojection", "consequences")
    found = ((shown.tree["refined"].get("reprojection") or {}).get("consequences")) or ()
    if not found:
        yield Paragraph(
            "What wrong intrinsics would do is not shown: the answer is not from corners, and the intrinsics by which "
            "targets were measured, if there are any, are not known to it.",
            "absent",
        )
        return
    yield from _moved(
        "What intrinsics would do",
        BY_INTRINSICS,
        "cause",
        [(i, row["cause"], row["frame"]) for i, row in enumerate(found)],
        lambda i, field: shown.number(*path, i, field),
    )


def _clocks(shown: ShownResult) -> Iterator[Block]:
    """What an error of an estimated clock offset would do, by sensor."""
    found = (shown.evidence_tree.get("derived") or {}).get("clocks", ())
    if found:
        yield from _moved(
            "What clocks would do",
            BY_CLOCKS,
            "1 ms of the clock of",
            [(i, row["sensor"], row["frame"]) for i, row in enumerate(found)],
            lambda i, field: shown.evident("derived", "clocks", i, field),
        )
        return
    assert shown.result is not None
    assert shown.result.refined is not None
    offsets = any(unknown.kind is UnknownKind.TIME_OFFSET for unknown in shown.result.refined.unknowns)
    why = (
        "the result has no evidence.json beside it"
        if offsets
        else "no clock offset was estimated, so the calibration takes all clocks as right"
    )
    yield Paragraph(f"What clocks would do is not shown: {why}.", "absent")


def _moved(
    title: str, legend: str, of: str, rows: list[tuple[int, str, str]], number: Callable[[int, str], Number]
) -> Iterator[Block]:
    """The frame that each cause moves most, and turns most; folded, what it does to every frame.

    ``rows`` has the place of each record, its cause and its frame; ``number`` gives a field of a record.
    """
    causes, frames = list(dict.fromkeys(row[1] for row in rows)), list(dict.fromkeys(row[2] for row in rows))
    fields = (("translation_mm", "mm"), ("rotation_deg", "°"))
    worst = []
    for cause in causes:
        cells: list[Words] = [cause]
        for field, _ in fields:
            at, _, frame = max((row for row in rows if row[1] == cause), key=lambda row: _size(number(row[0], field)))
            cells += [frame, significant(number(at, field), 2)]
        worst.append(tuple(cells))
    yield Table(title, (of, "moves most", "mm", "turns most", "°"), tuple(worst), legend)
    if len(frames) > MOST_COLUMNS:
        return
    places = {(cause, frame): at for at, cause, frame in rows}

    def cell(cause: str, frame: str, field: str) -> Words:
        at = places.get((cause, frame))
        return "-" if at is None else significant(number(at, field), 2)

    tables = []
    for field, unit in fields:
        each = tuple((cause, *(cell(cause, frame, field) for frame in frames)) for cause in causes)
        tables.append(Table(f"{title}, {unit}", (of, *frames), each))
    yield Folded(f"{title}: every frame", tuple(tables))


def _size(number: Number) -> float:
    return float("inf") if number.value is None else number.value


#: A chart has a line for each of so many frames: those that are known least.
MOST_FRAMES = 40
#: Unknowns have a block with all their parameters up to this number; beyond it, one square each.
FEW_UNKNOWNS = 14
#: Names stand beside up to this number of blocks or squares.
MOST_NAMES = 45
#: The kinds of unknowns in their order, and what stands before the name of one.
KINDS = {
    UnknownKind.FRAME: "",
    UnknownKind.INTRINSICS: "lens of ",
    UnknownKind.SHAPE: "shape of ",
    UnknownKind.SCALE: "scale of ",
    UnknownKind.TIME_OFFSET: "clock of ",
}
#: One name for all that have one number each: beside one another their names would not be legible.
SINGLE = "scales, clocks"
MARKERS = ("o", "s", "^")


def deviations_chart(refined: RefinedPoses) -> Iterator[Block]:
    """Standard deviations of the frames along and about their own axes."""
    found = {
        name: refined.standard_deviations(name)
        for name in sorted((*refined.Y, *refined.X), key=natural_key)
        if name in refined.names
    }
    known = {name: pair for name, pair in found.items() if all(np.isfinite(each).all() for each in pair)}
    if not known:
        yield Paragraph("No frame has a finite standard deviation along all its axes.", "note")
        return
    if len(known) > MOST_FRAMES:
        worst = sorted(known, key=lambda name: known[name][1].max(), reverse=True)[:MOST_FRAMES]
        known = {name: known[name] for name in known if name in worst}
    left_out = len(found) - len(known)
    says = "One standard deviation of each frame along (left) and about (right) its own x, y and z axes."
    if left_out:
        says += f" {left_out} frames are left out, which are known better or have a free direction."

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, 2, sharey=True)
        for axes, which, unit in ((panels[0], 1, "mm"), (panels[1], 0, "degrees")):
            values = np.array([pair[which] for pair in known.values()])
            for k in range(3):
                axes.plot(values[:, k], range(len(known)), MARKERS[k], color=AXIS_COLOURS[k], label=AXIS_NAMES[k])
            low, high = float(values.min()), float(values.max())
            if low > 0.0 and high > 8.0 * low:
                axes.set_xscale("log")
                plain_decades(axes.xaxis, low, high)
                axes.set_xlim(0.8 * low, 1.25 * high)
            else:
                axes.set_xlim(0.0, 1.12 * high or 1.0)
                axes.locator_params(axis="x", nbins=4, steps=[1, 2, 4, 5, 10])
                axes.xaxis.set_major_formatter(lambda value, _: f"{value:.3g}")
            axes.set_xlabel(f"± {unit}")
        panels[0].set_yticks(range(len(known)), [shortened(name, 14) for name in known])
        panels[0].set_ylim(len(known) - 0.5, -0.5)
        figure.legend(*panels[1].get_legend_handles_labels(), loc="outside upper right", ncols=3, fontsize=9)

    yield Chart("deviations", "Standard deviations", says, svg_figure(draw, 1.1 + 0.24 * len(known)))


def correlation_chart(refined: RefinedPoses) -> Iterator[Block]:
    """The correlation of all unknowns, ordered by kind and name; of many, the largest of each pair."""
    order = sorted(refined.unknowns, key=lambda one: (list(KINDS).index(one.kind), natural_key(one.owner)))
    if not order:
        return
    rows = [np.arange(len(refined.joint.unit))[refined.joint.slots[one]] for one in order]
    place = np.concatenate(rows)
    matrix = correlation(refined.joint.finite[np.ix_(place, place)])
    sizes = [len(each) for each in rows]
    has_blocks = len(order) <= FEW_UNKNOWNS
    says = (
        "The correlation of all unknowns, from -1 (orange) through 0 (white) to 1 (blue). A block has the rotation of "
        "a frame about x, y, z, then its translation."
    )
    if not has_blocks:
        matrix, sizes = _largest_of_blocks(matrix, sizes), [1] * len(order)
        says = (
            "The largest correlation between the parameters of two unknowns, from 0 (white) to 1 (blue), without sign."
        )
    says += " Frames that are correlated are off together; the relative poses below count it."
    if refined.joint.free.shape[1]:
        says += " Free directions are left out."
    names, sizes = _groups(order, sizes)

    def draw(figure: Figure) -> None:
        from matplotlib.colors import LinearSegmentedColormap

        axes = figure.subplots()
        colours = LinearSegmentedColormap.from_list("correlation", ["#D55E00", "#FFFFFF", "#0072B2"])
        image = axes.imshow(matrix, cmap=colours, vmin=-1.0, vmax=1.0, interpolation="nearest")
        edges = np.cumsum([0, *sizes]) - 0.5
        middles = 0.5 * (edges[1:] + edges[:-1])
        size = 9 if len(names) <= FEW_UNKNOWNS else 6
        if len(names) <= MOST_NAMES:
            axes.set_xticks(middles, names, rotation=90, fontsize=size)
            axes.set_yticks(middles, names, fontsize=size)
        else:
            axes.set(xticks=[], yticks=[])
        axes.grid(visible=False)
        axes.tick_params(length=0)
        if has_blocks:
            for edge in edges[1:-1]:
                axes.axhline(edge, color="#555555", lw=0.5)
                axes.axvline(edge, color="#555555", lw=0.5)
        bar = figure.colorbar(image, ax=axes, shrink=0.7, ticks=[-1, 0, 1] if has_blocks else [0, 1])
        bar.outline.set_edgecolor(INK)
        if not has_blocks:
            bar.ax.set_ylim(0.0, 1.0)

    yield Chart("correlation", "Correlation", says, svg_figure(draw, 4.6))


def correlation(covariance: Array) -> Array:
    """The correlation matrix of a covariance; rows without variance correlate with nothing."""
    deviation = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    inverse = np.divide(1.0, deviation, out=np.zeros_like(deviation), where=deviation > 0.0)
    return np.clip(covariance * inverse[:, None] * inverse, -1.0, 1.0)


def _groups(unknowns: list[Unknown], sizes: list[int]) -> tuple[list[str], list[int]]:
    """The names beside the matrix and the sizes of their blocks; scales and clocks, which come last, have one name."""
    single = (UnknownKind.SCALE, UnknownKind.TIME_OFFSET)
    alone = [i for i, one in enumerate(unknowns) if one.kind not in single]
    names = [shortened(KINDS[unknowns[i].kind] + unknowns[i].owner, 18) for i in alone]
    rest = sum(sizes) - sum(sizes[i] for i in alone)
    return names + [SINGLE] * bool(rest), [sizes[i] for i in alone] + [rest] * bool(rest)


def _largest_of_blocks(matrix: Array, sizes: list[int]) -> Array:
    """The largest size of the entries in each block."""
    first = np.cumsum([0, *sizes[:-1]])
    of_rows = np.maximum.reduceat(np.abs(matrix), first, axis=0)
    return np.maximum.reduceat(of_rows, first, axis=1)
