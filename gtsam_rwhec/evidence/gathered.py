"""The evidence of a calibration from a problem, gathered."""

from __future__ import annotations

from gtsam_rwhec.calibration.calibrated import Calibration
from gtsam_rwhec.evidence.contribution import contribution_of
from gtsam_rwhec.evidence.derived import derived_of
from gtsam_rwhec.evidence.evidence import Evidence
from gtsam_rwhec.evidence.inputs import Inputs, versions
from gtsam_rwhec.evidence.linear_model import LinearModel
from gtsam_rwhec.evidence.measured import measured_rows
from gtsam_rwhec.evidence.proof import Proof, proof_of
from gtsam_rwhec.evidence.residuals import residuals_of
from gtsam_rwhec.evidence.scene import scene_of_problem
from gtsam_rwhec.evidence.seen_in_problem import seen_in_problem
from gtsam_rwhec.evidence.weak import weak_directions
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import selected


@one_blas_thread()
def evidence_of(problem: Problem, calibration: Calibration, inputs: Inputs | None = None) -> Evidence:
    """What a report shows beside a calibration.

    Parameters
    ----------
    problem : Problem
        What was calibrated, with its measurements.
    calibration : Calibration
        What ``calibrate`` returned for it.
    inputs : Inputs, optional
        The files that the problem was read from; without them only versions are known.

    Raises
    ------
    MeasurementsNotKeptError
        The problem was made with ``keep_measurements=False``.
    """
    inputs = Inputs(files=(), versions=versions()) if inputs is None else inputs
    rows = measured_rows(problem, calibration)
    model = LinearModel.of(rows, calibration)
    return Evidence(
        derived=derived_of(calibration),
        proof=_proof(problem, calibration),
        weak=weak_directions(calibration, rows),
        scene=scene_of_problem(problem, calibration, rows),
        seen=seen_in_problem(problem, calibration.refined, rows, calibration.options.carrier_path),
        residuals=None if model is None else residuals_of(model, calibration),
        contribution=None if model is None else contribution_of(model),
        inputs=inputs.with_options(calibration.options),
    )


def _proof(problem: Problem, calibration: Calibration) -> Proof | None:
    """The proof of the certified solution, with the measurements that it is of."""
    if calibration.solution is None:
        return None
    inliers = calibration.outliers.inliers
    return proof_of(calibration.solution, selected(problem, inliers) if inliers else problem)
