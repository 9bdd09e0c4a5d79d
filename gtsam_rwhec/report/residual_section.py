"""Section 6: what is left after the fit, by pair, time, place and configuration, and against the noise model."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtri

from gtsam_rwhec.files.terminal_text import natural_key
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.report.figures import (
    GREEN,
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
from gtsam_rwhec.report.report_blocks import Block, Chart, Folded, Paragraph, Section, Table, Words, significant, worded
from gtsam_rwhec.report.shown_result import ShownResult
from gtsam_rwhec.results.image_errors import CELLS, SeenCamera
from gtsam_rwhec.results.residual_evidence import (
    BEYOND_3_BY_CHANCE,
    FEWEST,
    Dependence,
    ResidualsEvidence,
    pooled_residual,
)
from gtsam_rwhec.solver.solution import Solution

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TITLE = "Residuals"
RESIDUAL_HEADINGS = ("rms mm", "rms°", "n")
CERTIFIED_LEGEND = (
    "rms: root mean square length of the residuals of a frame's n measurements, weighted as in the cost, in mm and "
    "degrees."
)
#: Residuals are called as large as the noise within these.
AS_LARGE = (0.9, 1.1)
#: A table has so many pairs; the others are in the evidence.
MOST_PAIRS = 100
#: So many cameras have their arrows drawn.
MOST_CAMERAS = 8


def residuals_section(shown: ShownResult) -> Section:
    """Residuals, the noise model, correlation, hold-out."""
    found = None if shown.evidence is None else shown.evidence.residuals
    if found is None:
        why = shown.why_missing(found, "the calibration has no covariances, and so no noise to compare with.")
        return Section("residuals", TITLE, tuple(_of_certified(shown)), why)
    blocks: list[Block] = [
        Paragraph(
            "A residual is how far a measurement B is from what the answer predicts, Y⁻¹ A X. Its size says how noisy "
            "single measurements are; a pattern in it says what the model lacks."
        ),
        *_by_sensor(shown, found),
        Chart(
            "residuals-by-pair",
            "By pair",
            "Angles and lengths of residuals. Box: the middle half; line in it: the median.",
            boxes_figure(found),
        ),
        Chart(
            "residuals-by-time",
            "Over time" if found.has_stamps else "In the order given",
            "Angles and lengths of residuals. A slope or waves mean drift, or a clock that is wrong.",
            time_figure(found),
        ),
    ]
    cameras = _cameras_with_corners(shown)
    if cameras:
        blocks.append(
            Chart(
                "residuals-in-the-image",
                "Over the image",
                "Mean error of the corners in each part of the image, drawn larger. Arrows in order mean that the "
                "lens model, or the board, is not quite right; arrows in disorder are noise.",
                image_figure(cameras[:MOST_CAMERAS]),
            )
        )
    else:
        blocks.append(Paragraph("Not shown: errors over the image, for there are no corners.", "absent"))
    blocks += [*_by_configuration(shown, found), *_against_noise(shown, found), *_neighbours(shown, found)]
    return Section("residuals", TITLE, (*blocks, _pairs(shown, found), *_of_certified(shown)))


def _of_certified(shown: ShownResult) -> Iterator[Block]:
    """How well each frame's measurements fit the certified answer."""
    if shown.result is None:
        return
    solution = shown.result.solution
    names = [name for poses in (solution.Y, solution.X) for name in sorted(poses, key=natural_key)]
    rows: dict[str, tuple[Words, ...]] = {name: residual_cells(solution, name) for name in names}
    yield Table.of("Residuals of the certified answer", "frame", RESIDUAL_HEADINGS, rows, CERTIFIED_LEGEND)


def residual_cells(solution: Solution, name: str) -> tuple[str, ...]:
    """The root mean square residual of a frame's measurements, mm and degrees, and how many they are."""
    residual = pooled_residual(residual for pair, residual in solution.residuals.items() if name in pair)
    if residual.number_of_measurements == 0:
        return "-", "-", "0"
    return (
        f"{1e3 * residual.translation_rms_m:.1f}",
        f"{math.degrees(residual.rotation_rms_rad):.2f}",
        str(residual.number_of_measurements),
    )


def _cameras_with_corners(shown: ShownResult) -> tuple[SeenCamera, ...]:
    seen = None if shown.evidence is None else shown.evidence.seen
    return () if seen is None else tuple(camera for camera in seen.cameras if camera.x)


def _by_sensor(shown: ShownResult, found: ResidualsEvidence) -> Iterator[Block]:
    """Hold-out errors: how well measurements are predicted that the calibration has not seen."""
    at = ("residuals", "hold_out")
    rows: list[tuple[Words, ...]] = []
    fields = ("held_out_mm", "fitted_mm", "held_out_deg", "fitted_deg")
    for i, one in enumerate(found.hold_out):
        cells = (significant(shown.evident(*at, i, field), 3) for field in fields)
        rows.append((one.sensor, shown.evident(*at, i, "measurements", spec=".0f"), *cells))
    if rows:
        yield Table(
            "Measurements that were left out, and how well the others predict them",
            ("sensor", "predicted", "mm, left out", "mm, fitted", "°, left out", "°, fitted"),
            tuple(rows),
            "Root mean square length and angle, by blocks in time, at the level of poses (one linear step from the "
            "answer). Much larger left out than fitted: too few measurements, or errors that vary slowly.",
        )
    else:
        yield Paragraph(
            "Not shown: hold-out errors, for no block of measurements is predicted by the others.", "absent"
        )
    yield from _pixels(shown)


def _pixels(shown: ShownResult) -> Iterator[Block]:
    """The same of corners, in pixels, where the refinement was from corners."""
    reprojection = (shown.tree.get("refined") or {}).get("reprojection")
    rows = []
    for name, sensor in ({} if reprojection is None else reprojection["sensors"]).items():
        keys = [key for key in ("rms_px", "held_out_px", "expected_px", "held_out_mm") if sensor.get(key) is not None]
        if len(keys) == 4:
            rows.append(
                (name, *(significant(shown.number("refined", "reprojection", "sensors", name, k), 3) for k in keys))
            )
    if rows:
        yield Table(
            "Corners of images that were left out",
            ("sensor", "px, fitted", "px, left out", "px, expected", "mm, left out"),
            tuple(rows),
            "Root mean squares, fitted ones along each axis, others lengths. Expected: if the model is right.",
        )


def _by_configuration(shown: ShownResult, found: ResidualsEvidence) -> Iterator[Block]:
    one = found.dependence
    if one is None:
        yield Paragraph(
            f"Not shown: residuals over the carriers' pose, for no sensor has {FEWEST} measurements.", "absent"
        )
        return
    at = ("residuals", "dependence")
    verdict = (
        "This is more than chance: an arm's kinematics, a clock, a lens or a board that bends can do it."
        if abs(one.correlation) > one.by_chance
        else "That much is chance."
    )
    correlation, by_chance = (shown.evident(*at, field, spec=".2f") for field in ("correlation", "by_chance"))
    words = (
        "The strongest dependence on the carriers' pose: {component} of {sensor}, with {by}: correlation "
        "{correlation}, where chance alone stays below {by_chance}. {verdict}"
    )
    of = {"component": one.component, "sensor": one.sensor, "by": one.by, "verdict": verdict}
    yield Paragraph(worded(words, correlation=correlation, by_chance=by_chance, **of))
    yield Chart(
        "residuals-by-configuration",
        "Over the carriers' pose",
        f"{one.component[0].upper()}{one.component[1:]}, {one.sensor}, in units of its noise, over {one.by}, from the "
        "mean. The line is the mean of a tenth.",
        dependence_figure(one),
    )


def _against_noise(shown: ShownResult, found: ResidualsEvidence) -> Iterator[Block]:
    low, high = AS_LARGE
    size = "smaller than" if found.spread < low else "larger than" if found.spread > high else "as large as"
    words = (
        "Residuals are {size} the noise that was found: their root mean square is {spread} of it. Beyond three "
        "deviations are {beyond} % ({by_chance} % of normal noise); excess kurtosis {kurtosis} (0 for normal noise; "
        "heavy tails are positive)."
    )
    numbers = {
        "spread": shown.evident("residuals", "spread", spec=".2f"),
        "beyond": shown.evident("residuals", "beyond_3", times=100.0, spec=".2f"),
        "kurtosis": shown.evident("residuals", "excess_kurtosis", spec=".1f"),
    }
    yield Paragraph(worded(words, size=size, by_chance=f"{100.0 * BEYOND_3_BY_CHANCE:.2f}", **numbers))
    yield Chart(
        "residuals-against-noise",
        "Against the noise model",
        "All residuals divided by their noise, beside normal noise.",
        normal_figure(found),
    )


def _neighbours(shown: ShownResult, found: ResidualsEvidence) -> Iterator[Block]:
    known = [(pair.neighbours, pair.band) for pair in found.pairs if pair.neighbours is not None]
    judged, beyond = len(known), sum(band is not None and abs(own) > band for own, band in known)
    words = ""
    if judged:
        words = (
            f"In {beyond} of {judged} pairs residuals follow or oppose those before more than chance allows in 95 %: "
            f"of {judged} pairs about {0.05 * judged:.1f} are so by chance."
        )
    if found.instants is None or found.worth is None:
        yield Paragraph(f"{words} No model of all noise was made, so what the data are worth is not known.")
        return
    more = " With the correlation that was found, {instants} poses of the carriers are worth {worth} independent ones."
    numbers = {field: shown.evident("residuals", field, spec=".0f") for field in ("instants", "worth")}
    yield Paragraph(worded(words + more, **numbers))


def _pairs(shown: ShownResult, found: ResidualsEvidence) -> Block:
    """The numbers of each pair, folded."""
    rows = []
    for i, pair in enumerate(found.pairs[:MOST_PAIRS]):
        at = ("residuals", "pairs", i)
        neighbours: Words = "-" if pair.neighbours is None else shown.evident(*at, "neighbours", spec=".2f")
        band: Words = "-" if pair.band is None else shown.evident(*at, "band", spec=".2f")
        sizes = (significant(shown.evident(*at, field), 3) for field in ("rms_mm", "rms_deg", "spread"))
        rows.append((f"{pair.target}, {pair.sensor}", shown.evident(*at, "used", spec=".0f"), *sizes, neighbours, band))
    more = len(found.pairs) - len(rows)
    legend = (
        "of noise: root mean square in units of it. neighbours: correlation with the measurement before; by chance it "
        "stays within the last column in 95 %." + (f" {more} more pairs are in evidence.json." if more else "")
    )
    headings = ("pair", "n", "rms mm", "rms°", "of noise", "neighbours", "by chance")
    table = Table("Residuals by pair", headings, tuple(rows), legend)
    return Folded(f"Residuals of {len(found.pairs)} pairs", (table,))


#: Sensors are told apart by colour and by sign, up to this number; more are drawn alike.
SIGNS = ((LIGHT_BLUE, "o"), (VERMILLION, "^"), (GREEN, "s"), (ORANGE, "D"), (PURPLE, "v"), (GREY, "P"))
#: With more pairs there is one box a sensor.
MOST_BOXES = 14
#: More signs than this become pixels.
MANY = 600
#: A cell with fewer corners has no arrow.
FEWEST_CORNERS = 3
#: The longest arrow, in cells.
ARROW = 0.9


def boxes_figure(found: ResidualsEvidence) -> SvgFigure:
    """Boxes of angles and lengths by pair, or by sensor where there are many pairs."""
    grouped: dict[str, list[tuple[Array, Array]]] = {}
    for pair in found.pairs:
        if not pair.used:
            continue
        name = f"{pair.target}, {pair.sensor}" if len(found.pairs) <= MOST_BOXES else pair.sensor
        inside = np.array(pair.in_answer, dtype=bool)
        grouped.setdefault(name, []).append((np.array(pair.deg)[inside], np.array(pair.mm)[inside]))

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, 2, sharey=True)
        for axes, k, unit in zip(panels, (0, 1), ("degrees", "mm"), strict=True):
            values = [np.concatenate([part[k] for part in parts]) for parts in grouped.values()]
            line = {"color": INK, "linewidth": 0.8}
            axes.boxplot(
                values, orientation="horizontal", widths=0.6, flierprops={"marker": ".", "markersize": 3,
                "markeredgecolor": LIGHT_BLUE}, medianprops={"color": VERMILLION, "linewidth": 1.6}, boxprops=line,
                whiskerprops=line, capprops=line,
            )  # fmt: skip
            axes.set_xlabel(f"residual ({unit})")
            axes.set_xlim(left=0.0)
            axes.grid(visible=False, axis="y")
        panels[0].set_yticks(range(1, len(grouped) + 1), [shortened(name, 24) for name in grouped])
        panels[0].invert_yaxis()

    return svg_figure(draw, 0.9 + 0.27 * len(grouped))


def time_figure(found: ResidualsEvidence) -> SvgFigure:
    """Angles and lengths over time, by sensor; those that are not in the answer as crosses."""
    sensors = list(dict.fromkeys(pair.sensor for pair in found.pairs))
    rasterized = sum(len(pair.times) for pair in found.pairs) > MANY

    def draw(figure: Figure) -> None:
        panels = figure.subplots(2, 1, sharex=True)
        has_removed = False
        for axes, field, unit in zip(panels, ("deg", "mm"), ("degrees", "mm"), strict=True):
            for number, sensor in enumerate(sensors):
                colour, sign = SIGNS[number] if len(sensors) <= len(SIGNS) else SIGNS[0]
                mine = [pair for pair in found.pairs if pair.sensor == sensor]
                inside = np.concatenate([np.array(pair.in_answer, dtype=bool) for pair in mine])
                times, values = (np.concatenate([getattr(p, name) for p in mine]) for name in ("times", field))
                label = shortened(sensor) if len(sensors) <= len(SIGNS) else None
                axes.plot(
                    times[inside], values[inside], sign, color=colour, markersize=2.4, markeredgewidth=0,
                    label=label, rasterized=rasterized,
                )  # fmt: skip
                axes.plot(times[~inside], values[~inside], "x", color=INK, markersize=4, rasterized=rasterized)
                has_removed |= bool((~inside).any())
            _positive_log(axes)
            axes.set_ylabel(f"residual ({unit})")
        panels[1].set_xlabel("time (s)" if found.has_stamps else "place in its pair")
        handles, labels = panels[0].get_legend_handles_labels()
        if has_removed:
            handles.append(panels[0].plot([], [], "x", color=INK, markersize=4)[0])
            labels.append("not in the answer")
        if handles:
            figure.legend(handles, labels, loc="outside upper left", ncols=3, handletextpad=0.2, markerscale=1.8)

    return svg_figure(draw, 3.8)


def _positive_log(axes: Axes) -> None:
    """A logarithmic axis whose labels are plain numbers."""
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_minor_formatter(lambda value, _: "")


def image_figure(cameras: tuple[SeenCamera, ...]) -> SvgFigure:
    """The mean error of corners in each cell of the image, as arrows: what is left of the lens."""

    def draw(figure: Figure) -> None:
        rows = -(-len(cameras) // 2)
        grid = figure.subplots(rows, min(2, len(cameras)), squeeze=False).ravel()
        for axes in grid[len(cameras) :]:
            axes.set_axis_off()
        for axes, camera in zip(grid, cameras, strict=False):
            image_axes(axes, (camera.width, camera.height))
            at, mean = _means(camera)
            largest = float(np.linalg.norm(mean, axis=1).max(initial=0.0))
            times = ARROW * camera.width / CELLS[0] / largest if largest > 0.0 else 1.0
            axes.quiver(
                at[:, 0], at[:, 1], times * mean[:, 0], times * mean[:, 1], angles="xy", scale_units="xy", scale=1.0,
                color=VERMILLION, width=0.008,
            )  # fmt: skip
            axes.set_title(f"{shortened(camera.sensor, 18)}: longest {largest:.2g} px", size=9)

    return svg_figure(draw, 0.3 + 2.1 * -(-len(cameras) // 2))


def _means(camera: SeenCamera) -> tuple[Array, Array]:
    """Middles (n, 2) of cells with corners, and their mean errors (n, 2)."""
    across, down = CELLS if camera.width >= camera.height else CELLS[::-1]
    x, y = np.clip(camera.x, 0.0, camera.width), np.clip(camera.y, 0.0, camera.height)
    count, *errors = (
        np.histogram2d(y, x, (down, across), ((0.0, camera.height), (0.0, camera.width)), weights=weights)[0]
        for weights in (None, camera.dx, camera.dy)
    )
    kept = count >= FEWEST_CORNERS
    middles = (np.argwhere(kept)[:, ::-1] + 0.5) * [camera.width / across, camera.height / down]
    return middles, np.stack(errors, axis=2)[kept] / count[kept, None]


def dependence_figure(found: Dependence) -> SvgFigure:
    """A residual over a coordinate of A, with its mean in ten pieces."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        x, y = np.array(found.x), np.array(found.y)
        axes.plot(x, y, ".", color=LIGHT_BLUE, markersize=4, markeredgewidth=0, rasterized=len(x) > MANY)
        pieces = np.array_split(np.argsort(x), min(10, max(len(x) // 4, 1)))
        axes.plot([x[p].mean() for p in pieces], [y[p].mean() for p in pieces], "-", color=VERMILLION, lw=2)
        axes.set_xlabel(found.by)
        axes.set_ylabel("residual / noise")

    return svg_figure(draw, 2.9)


def normal_figure(found: ResidualsEvidence) -> SvgFigure:
    """Histogram and quantiles of normalised residuals, against those of normal noise."""
    values = np.sort(np.concatenate([np.array(pair.normalised).reshape(-1) for pair in found.pairs]))

    def draw(figure: Figure) -> None:
        left, right = figure.subplots(1, 2)
        edges = np.linspace(-4.0, 4.0, 41)
        left.hist(np.clip(values, -4.0, 4.0), edges, density=True, color=LIGHT_BLUE, alpha=0.7)
        at = np.linspace(-4.0, 4.0, 161)
        left.plot(at, np.exp(-0.5 * at**2) / np.sqrt(2.0 * np.pi), color=VERMILLION, lw=1.8)
        left.set_xlabel("residual / noise")
        left.set_yticks([])
        left.set_title("bars: found, line: normal", size=9)
        shown = values if len(values) <= MANY else values[np.unique(np.linspace(0, len(values) - 1, MANY).astype(int))]
        expected = ndtri((np.searchsorted(values, shown) + 0.5) / len(values))
        limit = 1.05 * float(max(np.abs(shown).max(initial=1.0), np.abs(expected).max(initial=1.0)))
        right.plot([-limit, limit], [-limit, limit], color=VERMILLION, lw=1.2)
        right.plot(expected, shown, ".", color=LIGHT_BLUE, markersize=4, markeredgewidth=0)
        right.set_xlabel("normal quantile")
        right.set_ylabel("found quantile")
        right.set_title("on the line: as normal noise", size=9)

    return svg_figure(draw, 2.9)
