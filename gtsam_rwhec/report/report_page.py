"""``write_html``: the report of a calibration as one HTML file."""

from __future__ import annotations

import os
import warnings
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.errors import EvidenceWarning, FileFormatError, OptionError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.files.whole_files import checked_path, is_one_of, read_whole, write_atomically
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.report.choices_section import choices_section
from gtsam_rwhec.report.contribution_section import contribution_section
from gtsam_rwhec.report.corners_section import corners_section
from gtsam_rwhec.report.detections_section import seen_section
from gtsam_rwhec.report.determined_section import determines_section
from gtsam_rwhec.report.html_page import write_page
from gtsam_rwhec.report.inputs_section import inputs_section
from gtsam_rwhec.report.proof_section import proof_section
from gtsam_rwhec.report.report_blocks import TONES, Chart, Drawing, Page, Section, every
from gtsam_rwhec.report.residual_section import residuals_section
from gtsam_rwhec.report.scene_section import scene_section
from gtsam_rwhec.report.shown_result import ShownResult
from gtsam_rwhec.report.uncertainty_section import uncertainty_section
from gtsam_rwhec.report.verdict_section import verdict_section
from gtsam_rwhec.results import Evidence, evidence_path, read_evidence
from gtsam_rwhec.results.evidence import checksum
from gtsam_rwhec.results.json_tree import MOST_BYTES
from gtsam_rwhec.results.log_history import LogFields
from gtsam_rwhec.results.result_file import result_json, result_path
from gtsam_rwhec.solver.solution import Solution

#: Rotations whose matrices differ by less are the same.
SAME_ROTATION = 1e-6

#: What a page says once that lacks the parts that need the measurements.
WITHOUT_EVIDENCE = (
    "There is no evidence beside this result, so some parts are left out. gtsam-rwhec calibrate writes it "
    "(evidence.json); in Python give write_html(calibration, path, rw.results.evidence_of(problem, calibration))."
)


def write_html(
    result: Calibration | Refined | Solution | str | Path,
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
    result : Calibration, Refined, Solution or path
        What ``calibrate``, ``refine`` or ``solve`` returned; or a result file, or the output folder that has one. The
        evidence beside a file is read with it.
    path : str or Path
        The HTML file; an existing file is replaced.
    evidence : Evidence, optional
        What ``rw.results.evidence_of(problem, calibration)`` gathered. Sections whose data are missing say so.
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
    OptionError
        `result` or `evidence` is something else, or the evidence is of another calibration.
    """
    path = checked_path(path)
    folder = None if figures is None else checked_path(figures)
    if not isinstance(evidence, Evidence | None):
        raise OptionError(
            f"evidence is {brief(evidence)}; give what rw.results.evidence_of(problem, calibration) returned, or "
            "nothing: the evidence beside a result file is read with it"
        )
    if isinstance(result, Calibration | Refined | Solution):
        shown = ShownResult.of(result_json(result, log), evidence, images=images)
    else:
        file = _result_file(result)
        if is_one_of(path, (file, evidence_path(file))):
            raise FileFormatError(f"{path} is read for the page: give the page another name.")
        shown = read_shown(file, evidence, images=images)
    if evidence is not None and not _is_of(evidence, shown):
        raise OptionError("evidence is of another calibration: it has other frames, or their poses are others")
    page = report_page(shown)
    write_page(page, path)
    if folder is not None:
        write_figures(page, folder)


def write_figures(page: Page, folder: str | Path) -> list[Path]:
    """Write every chart of a page, and the still pictures of its scenes, as NAME.svg and NAME.png, black on white.

    Raises `FileFormatError` if the folder cannot be made, or a file cannot be written.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileFormatError(f"{folder} cannot be made a folder: {error.strerror}.") from error
    written = []
    for block in every(block for section in page.sections for block in section.blocks):
        if isinstance(block, Chart | Drawing):
            figure = block.svg if isinstance(block, Chart) else block.still_svg
            for form in ("svg", "png"):
                path = folder / f"{block.name}.{form}"
                write_atomically(path, figure.file(form))
                written.append(path)
    return written


def _is_of(evidence: Evidence, shown: ShownResult) -> bool:
    """Whether evidence is of the result, by its frames and their rotations; without either there is no telling."""
    if evidence.derived is None or shown.result is None:
        return True
    answer = shown.result.refined or shown.result.solution
    poses = {**answer.Y, **answer.X}
    angles = {each.frame: np.radians(each.rpy_deg) for each in evidence.derived.angles}
    return angles.keys() == poses.keys() and all(
        np.allclose(gtsam.Rot3.RzRyRx(*angles[name]).matrix(), pose.rotation().matrix(), rtol=0.0, atol=SAME_ROTATION)
        for name, pose in poses.items()
    )


def _result_file(result: object) -> Path:
    """The file of a result that is given by its path, or by its folder's."""
    if not isinstance(result, str | os.PathLike):
        raise OptionError(
            f"result is a {type(result).__name__}; give what rw.calibrate returned, or the path of a result file"
        )
    return result_path(checked_path(result))


def read_shown(path: str | Path, evidence: Evidence | None = None, *, images: bool = True) -> ShownResult:
    """A result from its file, or its folder, with the evidence that is beside it.

    Evidence that is damaged, or of another result, is left out with a warning: the result is shown without it.
    """
    path = _result_file(path)
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
        tone=TONES[Verdict(shown.tree["verdict"])],
        sections=sections_of(shown),
        made_by=f"Written by {shown.tree['written_by']}.",
        warnings=shown.warnings or ((WITHOUT_EVIDENCE,) if shown.evidence is None else ()),
    )


#: The functions that make them.
SECTIONS = (
    verdict_section,
    scene_section,
    seen_section,
    determines_section,
    proof_section,
    residuals_section,
    corners_section,
    uncertainty_section,
    contribution_section,
    choices_section,
    inputs_section,
)


def sections_of(shown: ShownResult) -> tuple[Section, ...]:
    """All sections of a result."""
    return tuple(section(shown) for section in SECTIONS)
