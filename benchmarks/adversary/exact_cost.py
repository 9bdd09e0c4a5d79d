"""The documented cost in fractions, measurement after measurement: nothing is rounded, and nothing shared."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from stated_cost import Poses, Rows

Array = np.ndarray


def fractions(array: Array) -> Array:
    """An array of doubles as fractions, exactly."""
    result = np.empty(np.shape(array), dtype=object)
    result.ravel()[:] = [Fraction(float(value)) for value in np.ravel(array)]
    return result


@dataclass(frozen=True)
class RationalPoses:
    """An answer in fractions: R (3, 3) and t (3,) by frame, alpha by owner."""

    R: list[Array]
    t: list[Array]
    alpha: dict[str, Fraction]

    @staticmethod
    def of(poses: Poses) -> RationalPoses:
        alpha = {name: Fraction(value) for name, value in poses.alpha.items()}
        return RationalPoses(list(fractions(poses.R)), list(fractions(poses.t)), alpha)


def exact_cost(rows: Rows, form: str, centre: Array, answer: RationalPoses) -> Fraction:
    """The documented formula in fractions, one measurement after another."""
    total = Fraction(0)
    for n in range(len(rows.sigma)):
        R_X, t_X, R_Y, t_Y = (answer.R[rows.X[n]], answer.t[rows.X[n]], answer.R[rows.Y[n]], answer.t[rows.Y[n]])
        alpha = answer.alpha[rows.owners[rows.owner[n]]]
        R_A, t_A, R_B, t_B = (fractions(a[n]) for a in (rows.R_A, rows.t_A, rows.R_B, rows.t_B))
        if form == "direct":
            translation = alpha * (R_A @ t_X + t_A - t_Y) - R_Y @ t_B
            rotation = R_A @ R_X - R_Y @ R_B
        else:
            c = fractions(centre[rows.X[n]])
            translation = R_Y.T @ (t_Y - R_A @ c - t_A) + t_B / alpha - R_B @ (R_X.T @ (t_X - c))
            rotation = R_B @ R_X.T - R_Y.T @ R_A
        total += (translation**2).sum() / Fraction(float(rows.sigma[n])) ** 2
        total += Fraction(float(rows.kappa[n])) * (rotation**2).sum()
    for name, T, sigma, kappa in rows.priors:
        i = rows.frames.index(name)
        if sigma is not None:
            total += ((answer.t[i] - fractions(T[:3, 3])) ** 2).sum() / Fraction(sigma) ** 2
        if kappa is not None:
            total += Fraction(kappa) * ((answer.R[i] - fractions(T[:3, :3])) ** 2).sum()
    return total / 2
