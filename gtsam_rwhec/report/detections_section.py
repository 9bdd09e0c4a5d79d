"""Section 3: what was seen: images, detections over time, corners in the image, what was removed, the worst images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from gtsam_rwhec.files.terminal_text import listed
from gtsam_rwhec.report.choices_section import log_blocks
from gtsam_rwhec.report.figures import (
    GREY,
    INK,
    LIGHT_BLUE,
    ORANGE,
    PURPLE,
    VERMILLION,
    SvgFigure,
    image_axes,
    shortened,
    svg_figure,
)
from gtsam_rwhec.report.report_blocks import (
    Block,
    Chart,
    Folded,
    Listing,
    Paragraph,
    Picture,
    Piece,
    Section,
    Table,
    Words,
    worded,
)
from gtsam_rwhec.report.shown_result import ShownResult
from gtsam_rwhec.results.detection_evidence import MOST_LISTED, PIECES, RemovedMeasurement, SeenEvidence, SeenTrack
from gtsam_rwhec.results.image_errors import SeenCamera

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

#: A table of removed measurements with more rows is folded.
MOST_ROWS = 20
#: So many sentences of one kind are shown.
MOST_SENTENCES = 20
ONE_BY_ONE = ("image", "time, s", "target", "sensor", "reason")
TITLE = "What was seen"


def seen_section(shown: ShownResult) -> Section:
    """All that was seen, as far as it is known."""
    seen = None if shown.evidence is None else shown.evidence.seen
    if seen is None:
        found = tuple(_by_stage(shown))
        return Section("seen", TITLE, found, "" if found else "the result has no record of its measurements beside it.")
    blocks = [
        *_counts(shown, seen),
        *_registered(shown),
        *_detections(seen),
        *_coverage(shown, seen),
        *_removed(shown, seen),
        *_worst(shown, seen),
        *_sheet(shown, seen),
    ]
    return Section("seen", TITLE, (*blocks, *_by_stage(shown)))


def _by_stage(shown: ShownResult) -> Iterator[Block]:
    """What every stage used of each pair, where the measurements come from a log."""
    if shown.result is not None and shown.result.log is not None:
        yield Folded("What each stage used, and what it removed", tuple(log_blocks(shown.result.log)))


def _counts(shown: ShownResult, seen: SeenEvidence) -> Iterator[Block]:
    """How much there is, and what of it cannot be used."""
    used, removed = (shown.evident("seen", name, spec=",.0f") for name in ("used", "removed"))
    if seen.removed:
        yield Paragraph((used, " measurements are in the answer; ", removed, " were removed."), "lead")
    else:
        yield Paragraph((used, " measurements are in the answer; none was removed."), "lead")
    detection = shown.tree.get("log", {}).get("detection", {})
    images = detection.get("images", {})
    if images:
        words: list[Piece] = ["Looked at (images, clouds, or messages of a detector): "]
        for sensor in list(images)[:MOST_SENTENCES]:
            words += [shown.number("log", "detection", "images", sensor, spec=",.0f"), f" of {sensor}, "]
        words[-1] = str(words[-1]).removesuffix(", ") + (" and others." if len(images) > MOST_SENTENCES else ".")
        yield Paragraph(tuple(words))
    if detection.get("unseen"):
        yield Paragraph(f"No sensor saw {', '.join(detection['unseen'])}.", "care")
    said = [*detection.get("likely", ()), *detection.get("remarks", ())]
    if said:
        yield Listing(tuple(said[:MOST_SENTENCES]))
    faults = [fault for of_sensor in detection.get("undecoded", {}).values() for fault in of_sensor]
    if faults:
        yield Paragraph(f"{len(faults):,} images or clouds could not be used.", "care")
        some = (*faults[:MOST_SENTENCES], *_and_more(len(faults) - MOST_SENTENCES, "result.json has them"))
        yield Folded("Those that could not be used", (Listing(some),))


def _registered(shown: ShownResult) -> Iterator[Block]:
    """How clouds were registered with each other."""
    for k, one in enumerate(shown.tree.get("log", {}).get("detection", {}).get("objects", ())):
        at = ("log", "detection", "objects", k)
        used, views = (shown.number(*at, name, spec=",.0f") for name in ("used", "views"))
        noise, spacing = (shown.number(*at, name, spec=".2g") for name in ("noise_mm", "spacing_mm"))
        words = "{used} of {views} clouds of {sensor} were registered with each other, in {pairs} pairs; thinned to "
        words += "{spacing} mm, points of two clouds are {noise} mm apart across the surface (one standard deviation)."
        pairs = one["registrations"]
        yield Paragraph(
            worded(
                words, used=used, views=views, sensor=one["sensor"], pairs=str(len(pairs)), spacing=spacing, noise=noise
            )
        )
        rows: list[tuple[Words, ...]] = []
        for i in sorted(range(len(pairs)), key=lambda i: -pairs[i]["off_mm"]):
            pair, place = pairs[i], (*at, "registrations", i)
            overlap = shown.number(*place, "overlap", times=100.0, spec=".0f")
            off = shown.number(*place, "off_mm", spec=".2f"), shown.number(*place, "off_deg", spec=".3f")
            rows.append((pair["first"], pair["second"], overlap, *off, shown.number(*place, "slides", spec=".0f")))
        table = Table(
            f"Registrations of the clouds of {one['sensor']}",
            ("cloud", "with", "overlap, %", "off, mm", "off°", "slides"),
            tuple(rows[:MOST_LISTED]),
            "Off: how far the registration is from where the carriers' poses put the two clouds, at their own origins; "
            "the farthest first, without what slides. Slides: directions, of six, along which their surfaces slide.",
        )
        yield table if len(rows) <= MOST_ROWS else Folded(f"{len(rows)} registrations", (table,))


def _detections(seen: SeenEvidence) -> Iterator[Block]:
    if not seen.tracks:
        return
    rows = "a row for each target and sensor" if seen.tracks[0].target is not None else "a row for each sensor"
    drawn = sum(track.used + track.removed for track in seen.tracks)
    left = "" if seen.used + seen.removed == drawn else " Only the sensors with the most removed ones are shown."
    piece = (
        f"one tick stands for all within {seen.span_s / PIECES:.2g} s"
        if seen.span_s
        else "there are no stamps, so each pair stands in the order in which it was given, from its first to its last"
    )
    yield Chart(
        "detections",
        "Detections over time",
        f"A tick for each measurement in the answer, a sign above where it was removed: {rows}, {piece}.{left}",
        detections_figure(seen),
    )


def _removed(shown: ShownResult, seen: SeenEvidence) -> Iterator[Block]:
    """What was removed: counts with their reasons, and the single measurements."""
    if not seen.removed_counts:
        return
    order = sorted(range(len(seen.removed_counts)), key=lambda i: -seen.removed_counts[i].count)
    rows: list[tuple[Words, ...]] = []
    for i in order:
        one, count = seen.removed_counts[i], shown.evident("seen", "removed_counts", i, "count", spec=",.0f")
        rows.append((one.reason, count, one.stage, one.target, one.sensor))
    headings = ("reason", "removed", "by", "target", "sensor")
    table = Table("Removed measurements", headings, tuple(rows[:MOST_ROWS]))
    yield table
    if len(rows) > MOST_ROWS:
        rest = Table("Removed measurements: the others", headings, tuple(rows[MOST_ROWS:]))
        yield Folded(f"{len(rows) - MOST_ROWS} more rows", (rest,))
    if seen.removed_list:
        where = "the topics /calibration/SENSOR/pairs of calibration.mcap have them" if "log" in shown.tree else ""
        more = seen.removed - len(seen.removed_list) if len(seen.removed_list) == MOST_LISTED else 0
        notes = (Paragraph(words, "note") for words in _and_more(more, where))
        title = f"The first {MOST_LISTED} of them, one by one" if more else "All of them, one by one"
        yield Folded(title, (Table("Removed, one by one", ONE_BY_ONE, tuple(map(_row, seen.removed_list))), *notes))


def _row(one: RemovedMeasurement) -> tuple[Words, ...]:
    return one.image, "" if one.time_s is None else f"{one.time_s:.3f}", one.target, one.sensor, one.reason


def _and_more(count: int, where: str) -> tuple[str, ...]:
    if count <= 0:
        return ()
    return (f"And {count:,} more{f': {where}' if where else ''}.",)


def _coverage(shown: ShownResult, seen: SeenEvidence) -> Iterator[Block]:
    """Where in their images cameras saw corners."""
    if not seen.cameras:
        yield Paragraph(
            "Not shown: where in the image targets were seen, and the worst images. The measurements have no corners.",
            "absent",
        )
        return
    cells = seen.cameras[0].cells
    number = f"{max(len(cells), len(cells[0]))} x {min(len(cells), len(cells[0]))}"
    yield Chart(
        "coverage",
        "Coverage of the images",
        f"Each camera's image in {number} cells, with corners of images in the answer; the share of the cells that "
        "have any, and shaded the cells that have none: what the lens does there, no corner says."
        + (f" The first {MOST_CAMERAS} cameras." if len(seen.cameras) > MOST_CAMERAS else ""),
        coverage_figure(seen.cameras),
    )
    yield Listing(tuple(f"{camera.sensor}: {empty_in_words(camera.cells)}" for camera in seen.cameras))
    rows: list[tuple[Words, ...]] = []
    for i, camera in enumerate(seen.cameras):
        at = ("seen", "cameras", i)
        counts = (shown.evident(*at, field, spec=",.0f") for field in ("images", "corners"))
        share, rms = shown.evident(*at, "share", times=100.0, spec=".0f"), shown.evident(*at, "rms_px", spec=".3f")
        noise = "" if camera.noise_px is None else shown.evident(*at, "noise_px", spec=".3f")
        rows.append((camera.sensor, *counts, share, rms, noise))
    yield Table(
        "Corners of the images in the answer",
        ("camera", "targets in images", "corners", "cells with corners, %", "rms error, px", "a corner's noise, px"),
        tuple(rows),
        "Errors along each axis, seen minus predicted, "
        + (
            "with the carriers' pose of each image as its noise and the corners together say."
            if seen.cameras[0].at_optimum
            else "with the carriers' poses as they were measured."
        ),
    )


def _worst(shown: ShownResult, seen: SeenEvidence) -> Iterator[Block]:
    """The images whose corners are farthest off under the answer."""
    if not seen.worst:
        return
    rows: list[tuple[Words, ...]] = []
    for i, one in enumerate(seen.worst):
        at = ("seen", "worst", i)
        rms, largest = (shown.evident(*at, field, spec=".3f") for field in ("rms_px", "largest_px"))
        times = "" if one.times_noise is None else shown.evident(*at, "times_noise", spec=".1f")
        use = "in the answer" if one.is_used else "left out"
        rows.append((f"{i + 1}. {one.image}", one.sensor, one.target, rms, times, largest, use))
    yield Table(
        "The images whose corners are farthest off",
        ("image", "camera", "target", "rms, px", "times the noise", "largest, px", ""),
        tuple(rows),
    )
    if not shown.images:
        yield Paragraph("Not shown: these images. The page was made without images.", "absent")
        return
    if all(one.picture is None for one in seen.worst):
        yield Paragraph(f"Not shown: these images. Why: {seen.no_pictures or 'they cannot be read.'}", "absent")
        return
    yield Paragraph(
        "In each image: circles where corners were seen, crosses where the answer has them, and lines from the one "
        "towards the other, magnified as it is said. The largest errors have numbers, 1 for the largest."
    )
    for i, one in enumerate(seen.worst):
        if one.picture is None:
            continue
        noise = "" if one.times_noise is None else f", {one.times_noise:.1f} times the noise"
        left_out = "" if one.is_used else " It was left out of the answer."
        yield Picture(
            f"worst-{i + 1}",
            f"{i + 1}. {one.target} in {one.sensor}",
            f"Image {one.image}: rms {one.rms_px:.3f} px{noise}; lines {one.magnified:g} times as long.{left_out}",
            one.picture,
            is_wide=False,
        )


def _sheet(shown: ShownResult, seen: SeenEvidence) -> Iterator[Block]:
    if not shown.images:
        yield Paragraph("Not shown: the contact sheet. The page was made without images.", "absent")
    elif seen.sheet is None:
        why = seen.no_pictures or "there is no contact sheet beside the result."
        yield Paragraph(f"Not shown: the contact sheet. Why: {why}", "absent")
    else:
        yield Picture(
            "contact-sheet",
            "Some of the images",
            "Images of each camera, with what was found (solid outlines), and what was rejected or not read (dashes, "
            "and in words).",
            seen.sheet,
        )


#: A part with corners in at most this share of its cells has hardly any.
HARDLY = 0.17


def empty_in_words(cells: Sequence[Sequence[int]]) -> str:
    """A sentence about the parts of an image without corners; `cells` has the number of corners, rows from the top."""
    has = np.array(cells) > 0
    if has.all():
        return "every part of its image has corners."
    if not has.any():
        return "no part of its image has corners."
    told = np.zeros(has.shape, dtype=bool)
    nothing: list[str] = []
    hardly: list[str] = []
    for name, part in _parts(has.shape).items():
        if not told[part].all() and has[part].mean() <= HARDLY:
            (hardly if has[part].any() else nothing).append(f"in the {name}")
            told[part] = True
    for name, edge in EDGES.items():
        if not has[edge].any() and not told[edge].all():
            nothing.append(f"along the {name} edge")
    said = [f"{words} was seen {listed(where)}" for words, where in (("nothing", nothing), ("hardly anything", hardly))
            if where]  # fmt: skip
    if said:
        return f"{'; '.join(said)}."
    return f"{int((~has).sum())} of {has.size} cells have no corner, none of them a whole side or quarter."


#: The outermost cells of each side.
EDGES = {"left": np.s_[:, :1], "right": np.s_[:, -1:], "upper": np.s_[:1, :], "lower": np.s_[-1:, :]}


def _parts(shape: tuple[int, ...]) -> dict[str, tuple[slice, slice]]:
    """Halves, then quarters, which are not named again where halves are."""
    i, j = (round(0.5 * n) for n in shape)
    down, across = {"upper": np.s_[:i], "lower": np.s_[i:]}, {"left": np.s_[:j], "right": np.s_[j:]}
    every = slice(None)
    halves: dict[str, tuple[slice, slice]] = {f"{x} half": (every, columns) for x, columns in across.items()}
    halves |= {f"{y} half": (rows, every) for y, rows in down.items()}
    return halves | {f"{y} {x} quarter": (down[y], across[x]) for y in down for x in across}


#: Signs of what was removed, by stage.
SIGNS = {"detection": ("^", ORANGE), "cleaning": ("x", VERMILLION), "robust estimation": ("s", PURPLE)}
OTHER = ("+", GREY)
#: Half the height of a tick of a used measurement, and how far above its row the signs stand, rows.
TICK, ABOVE = 0.28, 0.36
#: So many cameras are drawn, in so many columns, each at most so high as wide.
MOST_CAMERAS, COLUMNS, TALLEST = 12, 2, 1.4
#: If a row has more signs than this, those within this many pieces next to each other become one.
MOST_SIGNS, TOGETHER = 100, 4
#: More corners than this have smaller marks.
MANY_CORNERS = 1500
#: A row's name has at most this many characters.
LONGEST = 26


def detections_figure(seen: SeenEvidence) -> SvgFigure:
    """A row for each pair, or sensor: a tick where a measurement is used, a sign where it was removed."""
    stages = sorted({stage for track in seen.tracks for stage in track.removed_at})
    signs = {stage: SIGNS.get(stage, OTHER) for stage in [*SIGNS, *stages] if stage in stages}

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        step = 1.0 if seen.span_s is None else seen.span_s / seen.pieces
        for row, track in enumerate(seen.tracks):
            _draw_track(axes, row, track, step, signs)
        axes.set_ylim(len(seen.tracks) - 0.5, -0.7)
        axes.set_yticks(range(len(seen.tracks)), [name_of(track) for track in seen.tracks])
        axes.grid(visible=False, axis="y")
        axes.tick_params(axis="y", length=0)
        axes.spines["left"].set_visible(False)
        axes.margins(x=0.01)
        if seen.span_s is None:
            axes.set_xlim(-0.01 * seen.pieces, 1.01 * seen.pieces)
            axes.set_xticks([0, seen.pieces], ["first", "last"])
            axes.set_xlabel("measurement, in the order given")
        else:
            axes.set_xlabel("time (s)")
        handles = [_handle("used", "|", LIGHT_BLUE)] + [
            _handle(f"removed by {stage}", *sign) for stage, sign in signs.items()
        ]
        figure.legend(handles=handles, loc="outside upper left", ncols=2, handletextpad=0.2, columnspacing=1.0)

    return svg_figure(draw, 1.15 + 0.25 * len(seen.tracks) + 0.2 * ((2 + len(signs)) // 2))


def name_of(track: SeenTrack) -> str:
    """A row's name."""
    return shortened(track.sensor if track.target is None else f"{track.target}, {track.sensor}", LONGEST)


def _draw_track(axes: Axes, row: int, track: SeenTrack, step: float, signs: dict[str, tuple[str, str]]) -> None:
    # Ticks of single pieces are one line, and pieces that follow one another one area: few words in the SVG.
    at = np.array([piece for piece, _ in track.used_at], dtype=int)
    begins = np.flatnonzero(np.diff(at, prepend=-2) > 1)
    first, last = at[begins], at[np.append(begins[1:], len(at)) - 1] if len(at) else at
    alone = step * (first[first == last] + 0.5)
    gap = np.full(len(alone), np.nan)
    ends = np.column_stack([np.full(len(alone), row - TICK), np.full(len(alone), row + TICK), gap])
    axes.plot(np.column_stack([alone, alone, gap]).ravel(), ends.ravel(), color=LIGHT_BLUE, lw=1.0)
    wide = first != last
    areas = list(zip(step * first[wide], step * (last - first + 1)[wide], strict=True))
    axes.broken_barh(areas, (row - TICK, 2.0 * TICK), facecolor=LIGHT_BLUE, lw=0.0)
    for stage, pieces in track.removed_at.items():
        marker, colour = signs[stage]
        at = np.array(pieces)[:, 0]
        if len(at) > MOST_SIGNS:
            at = np.unique(at // TOGETHER) * TOGETHER + TOGETHER // 2
        axes.plot(
            step * (0.5 + at), np.full(len(at), row - ABOVE), marker,
            color=colour, markersize=4.5, markerfacecolor="none", zorder=3,
        )  # fmt: skip


def _handle(label: str, marker: str, colour: str) -> Line2D:
    from matplotlib.lines import Line2D

    return Line2D([], [], ls="", marker=marker, markersize=6, color=colour, markerfacecolor="none", label=label)


def coverage_figure(cameras: Sequence[SeenCamera]) -> SvgFigure:
    """The image of each camera with its corners; cells without corners are shaded."""
    shown = cameras[:MOST_CAMERAS]
    columns = min(len(shown), COLUMNS)
    rows = -(-len(shown) // columns)
    tallest = min(max(camera.height / camera.width for camera in shown), TALLEST)

    def draw(figure: Figure) -> None:
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes, camera in zip(panels, shown, strict=False):
            _draw_camera(axes, camera)
        for axes in panels[len(shown) :]:
            axes.set_visible(False)

    return svg_figure(draw, rows * (0.75 + tallest * 4.4 / columns))


def _draw_camera(axes: Axes, camera: SeenCamera) -> None:
    image_axes(axes, (camera.width, camera.height))
    cells = np.array(camera.cells)
    height, width = camera.height / cells.shape[0], camera.width / cells.shape[1]
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    empty = [Rectangle((width * c - 0.5, height * r - 0.5), width, height) for r, c in np.argwhere(cells == 0)]
    axes.add_collection(
        PatchCollection(empty, facecolor=ORANGE, alpha=0.35, edgecolor=INK, lw=0.3, hatch="////", zorder=1)
    )
    size = 2.6 if len(camera.x) > MANY_CORNERS else 3.6
    # As a picture in the figure: thousands of marks would be most of the page.
    axes.plot(camera.x, camera.y, ".", color=LIGHT_BLUE, markersize=size, markeredgewidth=0, zorder=2, rasterized=True)
    axes.set_title(f"{shortened(camera.sensor)}: {camera.share:.0%}")
