"""Squared residuals of every raw measurement, in units of its noise. They separate inliers from outliers."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.variance_factors import VarianceFactors
from gtsam_rwhec.refinement.weighted_fit import WeightedFit


@dataclass(frozen=True)
class Squares:
    """Whitened squared residuals of N measurements: about chi-square with 3 degrees of freedom each, at the truth."""

    #: (N,): kappa |R_A R_X - R_Y R_B|_F^2, which is 2 kappa theta^2 for a small angle; or the Mahalanobis distance
    #: under the rotation block of a full covariance. Infinite where a frame has no pose.
    rotation: Array
    #: (N,): |alpha (R_A t_X + t_A - t_Y) - R_Y t_B|^2 / sigma^2; or the same under the translation block.
    translation: Array
    #: (N, 6): log(B^-1 Y^-1 A X) in measured lengths, where full covariances were given.
    error: Array | None


@dataclass(frozen=True)
class Measured:
    """All raw measurements of a problem, pair by pair."""

    pairs: tuple[Pair, ...]
    #: The measurements of each pair.
    rows: tuple[slice, ...]
    #: (N, 4, 4)
    A: Array
    B: Array
    #: (N,)
    sigma: Array
    kappa: Array
    #: (N, 6, 6): inverse Cholesky factors of B's covariances, where full ones were given.
    whitening: Array | None
    #: (N, 3, 3): inverse Cholesky factors of the translation blocks alone.
    whitening_of_translation: Array | None

    @staticmethod
    def of(problem: Problem) -> Measured:
        """The measurements of a problem that kept them."""
        raw = [problem.measurements(*pair) for pair in problem.pairs]
        whitening = whitening_of_translation = None
        if problem.has_covariances:
            covariances = np.concatenate([one.covariance_of_B() for one in raw])
            whitening = np.linalg.inv(np.linalg.cholesky(covariances))
            whitening_of_translation = np.linalg.inv(np.linalg.cholesky(covariances[:, 3:, 3:]))
        return Measured(
            problem.pairs,
            _rows_of([len(one.A) for one in raw]),
            np.concatenate([one.A for one in raw]),
            np.concatenate([one.B for one in raw]),
            np.concatenate([one.sigma for one in raw]),
            np.concatenate([one.kappa for one in raw]),
            whitening,
            whitening_of_translation,
        )

    def of_pairs(self, pairs: list[Pair]) -> Measured:
        """The measurements of some pairs alone, in their order."""
        rows = [self.rows[self.pairs.index(pair)] for pair in pairs]
        index = np.concatenate([np.arange(one.start, one.stop) for one in rows]) if rows else np.zeros(0, dtype=int)
        return Measured(
            tuple(pairs),
            _rows_of([one.stop - one.start for one in rows]),
            self.A[index],
            self.B[index],
            self.sigma[index],
            self.kappa[index],
            None if self.whitening is None else self.whitening[index],
            None if self.whitening_of_translation is None else self.whitening_of_translation[index],
        )

    def pair_of(self, index: int) -> Pair:
        """The pair of a measurement."""
        return next(pair for pair, rows in zip(self.pairs, self.rows, strict=True) if index < rows.stop)

    def by_pair(self, values: np.ndarray) -> dict[Pair, np.ndarray]:
        """Values (N,) of all measurements, by pair."""
        return {pair: values[rows] for pair, rows in zip(self.pairs, self.rows, strict=True)}

    def squares(self, fit: WeightedFit) -> Squares:
        """The squared residuals at an answer."""
        R = np.empty((len(self.A), 3, 3))
        t = np.empty((len(self.A), 3))
        R_Y = np.empty((len(self.A), 3, 3))
        known = np.ones(len(self.A), dtype=bool)
        for (target, sensor), rows in zip(self.pairs, self.rows, strict=True):
            if target not in fit.poses or sensor not in fit.poses:
                known[rows] = False
                R[rows] = R_Y[rows] = np.eye(3)
                t[rows] = 0.0
                continue
            X, Y = fit.poses[target], fit.poses[sensor]
            A, B = self.A[rows], self.B[rows]
            R[rows] = A[:, :3, :3] @ X[:3, :3]
            R_Y[rows] = Y[:3, :3]
            t[rows] = fit.alpha[target] * (A[:, :3, :3] @ X[:3, 3] + A[:, :3, 3] - Y[:3, 3])
            t[rows] -= B[:, :3, 3] @ Y[:3, :3].T
        if self.whitening is None or self.whitening_of_translation is None:
            chord = R - R_Y @ self.B[:, :3, :3]
            rotation = self.kappa * np.einsum("nij,nij->n", chord, chord)
            translation = np.einsum("ni,ni->n", t, t) / self.sigma**2
            error = None
        else:
            seen = self.B[:, :3, :3].transpose(0, 2, 1) @ R_Y.transpose(0, 2, 1)  # into the measured target's axes
            error = se3.logmap(se3.pose(seen @ R, np.einsum("nij,nj->ni", seen, t)))
            rotation = _norms(self.whitening[:, :3, :3], error[:, :3])  # L is lower triangular
            translation = _norms(self.whitening_of_translation, error[:, 3:])
            error[~known] = np.inf
        return Squares(np.where(known, rotation, np.inf), np.where(known, translation, np.inf), error)

    def together(self, squares: Squares, factors: VarianceFactors) -> Array:
        """Squared residuals (N,) of all six components, about chi-square with 6 degrees of freedom at the truth."""
        if squares.error is None or self.whitening is None:
            return squares.rotation / factors.rotation + squares.translation / factors.translation
        known = np.isfinite(squares.rotation)
        scaled = squares.error[known] / np.sqrt(np.repeat(factors, 3))
        result = np.full(len(known), np.inf)
        result[known] = _norms(self.whitening[known], scaled)
        return result


def _rows_of(counts: list[int]) -> tuple[slice, ...]:
    """The rows of each pair, one pair after another."""
    return tuple(slice(int(first), int(end)) for first, end in pairwise(np.cumsum([0, *counts])))


def _norms(whitening: Array, error: Array) -> Array:
    white = np.einsum("nij,nj->ni", whitening, error)
    square: Array = np.einsum("ni,ni->n", white, white)
    return square
