"""The report of a refinement from corners: errors in pixels, models tried, intrinsics, boards, consequences."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from rich.console import Console

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.files.terminal_text import natural_key, rounded
from gtsam_rwhec.fitting.corners_as_refined import (
    CARRIER_RAD,
    CENTRE_PX,
    FOCAL_SHARE,
    OF_CARRIERS,
    centre_causes,
    focal_cause,
)
from gtsam_rwhec.fitting.projection_uncertainty import uneven_words
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.fitting.reprojection_record import Consequence, Intrinsics, Reprojection
from gtsam_rwhec.report.pose_table import FrameTable
from gtsam_rwhec.report.printing import print_heading, print_list, print_sentence, print_tables, report_console

ERRORS_LEGEND = (
    "rms: root mean square of the corners that count, along each axis. hold-out: root mean square length of the error "
    "in images that were left out of the calibration, on the target and in the image: so well are images predicted. "
    "expected: what it is if the model is right; far larger errors show what the model lacks."
)
INTRINSICS_LEGEND = (
    "±: one standard deviation; of what was stated, as it counted. told by: the images, or only what was stated, where "
    "the images do not determine a parameter; nothing, where none was stated."
)
CONSEQUENCES_LEGEND = (
    "How far each pose would be off if an error stayed in the answer: for those who keep their own intrinsics, or take "
    "the carriers' poses as exact. Millimetres / degrees; of A's errors, one standard deviation along the worst axis."
)
WORST_CAMERA = "Of intrinsics: those of the one camera whose error moves the pose most."
#: Left-out images that are predicted so many times worse than expected show that the model lacks something.
UNEXPECTED = 1.5
#: So many cameras have columns of their own in the table of consequences.
MOST_CAMERAS = 4
#: Cells of a table with nothing to say.
NONE = "-"


def print_corners(refined: RefinedPoses, console: Console | None = None) -> None:
    """Print what a refinement from corners found besides poses; nothing where it is from poses.

    Parameters
    ----------
    refined : RefinedPoses
        A refinement from corners, also as a result file has it.
    console : rich.console.Console, optional
        Where to print; standard output by default.

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
    console = report_console() if console is None else console
    found = refined.reprojection
    if found is None:
        return
    print_heading(console, "Corners and intrinsics")
    print_sentence(console, str(found))
    print_tables(console, [errors_table(found)], ERRORS_LEGEND)
    for sentence in unexpected_sentences(found):
        print_sentence(console, sentence, "yellow")
    console.print()
    if found.tried:
        print_sentence(console, "Models that were tried, by their error in images that were left out:")
        print_list(console, map(str, found.tried))
    print_sentence(console, "Intrinsics and boards:")
    print_list(console, intrinsics_sentences(refined))
    print_list(console, (f"{name}: {board}." for name, board in found.boards.items()))
    console.print()
    print_tables(console, [intrinsics_table(refined)], INTRINSICS_LEGEND)
    table = consequences_table(found, list(refined.intrinsics))
    if table.rows:
        legend = CONSEQUENCES_LEGEND
        if len(_cameras(found, list(refined.intrinsics))) > MOST_CAMERAS:
            legend = f"{legend} {WORST_CAMERA}"
        console.print()
        print_tables(console, [table], legend)


def errors_table(found: Reprojection) -> FrameTable:
    """Errors of corners by sensor."""
    rows = {}
    for name in sorted(found.sensors, key=natural_key):
        of = found.sensors[name]
        rows[name] = (
            str(of.images),
            str(of.corners),
            str(of.left_out),
            f"{of.rms_px:.3f}",
            *(NONE if value is None else f"{value:.3f}" for value in (of.held_out_mm, of.held_out_px, of.expected_px)),
        )
    headings = ("images", "corners", "left out", "rms px", "hold-out mm", "hold-out px", "expected px")
    return FrameTable("Errors of corners", "sensor", headings, rows)


def unexpected_sentences(found: Reprojection) -> list[str]:
    """Of sensors whose left-out images are predicted worse than the covariances expect: these are too small."""
    sentences = []
    for name, of in found.sensors.items():
        times = (of.held_out_px or 0.0) / (of.expected_px or np.inf)
        if times > UNEXPECTED:
            sentences.append(
                f"{name}: images that were left out are predicted {rounded(times)} times worse than expected. The "
                "arm's poses, the target or the lens have errors that the model lacks; the standard deviations of the "
                "intrinsics come from the noise alone, and are too small by as much or more."
            )
    return sentences


def intrinsics_sentences(refined: RefinedPoses) -> list[str]:
    """Of each camera's intrinsics: how they were stated, whether the images agree, what they do not determine.

    And where the camera was calibrated from a part of its image.
    """
    sentences = [f"{_owners(name, of)}: {of}." for name, of in _by_camera(refined.intrinsics)]
    sensors = {} if refined.reprojection is None else refined.reprojection.sensors
    for name, of in refined.intrinsics.items():
        if name in sensors:
            uneven = uneven_words(of.projection_px, sensors[name].regions_px)
            sentences += [f"{name}: {uneven}."] if uneven else []
    exact = [name for name in refined.Y if name not in refined.intrinsics]
    if exact:
        sentences.append(f"{', '.join(exact)}: the intrinsics count as exact, as stated; they were not estimated.")
    return sentences


def intrinsics_table(refined: RefinedPoses) -> FrameTable:
    """Every parameter of every camera, beside what was stated."""
    rows = {}
    decimals_of: dict[str, int] = {}
    for of in refined.intrinsics.values():
        for parameter, deviation in zip(of.names, of.standard_deviations, strict=True):
            kind = _kind(parameter)
            decimals_of[kind] = max(decimals_of.get(kind, 0), _decimals(deviation))
    for name, of in _by_camera(refined.intrinsics):
        for parameter, value, deviation, stated, known in zip(
            of.names, of.values, of.standard_deviations, of.stated, of.stated_deviations, strict=True
        ):
            decimals = decimals_of[_kind(parameter)]
            was_stated = of.stated_as != "unknown"
            rows[f"{name} {parameter}"] = (
                f"{value:.{decimals}f}",
                f"{deviation:.{decimals}f}",
                *(f"{number:.{decimals}f}" if was_stated else NONE for number in (stated, known)),
                _told_by(parameter, of),
            )
    return FrameTable("Intrinsics", "parameter", ("found", "±", "stated", "±", "told by"), rows)


def _kind(parameter: str) -> str:
    """Parameters whose numbers have as many decimals, so that their points line up."""
    return "pixels" if parameter in ("fx", "fy", "cx", "cy") else "coefficients"


def _told_by(parameter: str, of: Intrinsics) -> str:
    if of.stated_as != "exact" and parameter not in of.held_by_prior:
        return "images"
    return "nothing" if of.stated_as == "unknown" else "stated"


def consequences_table(found: Reprojection, sensors: list[str]) -> FrameTable:
    """How far errors of kept intrinsics, and of A, would move each frame: a row for each frame.

    Few cameras have columns each; of many cameras, the one counts whose error moves the frame most.
    """
    by = {(of.frame, OF_CARRIERS if of.cause.startswith(OF_CARRIERS) else of.cause): of for of in found.consequences}
    cameras = _cameras(found, sensors)
    groups = [[name] for name in cameras] if len(cameras) <= MOST_CAMERAS else [cameras]
    columns: dict[str, list[str]] = {}
    for group in groups:
        of = f", {group[0]}" if len(groups) > 1 else ""
        columns[f"{CENTRE_PX:g} px of c{of}"] = [cause for name in group for cause in centre_causes(name)]
        columns[f"{FOCAL_SHARE:.1%} of f{of}"] = [focal_cause(name) for name in group]
    columns[f"{math.degrees(CARRIER_RAD):.1f}° of A"] = [OF_CARRIERS]
    rows = {
        frame: tuple(_worst([by[frame, c] for c in causes if (frame, c) in by]) for causes in columns.values())
        for frame in dict.fromkeys(of.frame for of in found.consequences)
    }
    return FrameTable("What errors that stay would do", "frame", tuple(columns), rows)


def _worst(every: list[Consequence]) -> str:
    """Millimetres / degrees."""
    if not every:
        return NONE
    return f"{max(of.translation_mm for of in every):.2f} / {max(of.rotation_deg for of in every):.3f}"


def _cameras(found: Reprojection, sensors: list[str]) -> list[str]:
    """The sensors whose intrinsics are among the causes."""
    causes = {of.cause for of in found.consequences}
    return [name for name in sensors if focal_cause(name) in causes]


def _by_camera(intrinsics: dict[str, Intrinsics]) -> Iterator[tuple[str, Intrinsics]]:
    """Sensors that share a camera are named once, by the first of them."""
    told: set[str] = set()
    for name in sorted(intrinsics, key=natural_key):
        if name not in told:
            told |= {name, *intrinsics[name].shared_with}
            yield name, intrinsics[name]


def _owners(name: str, of: Intrinsics) -> str:
    return ", ".join((name, *sorted(of.shared_with, key=natural_key)))


def _decimals(deviation: float) -> int:
    """So many that the deviation has two digits; pixels have no more than four, coefficients no more than six."""
    if not (math.isfinite(deviation) and deviation > 0.0):
        return 4
    return int(np.clip(1 - math.floor(math.log10(deviation)), 0, 6))
