"""What changed between two calibrations, on the terminal: the verdict, a table, and what to keep in mind."""

from __future__ import annotations

from pathlib import Path

from gtsam_rwhec.calibration.cross_validation import PredictionError
from gtsam_rwhec.files.terminal_text import rounded, shown
from gtsam_rwhec.files.whole_files import checked_path
from gtsam_rwhec.report.html_page import write_page
from gtsam_rwhec.report.pose_table import FrameTable
from gtsam_rwhec.report.printing import print_heading, print_list, print_sentence, print_tables, report_console
from gtsam_rwhec.report.report_blocks import Block, Listing, Page, Paragraph, Section, Table
from gtsam_rwhec.results.change_test import ChangeTest
from gtsam_rwhec.results.common_quantities import Movement
from gtsam_rwhec.results.difference import Difference, share_words
from gtsam_rwhec.results.verification import Verification

MOVED_HEADINGS = ("mm", "°", "deviations", "chance", "changed")
NUMBER_HEADINGS = ("old", "new", "deviations", "chance", "changed")
CHANGE_LEGEND = (
    "deviations: joint (Mahalanobis) deviations of the difference, correlations counted. chance: how often a "
    "difference is so large without a change, corrected for the number of lines."
)
#: Green where nothing changed, red where something did, yellow where nothing was tested.
STYLES = {False: "bold green", True: "bold red", None: "bold yellow"}


def print_difference(found: Difference) -> None:
    """Print what changed: the verdict first, then how every frame moved, then remarks."""
    console = report_console()
    tested = None if found.test is None and not found.is_same else found.has_changed
    print_sentence(console, str(found), STYLES[tested])
    console.print()
    if not found.is_same:
        print_tables(console, change_tables(found), CHANGE_LEGEND if found.test is not None else "")
    words = list(remark_sentences(found))
    if words:
        print_heading(console, "Keep in mind")
        print_list(console, words)


def change_tables(found: Difference) -> tuple[FrameTable, FrameTable]:
    """How every frame moved, and how every number changed."""
    frames = {name: moved_cells(moved, found.test, name) for name, moved in found.movements.items()}
    numbers = {
        one.name: (f"{one.old:.7g}", f"{one.new:.7g}", *_test_cells(found.test, group))
        for group, ones in found.numbers.items()
        for one in ones
    }
    return (
        FrameTable("From OLD to NEW, in each frame's own axes", "frame", MOVED_HEADINGS, frames),
        FrameTable(
            "Other numbers that both estimated (the intrinsics of a camera are tested together)",
            "number",
            NUMBER_HEADINGS,
            numbers,
        ),
    )


def moved_cells(moved: Movement, test: ChangeTest | None, name: str) -> tuple[str, ...]:
    """The cells of a frame under ``MOVED_HEADINGS``."""
    return f"{moved.translation_mm:.3f}", f"{moved.rotation_deg:.4f}", *_test_cells(test, name)


def remark_sentences(found: Difference) -> list[str]:
    """What to keep in mind."""
    words = [f"Not tested: {name}, because {why}." for name, why in found.not_compared.items()]
    test = found.test
    if test is not None:
        words.append(
            f"All {test.dimension} compared directions together: {test.deviations:.1f} joint deviations, as much "
            f"without a change in {share_words(test.joint_chance)}."
        )
    return [*words, *(f"{remark[0].upper()}{remark[1:].removesuffix('.')}." for remark in found.remarks)]


def _test_cells(test: ChangeTest | None, name: str) -> tuple[str, str, str]:
    if test is None or name not in test.groups or not test.groups[name].dimension:
        return "-", "-", "not tested"
    group = test.groups[name]
    chance = "< 0.0001" if group.corrected < 1e-4 else rounded(group.corrected)
    return f"{group.deviations:.1f}", chance, "yes" if name in test.changed else "no"


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


MADE_BY = "Written by gtsam-rwhec."


def write_changes(
    found: Difference | Verification, path: str | Path, compared: tuple[object, object] | None = None
) -> None:
    """Write what changed, or whether a calibration still holds, as one HTML file that needs no network.

    Parameters
    ----------
    found : Difference or Verification
    path : str or Path
        The HTML file; an existing file is replaced.
    compared : two names or paths, optional
        What was compared, old first: the page says so.

    Raises
    ------
    FileFormatError
        The file cannot be written.
    """
    write_page(changes_page(found, compared), checked_path(path))


def changes_page(found: Difference | Verification, compared: tuple[object, object] | None = None) -> Page:
    """The page: the verdict with what moved in words, tables, and what to keep in mind."""
    if isinstance(found, Difference):
        is_bad, is_tested = found.has_changed, found.is_same or found.test is not None
        title, tables, remarks = "What changed", change_tables(found), remark_sentences(found)
        legends = (CHANGE_LEGEND if found.test is not None else "",) * 2
    else:
        is_bad, is_tested = not found.holds, not found.unchecked_sensors
        title, tables, remarks = "Does it still hold?", verification_tables(found), verification_remarks(found)
        legends = ERROR_LEGEND, CHANGE_LEGEND
    verdict: list[Block] = [Paragraph(str(found), "lead")]
    if compared is not None:
        new = "NEW" if isinstance(found, Difference) else "The new log"
        verdict.append(Paragraph(f"OLD: {shown(compared[0])}. {new}: {shown(compared[1])}.", "note"))
    sentences = _sentences(found)
    if sentences:
        verdict.append(Listing(tuple(sentences)))
    return Page(
        title=title,
        tone="bad" if is_bad else "good" if is_tested else "care",
        sections=(
            Section("verdict", "The verdict", tuple(verdict)),
            Section(
                "moved",
                "In numbers",
                tuple(_block(*each) for each in zip(tables, legends, strict=True) if each[0].rows),
            ),
            *([Section("remarks", "Keep in mind", (Listing(tuple(remarks)),))] if remarks else []),
        ),
        made_by=MADE_BY,
    )


def _block(table: FrameTable, legend: str) -> Table:
    rows = tuple((shown(name), *cells) for name, cells in table.rows.items())
    return Table(table.title, (table.kind, *table.headings), rows, legend)


def _sentences(found: Difference | Verification) -> list[str]:
    """One for each frame and number, the largest change first."""
    test = found.test
    if test is None:
        return []
    level = f"{100.0 * test.level:g} %"
    return [
        f"{found.sentence(name)}, {'more' if name in test.changed else 'no more'} than chance at {level}."
        for name in sorted(test.groups, key=lambda name: test.groups[name].corrected)
    ]
