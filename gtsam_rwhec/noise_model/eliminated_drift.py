"""The drift's part of the likelihood: all its states eliminated from the products of the columns, and the way back."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.noise_model.components import C
from gtsam_rwhec.noise_model.drift import TRACK, DriftPrior, unit_of
from gtsam_rwhec.noise_model.tridiagonal import ChainFactor


@dataclass(frozen=True)
class EliminatedDrift:
    """What the elimination of the drift leaves.

    Attributes
    ----------
    factor : ChainFactor
        Of the precision of the unit states.
    half : (T, s, q + m) array
        L^-1 of their products with the columns of the systematic errors, the unknowns and the residual.
    unit : (s,) array
        The states' standard deviations.
    systematic : (6,) array
        Standard deviations of the systematic errors.
    features : (T, k) array
        f of each instant; the columns of the systematic errors are E f.
    log_det : float
        log|precision| - log|prior precision|.
    """

    prior: DriftPrior
    sigma: dict[C, float]
    factor: ChainFactor
    half: Array
    unit: Array
    systematic: Array
    features: Array
    log_det: float

    @staticmethod
    def of(
        prior: DriftPrior, sigma: dict[C, float], rows: Array, systematic: Array, features: Array
    ) -> EliminatedDrift:
        """From the products G' V^-1 [J | r | E | G] (T, s, m + 6 + s) of each instant; LinAlgError as ``factor``."""
        T, s, c = rows.shape
        k, m = features.shape[1], c - s - 6
        q = 6 * k
        unit = np.tile(unit_of(sigma), s // TRACK)
        factor, log_det = prior.factor(rows[:, :, m + 6 :] * (unit[:, None] * unit), sigma)
        own = (factor.inverse * unit) @ rows[:, :, : m + 6]
        half = np.empty((T, s, q + m))
        half[:, :, q:] = own[:, :, :m]
        twists = own[:, :, m:] * systematic
        np.multiply(twists[:, :, :, None], features[:, None, None], out=half[:, :, :q].reshape(T, s, 6, k))
        return EliminatedDrift(prior, sigma, factor, factor.half(half), unit, systematic, features, log_det)

    def products(self) -> Array:
        """What the elimination takes from the columns' products (q + m, q + m)."""
        flat = self.half.reshape(-1, self.half.shape[2])
        found: Array = flat.T @ flat
        return found

    @cached_property
    def whole(self) -> Array:
        """The states (T, s, q + m) that go with each column, but for their sign."""
        return self.factor.whole(self.half)

    def gradient(self, G: Array) -> tuple[Array, dict[C, float]]:
        """The derivative by the products (T, s, m + 6 + s) of each instant, and d / d log sigma of the drift's own.

        ``G`` (q + m, q + m) is the derivative by the products of the columns.
        """
        (T, k), s, unit = self.features.shape, len(self.unit), self.unit[:, None]
        n = self.half.shape[2]
        q = 6 * k
        m = n - q
        whole = self.whole
        weighted = (whole.reshape(T * s, n) @ G).reshape(T, s, n)
        own, below = self.factor.inverse_blocks()
        own += weighted @ whole.transpose(0, 2, 1)
        below += weighted[1:] @ whole[:-1].transpose(0, 2, 1)
        by_rows = np.empty((T, s, m + 6 + s))
        by_rows[:, :, :m] = weighted[:, :, q:] * (-2.0 * unit)
        twists = np.einsum("tsjk,tk->tsj", weighted[:, :, :q].reshape(T, s, 6, k), self.features)
        by_rows[:, :, m : m + 6] = twists * (-2.0 * unit * self.systematic)
        by_rows[:, :, m + 6 :] = own * (unit * self.unit)
        return by_rows, self.prior.gradient(own, below, self.sigma)
