"""Whether an old calibration still holds, on the terminal: the verdict, how far off it is, and what to keep in mind."""

from __future__ import annotations

from gtsam_rwhec.calibration.cross_validation import PredictionError
from gtsam_rwhec.files.terminal_text import shown
from gtsam_rwhec.report.change_report import CHANGE_LEGEND, MOVED_HEADINGS, STYLES, moved_cells
from gtsam_rwhec.report.pose_table import FrameTable
from gtsam_rwhec.report.printing import print_heading, print_list, print_sentence, print_tables, report_console
from gtsam_rwhec.results.verification import Verification

ERROR_HEADINGS = ("n", "old mm", "old°", "old px", "best mm", "best°")
PIXELS = "old px"
ERROR_LEGEND = (
    "old: how far the old poses' predictions are from the new measurements (root mean square; px: median of corners). "
    "best: the same with the poses that fit the new log best: noise."
)


def print_verification(found: Verification) -> None:
    """Print whether an old calibration still holds: the verdict first, then tables, then remarks."""
    console = report_console()
    print_sentence(console, str(found), STYLES[not found.holds])
    console.print()
    for table, legend in zip(verification_tables(found), (ERROR_LEGEND, CHANGE_LEGEND), strict=True):
        print_tables(console, [table], legend)
        console.print()
    words = verification_remarks(found)
    if words:
        print_heading(console, "Keep in mind")
        print_list(console, words)


def verification_tables(found: Verification) -> tuple[FrameTable, FrameTable]:
    """How far off each sensor's predictions are, and how far each frame seems to have moved."""
    has_pixels = any(check.held_px is not None for check in found.sensors.values())
    errors = {
        name: (
            str(check.held.count),
            *_millimetres_and_degrees(check.held),
            *(["-" if check.held_px is None else f"{check.held_px:.2f}"] if has_pixels else []),
            *(("-", "-") if check.best is None else _millimetres_and_degrees(check.best)),
        )
        for name, check in found.sensors.items()
    }
    headings = tuple(heading for heading in ERROR_HEADINGS if has_pixels or heading != PIXELS)
    moved = {name: moved_cells(one, found.test, name) for name, one in found.movements.items()}
    return (
        FrameTable("Predictions of the new measurements", "sensor", headings, errors),
        FrameTable("Movement since the old log", "frame", MOVED_HEADINGS, moved),
    )


def _millimetres_and_degrees(error: PredictionError) -> tuple[str, str]:
    return f"{error.translation_rms_mm:.3f}", f"{error.rotation_rms_deg:.3f}"


def verification_remarks(found: Verification) -> list[str]:
    """What to keep in mind."""
    words = [f"Not checked: {shown(name)}, because {why}." for name, why in found.not_checked.items()]
    return [*words, *(f"{remark[0].upper()}{remark[1:].removesuffix('.')}." for remark in found.remarks)]
