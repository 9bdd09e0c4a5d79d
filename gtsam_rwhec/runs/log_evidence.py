"""The evidence of a calibration from a log, gathered: what its report shows beside the result."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace
from os.path import commonpath
from pathlib import Path

from gtsam_rwhec.errors import TargetError
from gtsam_rwhec.export import copied_texts
from gtsam_rwhec.logs import open_log
from gtsam_rwhec.logs.mcap_reader import Log
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.results import Evidence
from gtsam_rwhec.results.contribution import contribution_of
from gtsam_rwhec.results.derived import derived_of
from gtsam_rwhec.results.evidence import Inputs, input_files, versions
from gtsam_rwhec.results.linear_model import LinearModel, MeasuredRows
from gtsam_rwhec.results.proof_spectrum import proof_of
from gtsam_rwhec.results.residual_evidence import residuals_of
from gtsam_rwhec.results.scene_evidence import SceneEvidence, scene_of
from gtsam_rwhec.results.weak_poses import weak_directions
from gtsam_rwhec.rig import rig_text
from gtsam_rwhec.runs.corner_answer import with_intrinsics
from gtsam_rwhec.runs.log_corners import LogCorners
from gtsam_rwhec.runs.seen_in_log import Pictures, seen_in_log
from gtsam_rwhec.runs.solution_frames import frames_of
from gtsam_rwhec.runs.solving_stage import Calibrated, Solved


def evidence_of_log(
    calibrated: Calibrated, log_path: str | Path, sources: Sequence[Path], pictures: Pictures | None = None
) -> Evidence:
    """What a report shows beside a calibration from a log.

    Parameters
    ----------
    calibrated : Calibrated
    log_path
        The solved log, which has the corners.
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
    model = LinearModel.of(rows_by_final_intrinsics(calibrated, log_path), calibrated.calibration)
    return Evidence(
        derived=derived_of(calibrated.calibration),
        proof=proof_of(calibrated.solution, calibrated.problem),
        weak=weak_directions(calibrated.calibration, rows_of_log(calibrated)),
        scene=_scene(calibrated),
        seen=seen_in_log(calibrated, log_path, pictures),
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


def rows_by_final_intrinsics(calibrated: Solved, log_path: str | Path) -> dict[Pair, MeasuredRows]:
    """The same with poses of targets by the estimated intrinsics, if there are any."""
    with open_log(log_path) as log:
        return rows_of_log(by_estimated_intrinsics(calibrated, log))


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
