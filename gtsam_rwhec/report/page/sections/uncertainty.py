"""Section 7: how well poses are known: deviations, correlation, points at several distances, intrinsics and clocks."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from gtsam_rwhec.files.terminal_text import natural_key
from gtsam_rwhec.fitting.unknowns import UnknownKind
from gtsam_rwhec.report.covariance_report import DEVIATION_HEADINGS
from gtsam_rwhec.report.page.blocks import Block, Folded, Number, Paragraph, Section, Table, Words, significant
from gtsam_rwhec.report.page.sections.covariance_charts import correlation_chart, deviations_chart
from gtsam_rwhec.report.page.sections.pose_tables import ANGLES, LEGEND, TRANSLATION, deviation_cells, known_unknowns
from gtsam_rwhec.report.page.shown_result import ShownResult

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
        yield Paragraph(NO_EVIDENCE.format(what="points at several distances"), "note")
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
            *(shown.evident("derived", "relative", i, "translation_m", k, spec="z.4f") for k in range(3)),
            *(shown.evident("derived", "relative", i, "rpy_deg", k, spec="z.2f") for k in range(3)),
            *(shown.evident("derived", "relative", i, "deviations_mm", k, spec=".2f") for k in range(3)),
            *(shown.evident("derived", "relative", i, "deviations_deg", k, spec=".3f") for k in range(3)),
        )
        for i, pose in enumerate(relative)
    )
    yield Table(
        f"Other sensors in the frame of {relative[0]['first']}",
        ("sensor", *TRANSLATION, *ANGLES, *DEVIATION_HEADINGS),
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
            "note",
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
    yield Paragraph(f"What clocks would do is not shown: {why}.", "note")


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
    tables = tuple(
        Table(
            f"{title}, {unit}",
            (of, *frames),
            tuple(
                (
                    cause,
                    *(
                        significant(number(places[cause, frame], field), 2) if (cause, frame) in places else "-"
                        for frame in frames
                    ),
                )
                for cause in causes
            ),
        )
        for field, unit in fields
    )
    yield Folded(f"{title}: every frame", tables)


def _size(number: Number) -> float:
    return float("inf") if number.value is None else number.value
