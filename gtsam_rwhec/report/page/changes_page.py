"""The page of what changed between two calibrations, and of whether an old one still holds."""

from __future__ import annotations

from pathlib import Path

from gtsam_rwhec.files.terminal_text import shown
from gtsam_rwhec.files.whole_files import checked_path
from gtsam_rwhec.report.change_report import CHANGE_LEGEND, change_tables, remark_sentences
from gtsam_rwhec.report.page.blocks import Block, Listing, Page, Paragraph, Section, Table
from gtsam_rwhec.report.page.html import write_page
from gtsam_rwhec.report.pose_table import FrameTable
from gtsam_rwhec.report.verification_report import ERROR_LEGEND, verification_remarks, verification_tables
from gtsam_rwhec.results.difference import Difference
from gtsam_rwhec.results.verification import Verification

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
