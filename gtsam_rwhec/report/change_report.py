"""What changed between two calibrations, and whether an old one still holds: on the terminal, and as a page."""

from __future__ import annotations

from pathlib import Path

from gtsam_rwhec.calibration.cross_validation import PredictionError
from gtsam_rwhec.files.terminal_text import rounded, shown
from gtsam_rwhec.files.whole_files import checked_path
from gtsam_rwhec.report.html_page import write_page
from gtsam_rwhec.report.report_blocks import Listing, Page, Paragraph, Section, Table, Words
from gtsam_rwhec.report.terminal_report import print_blocks, print_heading, report_console
from gtsam_rwhec.results.change_test import ChangeTest
from gtsam_rwhec.results.changed_frames import Difference, share_words
from gtsam_rwhec.results.common_quantities import Movement
from gtsam_rwhec.results.verification import Verification

MOVED_HEADINGS = ("mm", "°", "deviations", "chance", "changed")
NUMBER_HEADINGS = ("old", "new", "deviations", "chance", "changed")
CHANGE_LEGEND = (
    "deviations: joint (Mahalanobis) deviations of the difference, correlations counted. chance: how often a "
    "difference is so large without a change, corrected for the number of lines."
)
PIXELS = "old px"
ERROR_HEADINGS = ("n", "old mm", "old°", PIXELS, "best mm", "best°")
ERROR_LEGEND = (
    "old: how far the old poses' predictions are from the new measurements (root mean square; px: median of corners). "
    "best: the same with the poses that fit the new log best: noise."
)
KEEP_IN_MIND = "Keep in mind"


def print_difference(found: Difference) -> None:
    """Print what changed: the verdict first, then how every frame moved, then remarks."""
    _print(changes_page(found), has_tables=not found.is_same)


def print_verification(found: Verification) -> None:
    """Print whether an old calibration still holds: the verdict first, then tables, then remarks."""
    _print(changes_page(found))


def _print(page: Page, *, has_tables: bool = True) -> None:
    console, (verdict, numbers, *remarks) = report_console(), page.sections
    first = verdict.blocks[0]
    assert isinstance(first, Paragraph)
    print_blocks(console, [Paragraph(first.words, page.tone)])
    console.print()
    if has_tables:
        print_blocks(console, numbers.blocks)
    for section in remarks:
        print_heading(console, section.title)
        print_blocks(console, section.blocks)


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
    """The verdict with what moved in words, tables, and what to keep in mind."""
    if isinstance(found, Difference):
        is_bad, is_tested = found.has_changed, found.is_same or found.test is not None
        title, new, tables = "What changed", "NEW", _difference_tables(found)
        remarks = _difference_remarks(found)
    else:
        is_bad, is_tested = not found.holds, not found.unchecked_sensors
        title, new, tables = "Does it still hold?", "The new log", _verification_tables(found)
        remarks = [f"Not checked: {shown(name)}, because {why}." for name, why in found.not_checked.items()]
    remarks += [f"{remark[0].upper()}{remark[1:].removesuffix('.')}." for remark in found.remarks]
    verdict = [Paragraph(str(found), "lead")]
    if compared is not None:
        verdict.append(Paragraph(f"OLD: {shown(compared[0])}. {new}: {shown(compared[1])}.", "note"))
    sentences = _sentences(found)
    said = (Listing(sentences),) if sentences else ()
    return Page(
        title=title,
        tone="bad" if is_bad else "good" if is_tested else "care",
        sections=(
            Section("verdict", "The verdict", (*verdict, *said)),
            Section("moved", "In numbers", tuple(table for table in tables if table.rows)),
            *([Section("remarks", KEEP_IN_MIND, (Listing(tuple(remarks)),))] if remarks else []),
        ),
        made_by="Written by gtsam-rwhec.",
    )


def _sentences(found: Difference | Verification) -> tuple[str, ...]:
    """One for each frame and number, the largest change first."""
    test = found.test
    if test is None:
        return ()
    level = f"{100.0 * test.level:g} %"
    return tuple(
        f"{found.sentence(name)}, {'more' if name in test.changed else 'no more'} than chance at {level}."
        for name in sorted(test.groups, key=lambda name: test.groups[name].corrected)
    )


def _difference_tables(found: Difference) -> tuple[Table, Table]:
    """How every frame moved, and how every number changed."""
    numbers: dict[str, tuple[Words, ...]] = {
        one.name: (f"{one.old:.7g}", f"{one.new:.7g}", *_test_cells(found.test, group))
        for group, ones in found.numbers.items()
        for one in ones
    }
    legend = CHANGE_LEGEND if found.test is not None else ""
    title = "Other numbers that both estimated (the intrinsics of a camera are tested together)"
    return (
        _moved_table("From OLD to NEW, in each frame's own axes", found.movements, found.test, legend),
        Table.of(title, "number", NUMBER_HEADINGS, numbers, legend),
    )


def _difference_remarks(found: Difference) -> list[str]:
    words = [f"Not tested: {name}, because {why}." for name, why in found.not_compared.items()]
    test = found.test
    if test is not None:
        words.append(
            f"All {test.dimension} compared directions together: {test.deviations:.1f} joint deviations, as much "
            f"without a change in {share_words(test.joint_chance)}."
        )
    return words


def _verification_tables(found: Verification) -> tuple[Table, Table]:
    """How far off each sensor's predictions are, and how far each frame seems to have moved."""
    has_pixels = any(check.held_px is not None for check in found.sensors.values())
    errors: dict[str, tuple[Words, ...]] = {
        name: (
            str(check.held.count),
            *_millimetres_and_degrees(check.held),
            *(["-" if check.held_px is None else f"{check.held_px:.2f}"] if has_pixels else []),
            *(("-", "-") if check.best is None else _millimetres_and_degrees(check.best)),
        )
        for name, check in found.sensors.items()
    }
    headings = [heading for heading in ERROR_HEADINGS if has_pixels or heading != PIXELS]
    return (
        Table.of("Predictions of the new measurements", "sensor", headings, errors, ERROR_LEGEND),
        _moved_table("Movement since the old log", found.movements, found.test, CHANGE_LEGEND),
    )


def _millimetres_and_degrees(error: PredictionError) -> tuple[str, str]:
    return f"{error.translation_rms_mm:.3f}", f"{error.rotation_rms_deg:.3f}"


def _moved_table(title: str, movements: dict[str, Movement], test: ChangeTest | None, legend: str) -> Table:
    rows: dict[str, tuple[Words, ...]] = {
        name: (f"{moved.translation_mm:.3f}", f"{moved.rotation_deg:.4f}", *_test_cells(test, name))
        for name, moved in movements.items()
    }
    return Table.of(title, "frame", MOVED_HEADINGS, rows, legend)


def _test_cells(test: ChangeTest | None, name: str) -> tuple[str, str, str]:
    if test is None or name not in test.groups or not test.groups[name].dimension:
        return "-", "-", "not tested"
    group = test.groups[name]
    chance = "< 0.0001" if group.corrected < 1e-4 else rounded(group.corrected)
    return f"{group.deviations:.1f}", chance, "yes" if name in test.changed else "no"
