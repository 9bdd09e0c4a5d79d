"""Residuals of an answer in the physical model, pair by pair, from moments.

For the direct form and the inverse form alike, the residuals are R_A t_X + t_A - t_Y - R_Y t_B / alpha and the
difference of R_A R_X and R_Y R_B (eq. 18).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.moments import edge_forms
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.variables import Answer, scales_of


@dataclass(frozen=True)
class Residual:
    """Root mean squares of a pair's residuals, weighted as in the cost.

    Attributes
    ----------
    number_of_measurements : int
    translation_rms_m : float
        Of |R_A t_X + t_A - t_Y - R_Y t_B / scale|, in true metres.
    rotation_rms_rad : float
        Of the angle between R_A R_X and R_Y R_B, in rad.
    """

    number_of_measurements: int
    translation_rms_m: float
    rotation_rms_rad: float


@dataclass(frozen=True)
class PairPoses:
    """An answer, pair by pair: R_X, R_Y (E, 3, 3), t_X, t_Y (E, 3) about the gauge, scale alpha (E,)."""

    R_X: Array
    t_X: Array
    R_Y: Array
    t_Y: Array
    alpha: Array

    @staticmethod
    def of(part: Part, answer: Answer) -> PairPoses:
        """Free frames from the answer, fixed ones from the part."""
        frames = {name: (R, t) for name, R, t in zip(part.free, answer.R, answer.t, strict=True)}
        frames |= {name: (T[:3, :3], T[:3, 3]) for name, T in part.fixed.items()}
        alphas = scales_of(part, answer)
        (R_X, t_X), (R_Y, t_Y) = (
            [np.array(each) for each in zip(*(frames[name] for name in side), strict=True)]
            for side in zip(*part.pairs, strict=True)
        )
        return PairPoses(R_X, t_X, R_Y, t_Y, np.array([alphas[target] for target, _ in part.pairs]))


def costs_of_pairs(part: Part, poses: PairPoses) -> tuple[Array, Array]:
    """J_t and J_R of each pair (E,), eq. 18."""
    E = len(part.pairs)
    x = np.empty((E, 25))  # [alpha t_X, alpha t_Y, alpha, vec R_X, vec R_Y]
    alpha = poses.alpha[:, None]
    x[:, 0:3], x[:, 3:6], x[:, 6] = alpha * poses.t_X, alpha * poses.t_Y, poses.alpha
    x[:, 7:16] = poses.R_X.transpose(0, 2, 1).reshape(E, 9)
    x[:, 16:25] = poses.R_Y.transpose(0, 2, 1).reshape(E, 9)
    translation, rotation = edge_forms(part.moments.translation[:], part.moments.rotation[:], part.moments.kappa)
    J_t = np.einsum("ei,eij,ej->e", x, translation, x)
    J_R = np.einsum("ei,eij,ej->e", x, rotation, x)
    return np.maximum(J_t, 0.0), np.maximum(J_R, 0.0)  # zero may round to a negative number


def residuals_of_pairs(part: Part, poses: PairPoses, J_t: Array, J_R: Array) -> dict[Pair, Residual]:
    """Costs as root mean squares in metres and radians."""
    rms = np.sqrt(2.0 * J_t / part.moments.weight) / np.abs(poses.alpha)
    chord = np.sqrt(2.0 * J_R / part.moments.kappa)  # |R_A R_X - R_Y R_B|_F = sqrt(8) sin(angle / 2)
    angle = 2.0 * np.arcsin(np.minimum(1.0, chord / np.sqrt(8.0)))
    return {
        pair: Residual(int(part.moments.count[e]), float(rms[e]), float(angle[e])) for e, pair in enumerate(part.pairs)
    }
