"""The report of a calibration from a log: its evidence and its page, written into the output folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.report.report_page import write_html
from gtsam_rwhec.results import write_evidence
from gtsam_rwhec.runs.log_evidence import evidence_of_log
from gtsam_rwhec.runs.run_log import CLEAN_LOG, EVIDENCE_FILE, REPORT_FILE, RESULT_FILE
from gtsam_rwhec.runs.seen_in_log import Pictures
from gtsam_rwhec.runs.solving_stage import Calibrated


def write_report(
    calibrated: Calibrated, out: Path, sources: Sequence[Path], pictures: Pictures, progress: Progress | None = None
) -> list[Path]:
    """Write ``evidence.json`` and ``report.html`` beside ``result.json`` and ``clean.mcap``; return their paths.

    Page and evidence have images if `pictures` may be shown.

    Raises
    ------
    FileFormatError
        A file cannot be written.
    """
    (progress or silent)("writing the report")
    evidence = evidence_of_log(calibrated, out / CLEAN_LOG, sources, pictures)
    write_evidence(evidence, out / EVIDENCE_FILE, out / RESULT_FILE)
    write_html(out / RESULT_FILE, out / REPORT_FILE, evidence, images=pictures.may_show)
    return [out / EVIDENCE_FILE, out / REPORT_FILE]
