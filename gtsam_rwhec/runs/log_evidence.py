"""The evidence of a calibration from a log, gathered: what its report shows beside the result."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace
from os.path import commonpath
from pathlib import Path

from gtsam_rwhec.errors import TargetError
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.logs.mcap_reader import Log
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.report.html_page import write_page
from gtsam_rwhec.report.report_page import report_page
from gtsam_rwhec.report.shown_result import ShownResult
from gtsam_rwhec.results import Evidence, write_evidence
from gtsam_rwhec.results.contribution import contribution_of
from gtsam_rwhec.results.derived import derived_of
from gtsam_rwhec.results.evidence import Inputs, checksum, input_files, versions
from gtsam_rwhec.results.linear_model import LinearModel, MeasuredRows
from gtsam_rwhec.results.proof_spectrum import proof_of
from gtsam_rwhec.results.residual_evidence import residuals_of
from gtsam_rwhec.results.scene_evidence import SceneEvidence, scene_of
from gtsam_rwhec.results.weak_poses import weak_directions
from gtsam_rwhec.rig import rig_text
from gtsam_rwhec.rig.exported_files import copied_texts
from gtsam_rwhec.runs.corner_answer import with_intrinsics
from gtsam_rwhec.runs.log_corners import LogCorners
from gtsam_rwhec.runs.run_log import EVIDENCE_FILE, REPORT_FILE, RESULT_FILE
from gtsam_rwhec.runs.seen_in_log import Pictures, seen_in_log
from gtsam_rwhec.runs.solution_frames import frames_of
from gtsam_rwhec.runs.solving_stage import Calibrated, Solved


def evidence_of_log(
    calibrated: Calibrated, log: Log, sources: Sequence[Path], pictures: Pictures | None = None
) -> Evidence:
    """What a report shows beside a calibration from a log.

    Parameters
    ----------
    calibrated : Calibrated
    log : Log
        The cleaned log, which has the corners.
    sources : sequence of Path
        The files that the measurements come from.
    pictures : Pictures, optional
        Where images are; without it the evidence has none.
    """
    inputs = Inputs(
        files=input_files(sources),
        command=_command(sources),
        versions=versions(),
        rig_file=rig_text(calibrated.rig),
        copies=copied_texts(frames_of(calibrated)),
    )
    model = LinearModel.of(rows_of_log(by_estimated_intrinsics(calibrated, log)), calibrated.calibration)
    return Evidence(
        derived=derived_of(calibrated.calibration),
        proof=proof_of(calibrated.solution, calibrated.problem),
        weak=weak_directions(calibrated.calibration, rows_of_log(calibrated)),
        scene=_scene(calibrated),
        seen=seen_in_log(calibrated, log, pictures),
        residuals=None if model is None else residuals_of(model, calibrated.calibration),
        contribution=None if model is None else contribution_of(model),
        inputs=inputs.with_options(calibrated.calibration.options),
    )


def _scene(calibrated: Calibrated) -> SceneEvidence | None:
    """The rig in space, with its boards as the rig file states them."""
    rig = calibrated.rig
    names = rig.carriers.sensors, rig.carriers.targets
    targets = {target.name: target for target in rig.target_list}
    return scene_of(calibrated.calibration, rows_of_log(calibrated), names, calibrated.cameras, targets)


def rows_of_log(calibrated: Solved) -> dict[Pair, MeasuredRows]:
    """The measurements of a log, used or not, in the order of its pairs."""
    return {
        pair: MeasuredRows(one.A, one.B, one.stamps_ns, one.covariance, one.reasons)
        for pair, one in calibrated.pairs.items()
    }


def write_report(
    calibrated: Calibrated,
    log: Log,
    out: Path,
    sources: Sequence[Path],
    pictures: Pictures,
    result: bytes,
    progress: Progress | None = None,
) -> None:
    """Write ``evidence.json`` and ``report.html`` of a calibration from a log, whose ``result.json`` is `result`.

    Page and evidence have images if `pictures` may be shown.

    Raises
    ------
    FileFormatError
        A file cannot be written.
    """
    (progress or silent)("writing the report")
    evidence = evidence_of_log(calibrated, log, sources, pictures)
    evidence = evidence.model_copy(update={"result_sha256": checksum(result)})
    write_evidence(evidence, out / EVIDENCE_FILE)
    shown = ShownResult.of(result, evidence, RESULT_FILE, images=pictures.may_show)
    write_page(report_page(shown), out / REPORT_FILE)


def by_estimated_intrinsics(solved: Solved, log: Log) -> Solved:
    """The same with poses of targets by the estimated intrinsics, if there are any; the log has those by the stated."""
    refined = solved.refined
    if refined.reprojection is None:
        return solved
    cameras = {**solved.cameras, **{name: one.camera for name, one in refined.intrinsics.items()}}
    corners = LogCorners.of(log, solved.rig, cameras)
    try:
        pairs = with_intrinsics(solved.pairs, corners, cameras, refined.X, refined.Y, refined.reprojection.corner_px)
    except TargetError:  # a bundle that is not flat has no pose by the corners of one image
        return solved
    return replace(solved, pairs=pairs)


def _command(sources: Sequence[Path]) -> str:
    """The command that makes the calibration again, with the rig file of this record as rig.yaml."""
    if not sources:
        return ""
    source = sources[0] if len(sources) == 1 else Path(commonpath([path.parent for path in sources]))
    return shlex.join(["gtsam-rwhec", "calibrate", source.name, "--rig", "rig.yaml", "-o", "output"])
