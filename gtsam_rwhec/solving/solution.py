"""What solving returns: poses, scale, cost, certificate, identifiability, residuals."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam

from gtsam_rwhec.identifiability.verdicts import Identifiability
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.solver.certificate import Certificate
from gtsam_rwhec.solver.residuals import Residual


@dataclass(frozen=True)
class SolvedPart:
    """The frames of one unconnected part (their names) and its own certificate."""

    names: tuple[str, ...]
    certificate: Certificate


@dataclass(frozen=True)
class Solution:
    """A calibration.

    Attributes
    ----------
    X : dict of str to gtsam.Pose3
        T_targetcarrier_target of each target, metres.
    Y : dict of str to gtsam.Pose3
        T_sensorcarrier_sensor of each sensor, metres.
    scale : float or dict of str to float
        t_B = scale * true length: 1 when known, one number when shared, one for each target otherwise (and for
        each sensor with motions of its own).
    scale_mode : "known", "shared" or "per_target"
    cost : float
        J; half a chi-square when the weights are true.
    is_relative : bool
        Whether unit weights were used, which makes costs (and covariances) relative.
    certificate : Certificate
    identifiability : Identifiability
    residuals : dict of (target, sensor) to Residual
    parts : tuple of SolvedPart
        The unconnected parts that were solved apart; one when all is connected.
    """

    X: dict[str, gtsam.Pose3]
    Y: dict[str, gtsam.Pose3]
    scale: float | dict[str, float]
    scale_mode: ScaleMode
    cost: float
    is_relative: bool
    certificate: Certificate
    identifiability: Identifiability
    residuals: dict[Pair, Residual]
    parts: tuple[SolvedPart, ...]
