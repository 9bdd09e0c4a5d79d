"""The measurements of a calibration as evidence needs them, whether they come from a log or from a problem."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.calibration.calibrated import Calibration
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem


@dataclass(frozen=True, eq=False)
class MeasuredRows:
    """The measurements of a pair, used or not.

    Attributes
    ----------
    A, B : (N, 4, 4)
        T_sensorcarrier_targetcarrier at the final time offsets, and T_sensor_target, metres.
    stamps_ns : (N,) int or None
    covariance : (N, 6, 6) or None
        Of B's right perturbation [omega (rad), v (m)], as it was stated; None where a log has none.
    reasons : tuple of str
        Why a measurement is not used; empty where it is.
    """

    A: Array
    B: Array
    stamps_ns: np.ndarray | None
    covariance: Array | None
    reasons: tuple[str, ...]

    @property
    def used(self) -> np.ndarray:
        """Which measurements are in the answer, (N,) bool."""
        return np.array([not reason for reason in self.reasons], dtype=bool)


#: A measurement of a problem that robust estimation left out.
LEFT_OUT = "farther off than the noise of the others explains"


def measured_rows(problem: Problem, calibration: Calibration) -> Mapping[Pair, MeasuredRows]:
    """The measurements of a problem, in the order of their pairs; motions are left out, for they see no target.

    Raises
    ------
    MeasurementsNotKeptError
        The problem was made with ``keep_measurements=False``.
    """
    rows = {}
    for pair in problem.pairs:
        if pair.is_motion:
            continue
        measured = problem.measurements(pair.target, pair.sensor)
        inlier = calibration.outliers.inliers.get(pair)
        used = np.ones(len(measured.A), dtype=bool) if inlier is None else np.asarray(inlier, dtype=bool)
        rows[pair] = MeasuredRows(
            A=measured.A,
            B=measured.B,
            stamps_ns=measured.stamps_ns,
            covariance=measured.covariance_of_B(),
            reasons=tuple("" if one else LEFT_OUT for one in used),
        )
    return rows
