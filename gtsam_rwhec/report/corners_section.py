"""What a refinement from corners found: errors in pixels, models tried, intrinsics, boards, and where they are sure."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.files.terminal_text import natural_key, rounded
from gtsam_rwhec.fitting.projection_uncertainty import uneven_words
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.fitting.reprojection_record import Intrinsics, Regions, Reprojection
from gtsam_rwhec.report.figures import GREY, INK, LIGHT_BLUE, SvgFigure, image_axes, shortened, svg_figure
from gtsam_rwhec.report.report_blocks import Block, Chart, Listing, Paragraph, Section, Table, Words
from gtsam_rwhec.report.shown_result import ShownResult
from gtsam_rwhec.report.terminal_report import print_sections, report_console

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TITLE = "Corners and intrinsics"
ERRORS_LEGEND = (
    "rms: root mean square of the corners that count, along each axis. hold-out: root mean square length of the error "
    "in images that were left out of the calibration, on the target and in the image: so well are images predicted. "
    "expected: what it is if the model is right; far larger errors show what the model lacks."
)
INTRINSICS_LEGEND = (
    "±: one standard deviation; of what was stated, as it counted. told by: the images, or only what was stated, where "
    "the images do not determine a parameter; nothing, where none was stated; held: the parameter is not free, since "
    "images that were left out are predicted as well without it."
)
#: Left-out images that are predicted so many times worse than expected show that the model lacks something.
UNEXPECTED = 1.5
#: So many cameras are drawn.
MOST_CAMERAS = 8
#: Cells of a table with nothing to say.
NONE = "-"


def corners_section(shown: ShownResult) -> Section:
    """The section; where the answer is from poses, why it is missing."""
    refined = None if shown.result is None else shown.result.refined
    if refined is None or refined.reprojection is None:
        why = "the answer is from the poses of targets: intrinsics by which these were measured count as exact."
        return Section("corners", TITLE, missing=why)
    return Section("corners", TITLE, tuple(_blocks(refined, refined.reprojection)))


def print_corners(refined: RefinedPoses, console: Console | None = None) -> None:
    """Print what a refinement from corners found besides poses; nothing where it is from poses.

    Parameters
    ----------
    refined : RefinedPoses
        A refinement from corners, also as a result file has it.

    Raises
    ------
    OptionError
        It is no such refinement.
    """
    if not isinstance(refined, RefinedPoses):
        raise OptionError(
            f"print_corners: this is a {type(refined).__name__}; give what rw.refine(problem, solution, "
            'rw.RefineOptions(observations="corners")) returned, `refined` of rw.calibrate, or that of a '
            "result file. Of rw.refine_corners and rw.calibrate_corners, print(result) says the main figures"
        )
    if refined.reprojection is not None:
        blocks = tuple(_blocks(refined, refined.reprojection))
        print_sections(report_console() if console is None else console, [Section("corners", TITLE, blocks)])


def _blocks(refined: RefinedPoses, found: Reprojection) -> Iterator[Block]:
    yield Paragraph(str(found))
    yield errors_table(found)
    yield from (Paragraph(words, "care") for words in unexpected_sentences(found))
    if found.tried:
        yield Paragraph("Models that were tried, by their error in images that were left out:")
        yield Listing(tuple(map(str, found.tried)))
    yield Paragraph("Intrinsics and boards:")
    yield Listing((*intrinsics_sentences(refined), *(f"{name}: {board}." for name, board in found.boards.items())))
    yield intrinsics_table(refined)
    cameras = {name: of for name, of in list(refined.intrinsics.items())[:MOST_CAMERAS] if of.projection_px}
    if cameras:
        yield Chart(
            "intrinsics",
            "Where each lens is known",
            "Each camera's image by parts. Left: how sure projections of single points are, one standard deviation, "
            "pixels. Right: root mean square errors of corners in images that were left out, pixels.",
            _regions_figure(cameras, found),
        )


def errors_table(found: Reprojection) -> Table:
    """Errors of corners by sensor."""
    rows: dict[str, tuple[Words, ...]] = {}
    for name in sorted(found.sensors, key=natural_key):
        of = found.sensors[name]
        left_out = (of.held_out_mm, of.held_out_px, of.expected_px)
        rows[name] = (
            str(of.images), str(of.corners), str(of.left_out), f"{of.rms_px:.3f}",
            *(NONE if value is None else f"{value:.3f}" for value in left_out),
        )  # fmt: skip
    headings = ("images", "corners", "left out", "rms px", "hold-out mm", "hold-out px", "expected px")
    return Table.of("Errors of corners", "sensor", headings, rows, ERRORS_LEGEND)


def unexpected_sentences(found: Reprojection) -> list[str]:
    """Name sensors whose left-out images are predicted worse than the covariances expect: these are too small."""
    return [
        f"{name}: images that were left out are predicted {rounded(of.held_out_px / of.expected_px)} times worse than "
        "expected. The arm's poses, the target or the lens have errors that the model lacks; the standard deviations "
        "of the intrinsics come from the noise alone, and are too small by as much or more."
        for name, of in found.sensors.items()
        if of.held_out_px and of.expected_px and of.held_out_px > UNEXPECTED * of.expected_px
    ]


def intrinsics_sentences(refined: RefinedPoses) -> list[str]:
    """For each camera's intrinsics: how they were stated, whether the images agree, what they do not determine.

    And where the camera was calibrated from a part of its image.
    """
    sentences = [
        f"{', '.join((name, *sorted(of.shared_with, key=natural_key)))}: {of}."
        for name, of in _by_camera(refined.intrinsics)
    ]
    sensors = {} if refined.reprojection is None else refined.reprojection.sensors
    for name, of in refined.intrinsics.items():
        uneven = uneven_words(of.projection_px, sensors[name].regions_px) if name in sensors else ""
        sentences += [f"{name}: {uneven}."] if uneven else []
    exact = [name for name in refined.Y if name not in refined.intrinsics]
    if exact:
        sentences.append(f"{', '.join(exact)}: the intrinsics count as exact, as stated; they were not estimated.")
    return sentences


def intrinsics_table(refined: RefinedPoses) -> Table:
    """Every parameter of every camera, beside what was stated."""
    every = [pair for of in refined.intrinsics.values() for pair in zip(of.names, of.standard_deviations, strict=True)]
    decimals_of = {
        is_pixels: max((_decimals(d) for name, d in every if _is_pixels(name) == is_pixels), default=0)
        for is_pixels in (True, False)
    }
    rows: dict[str, tuple[Words, ...]] = {}
    for name, of in _by_camera(refined.intrinsics):
        for parameter, *numbers in zip(
            of.names, of.values, of.standard_deviations, of.stated, of.stated_deviations, strict=True
        ):
            cells = [f"{number:.{decimals_of[_is_pixels(parameter)]}f}" for number in numbers]
            if of.stated_as == "unknown":
                cells[2:] = [NONE, NONE]
            if parameter in of.not_free:
                cells[1] = cells[3] = NONE
            rows[f"{name} {parameter}"] = (*cells, _told_by(parameter, of))
    headings = ("found", "±", "stated", "±", "told by")
    return Table.of("Intrinsics", "parameter", headings, rows, INTRINSICS_LEGEND)


def _is_pixels(parameter: str) -> bool:
    """Whether a parameter is in pixels; those of a kind have as many decimals, so that their points line up."""
    return parameter in ("fx", "fy", "cx", "cy")


def _told_by(parameter: str, of: Intrinsics) -> str:
    if parameter in of.not_free:
        return "held"
    if of.stated_as != "exact" and parameter not in of.held_by_prior:
        return "images"
    return "nothing" if of.stated_as == "unknown" else "stated"


def _by_camera(intrinsics: dict[str, Intrinsics]) -> Iterator[tuple[str, Intrinsics]]:
    """Sensors that share a camera are named once, by the first of them."""
    told: set[str] = set()
    for name in sorted(intrinsics, key=natural_key):
        if name not in told:
            told |= {name, *intrinsics[name].shared_with}
            yield name, intrinsics[name]


def _decimals(deviation: float) -> int:
    """So many that the deviation has two digits."""
    if not (math.isfinite(deviation) and deviation > 0.0):
        return 4
    return int(np.clip(1 - math.floor(math.log10(deviation)), 0, 6))


def _regions_figure(cameras: dict[str, Intrinsics], found: Reprojection) -> SvgFigure:
    tallest = min(max(of.height / of.width for of in cameras.values()), 1.5)

    def draw(figure: Figure) -> None:
        rows = figure.subplots(len(cameras), 2, squeeze=False)
        for (left, right), (name, of) in zip(rows, cameras.items(), strict=True):
            sensor = found.sensors.get(name)
            _draw_regions(left, of, of.projection_px, f"{shortened(name, 16)}: projections, px")
            _draw_regions(right, of, () if sensor is None else sensor.regions_px, "left-out images, px")

    return svg_figure(draw, len(cameras) * (0.45 + 2.5 * tallest))


def _draw_regions(axes: Axes, of: Intrinsics, regions: Regions, title: str) -> None:
    """A number in each part of the image; shaded, the more the larger it is."""
    image_axes(axes, (of.width, of.height))
    axes.set(xticks=[], yticks=[])
    axes.set_title(title if regions else "no images were left out", size=9)
    largest = max((px for row in regions for px in row if px is not None), default=0.0) or 1.0
    for i, row in enumerate(regions):
        across, down = of.width / len(row), of.height / len(regions)
        for j, px in enumerate(row):
            left, top = j * across - 0.5, i * down - 0.5
            shade = 0.0 if px is None else 0.1 + 0.6 * px / largest
            axes.fill_between([left, left + across], top, top + down, color=LIGHT_BLUE, alpha=shade, lw=0)
            words, colour = ("no corner", GREY) if px is None else (f"{px:.2g}", INK)
            axes.text(left + 0.5 * across, top + 0.5 * down, words, ha="center", va="center", color=colour, size=9)
