"""The documented cost in fractions, measurement after measurement: nothing is rounded, and nothing shared."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from stated_cost import Poses, Rows

Array = np.ndarray


@dataclass(frozen=True)
class RationalPoses:
    """An answer in fractions: R and t by frame (nested lists), alpha by owner."""

    R: list[list[list[Fraction]]]
    t: list[list[Fraction]]
    alpha: dict[str, Fraction]

    @staticmethod
    def of(poses: Poses) -> RationalPoses:
        R = [[[Fraction(float(v)) for v in row] for row in matrix] for matrix in poses.R]
        t = [[Fraction(float(v)) for v in vector] for vector in poses.t]
        return RationalPoses(R, t, {name: Fraction(value) for name, value in poses.alpha.items()})


def exact_cost(rows: Rows, form: str, centre: Array, answer: RationalPoses) -> Fraction:
    """The documented formula in fractions, one measurement after another."""
    total = Fraction(0)
    for n in range(len(rows.sigma)):
        R_X, t_X, R_Y, t_Y = (answer.R[rows.X[n]], answer.t[rows.X[n]], answer.R[rows.Y[n]], answer.t[rows.Y[n]])
        alpha = answer.alpha[rows.owners[rows.owner[n]]]
        R_A, t_A, R_B, t_B = (_fractions(a[n]) for a in (rows.R_A, rows.t_A, rows.R_B, rows.t_B))
        if form == "direct":
            moved = _plus(_times(R_A, t_X), t_A)
            translation = [alpha * (moved[i] - t_Y[i]) - b for i, b in enumerate(_times(R_Y, t_B))]
            rotation = _minus(_product(R_A, R_X), _product(R_Y, R_B))
        else:
            c = _fractions(centre[rows.X[n]])
            back_X, back_Y = _transposed(R_X), _transposed(R_Y)
            seen = _plus(_times(R_A, c), t_A)
            first = _times(back_Y, [t_Y[i] - seen[i] for i in range(3)])
            second = _times(R_B, _times(back_X, [t_X[i] - c[i] for i in range(3)]))
            translation = [first[i] + t_B[i] / alpha - second[i] for i in range(3)]
            rotation = _minus(_product(R_B, back_X), _product(back_Y, R_A))
        sigma = Fraction(float(rows.sigma[n]))
        total += sum(v * v for v in translation) / (sigma * sigma)
        total += Fraction(float(rows.kappa[n])) * sum(v * v for row in rotation for v in row)
    for name, T, sigma, kappa in rows.priors:
        i = rows.frames.index(name)
        if sigma is not None:
            apart = [a - b for a, b in zip(answer.t[i], _fractions(T[:3, 3]), strict=True)]
            total += sum(v * v for v in apart) / Fraction(sigma) ** 2
        if kappa is not None:
            apart_R = _minus(answer.R[i], _fractions(T[:3, :3]))
            total += Fraction(kappa) * sum(v * v for row in apart_R for v in row)
    return total / 2


def _fractions(array: Array) -> list:
    return [_fractions(a) if a.ndim else Fraction(float(a)) for a in np.asarray(array)]


def _times(R: list, v: list) -> list:
    return [sum(a * b for a, b in zip(row, v, strict=True)) for row in R]


def _product(A: list, B: list) -> list:
    columns = _transposed(B)
    return [[sum(a * b for a, b in zip(row, column, strict=True)) for column in columns] for row in A]


def _transposed(A: list) -> list:
    return [list(column) for column in zip(*A, strict=True)]


def _plus(a: list, b: list) -> list:
    return [x + y for x, y in zip(a, b, strict=True)]


def _minus(A: list, B: list) -> list:
    return [[x - y for x, y in zip(a, b, strict=True)] for a, b in zip(A, B, strict=True)]
