"""``write_html``: the report of a calibration as one HTML file."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

from gtsam_rwhec.calibration.calibrated import Calibration
from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.errors import EvidenceWarning, FileFormatError
from gtsam_rwhec.evidence import Evidence, evidence_path, read_evidence
from gtsam_rwhec.evidence.evidence import checksum
from gtsam_rwhec.files.paths import checked_path
from gtsam_rwhec.files.whole_files import read_whole
from gtsam_rwhec.report.page.blocks import Page
from gtsam_rwhec.report.page.figure_files import write_figures
from gtsam_rwhec.report.page.html import write_page
from gtsam_rwhec.report.page.sections import sections_of
from gtsam_rwhec.report.page.shown_result import ShownResult
from gtsam_rwhec.results.json_text import MOST_BYTES
from gtsam_rwhec.results.log_history import LogFields
from gtsam_rwhec.results.written_result import calibration_json

#: The name of a result in an output folder.
RESULT_FILE = "result.json"
TONES = {Verdict.USE: "good", Verdict.CARE: "care", Verdict.DO_NOT_USE: "bad"}


def write_html(
    result: Calibration | str | Path,
    path: str | Path,
    evidence: Evidence | None = None,
    *,
    log: LogFields | None = None,
    images: bool = True,
    figures: str | Path | None = None,
) -> None:
    """Write the report of a calibration as one HTML file, which needs nothing else and no network.

    Parameters
    ----------
    result : Calibration or path
        What ``calibrate`` returned; or a result file, or the output folder that has one. The evidence beside a file
        is read with it.
    path : str or Path
        The HTML file; an existing file is replaced.
    evidence : Evidence, optional
        What ``rw.evidence.evidence_of(problem, calibration)`` gathered. Sections whose data are missing say so.
    log : LogFields, optional
        What became of the measurements, if a calibration comes from a log.
    images : bool
        Whether the page shows images. False for a page that others may see when the images are confidential.
    figures : str or Path, optional
        A folder, made if it is not there, that gets every figure as NAME.svg and NAME.png, black on white.

    Raises
    ------
    FileFormatError, ResultVersionError
        A file cannot be read or written, or is no result; the message says which.
    """
    path = checked_path(path)
    if isinstance(result, Calibration):
        shown = ShownResult.of(calibration_json(result, log), evidence, images=images)
    else:
        shown = read_shown(result, evidence, images=images)
    page = report_page(shown)
    write_page(page, path)
    if figures is not None:
        write_figures(page, figures)


def read_shown(path: str | Path, evidence: Evidence | None = None, *, images: bool = True) -> ShownResult:
    """A result from its file, or its folder, with the evidence that is beside it.

    Evidence that is damaged, or of another result, is left out with a warning: the result is shown without it.
    """
    path = Path(path)
    if path.is_dir():
        path = path / RESULT_FILE
    content = read_whole(path, MOST_BYTES, "A result was")
    wrong = ""
    beside = evidence_path(path)
    if evidence is None and beside.exists():
        try:
            evidence = read_evidence(beside)
        except FileFormatError as error:
            wrong = f"{error} What it holds is not shown."
        if evidence is not None and evidence.result_sha256 not in ("", checksum(content)):
            evidence = None
            wrong = (
                f"{beside} is the evidence of another result: {path.name} was changed after it was written. What it "
                "holds is not shown. Calibrate again, or put the two files of one calibration together."
            )
    if wrong:
        warnings.warn(wrong, EvidenceWarning, stacklevel=2)
    shown = ShownResult.of(content, evidence, path.name, images=images)
    return replace(shown, warnings=(wrong,)) if wrong else shown


def report_page(shown: ShownResult) -> Page:
    """The page of a result."""
    return Page(
        title="Calibration report",
        tone=TONES[Verdict(shown.tree["verdict"])],  # type: ignore[arg-type]
        sections=sections_of(shown),
        made_by=f"Written by {shown.tree['written_by']}.",
        warnings=shown.warnings,
    )
