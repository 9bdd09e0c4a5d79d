"""The solution of a problem: poses, scale, cost, certificate, identifiability, residuals."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
from scipy.special import chdtr, chdtrc

from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.solver.answers import Residual
from gtsam_rwhec.solver.certificate import Certificate
from gtsam_rwhec.solver.identification import Identifiability


@dataclass(frozen=True)
class SolvedPart:
    """The names of the frames of one unconnected part, and the certificate of this part."""

    names: tuple[str, ...]
    certificate: Certificate


@dataclass(frozen=True)
class Solution:
    """A calibration; ``str()`` is a few lines: what is proven, the counts, and the scale.

    Attributes
    ----------
    X : dict of str to gtsam.Pose3
        T_targetcarrier_target of each target, metres.
    Y : dict of str to gtsam.Pose3
        T_sensorcarrier_sensor of each sensor, metres.
    scale : float or dict of str to float
        t_B = scale * true length. It is 1 when known and one number when shared. Else it is one number for each target
        (and for each sensor with motions of its own).
    scale_mode : "known", "shared" or "per_target"
    cost : float
        J; half a chi-square when the weights are true.
    is_relative : bool
        Whether all weights are 1: costs and covariances then have no statistical meaning.
    certificate : Certificate
    identifiability : Identifiability
    residuals : dict of (target, sensor) to Residual
    parts : tuple of SolvedPart
        The unconnected parts, which were solved separately; one part when all frames are connected.
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

    @property
    def counts(self) -> str:
        """The size of the problem: "16 targets, 8 sensors, 73 pairs, 3230 measurements"."""
        measurements = sum(residual.number_of_measurements for residual in self.residuals.values())
        counts = (
            (len(self.X), "target"),
            (len(self.Y), "sensor"),
            (len(self.residuals), "pair"),
            (measurements, "measurement"),
        )
        return ", ".join(f"{number} {word}{'' if number == 1 else 's'}" for number, word in counts)

    def __str__(self) -> str:
        if isinstance(self.scale, dict):
            scale = ", ".join(f"{name} {value:.6g}" for name, value in self.scale.items())
        else:
            scale = f"{self.scale:.6g}"
        return f"{self.certificate}\n{self.counts}\nscale ({self.scale_mode}): {scale}"


#: Residuals may cost this many times what the weights predict. The noise is then larger by the root, 1.4 times.
UNLIKELY = 2.0
#: Residuals may cost this share of what the weights predict. The noise is then smaller by the root, half as large.
FAR_SMALLER = 0.25
#: With few degrees of freedom, chance often makes such a cost. Its probability must be smaller than this.
CHANCE = 1e-3


def contradicted_by(cost: float, degrees_of_freedom: int) -> float | None:
    """The cost over its expectation with true weights. It is None where the cost is not surely too large.

    With true weights, twice the cost is a chi-square with ``degrees_of_freedom``, equations minus unknowns.
    """
    if degrees_of_freedom <= 0:
        return None
    ratio = cost / (0.5 * degrees_of_freedom)
    return ratio if ratio > UNLIKELY and chdtrc(degrees_of_freedom, 2.0 * cost) < CHANCE else None


def overstated_by(cost: float, degrees_of_freedom: int) -> float | None:
    """The cost over its expectation, where it is surely far too small: the noise that was stated is too large."""
    if degrees_of_freedom <= 0:
        return None
    ratio = cost / (0.5 * degrees_of_freedom)
    return ratio if ratio < FAR_SMALLER and chdtr(degrees_of_freedom, 2.0 * cost) < CHANCE else None
