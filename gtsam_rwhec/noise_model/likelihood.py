"""The restricted likelihood of the components, and the unknowns' estimate and covariance under them.

With V = D + E S_A E' + G W G' + F S F' and J the Jacobian of the unknowns,

    -2 l = log|V| + log|J' V^-1 J| + r' P r,    P = V^-1 - V^-1 J (J' V^-1 J)^-1 J' V^-1

(Patterson and Thompson 1971). V is never formed: A's twists are eliminated instant by instant, the drift by the
Cholesky factor of a banded matrix, the systematic errors and the unknowns last. Every effect is scaled to unit
variance first, so that a component may go to zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.noise_model.components import C
from gtsam_rwhec.noise_model.drift import DriftPrior, own_directions
from gtsam_rwhec.noise_model.eliminated_drift import EliminatedDrift
from gtsam_rwhec.noise_model.gradient import Eliminated
from gtsam_rwhec.noise_model.measurements import Measurements, Reduced, white_terms
from gtsam_rwhec.noise_model.rows import Rows, Side
from gtsam_rwhec.refinement.definite_inverse import EliminationOrder


@dataclass(frozen=True)
class Estimate:
    """What one evaluation gives.

    Attributes
    ----------
    minus_two_log : float
        Of the restricted likelihood.
    step : (p,) array
        The unknowns' best change, in the basis of the model.
    covariance : (p, p) array
    """

    minus_two_log: float
    step: Array
    covariance: Array


@dataclass(frozen=True)
class NoiseModel:
    """Rows, and what of them the components act on.

    Attributes
    ----------
    basis : (d, p) array
        The directions of the unknowns that the measurements determine.
    prior_information, prior_gradient : (p, p) and (p,) arrays
        What the problem's priors know of the unknowns' change.
    features : (N, k) array
        f, which measurements of one instant share.
    """

    rows: Rows
    side: Side
    basis: Array
    prior_information: Array
    prior_gradient: Array
    drift: DriftPrior | None
    features: Array

    def evaluate(self, sigma: dict[C, float]) -> Estimate:
        """The restricted likelihood at standard deviations, with the estimate and its covariance."""
        return self.eliminated(sigma)[0]

    def value_and_gradient(self, sigma: dict[C, float], active: tuple[C, ...]) -> tuple[Estimate, Array]:
        """The same, and d(-2 l) / d log sigma (k,) of the active components."""
        estimate, eliminated = self.eliminated(sigma)
        return estimate, eliminated.gradient_by(active)

    def white(self, sigma: dict[C, float]) -> Array:
        """D (N, 6, 6): the noise of single measurements, of B and of stamps."""
        found: Array = sum(
            (sigma[a] * sigma[b] * term for (a, b), term in white_terms(self.rows).items()),
            start=np.zeros_like(self.rows.given),
        )
        return found

    @cached_property
    def _measurements(self) -> Measurements:
        directions = None if self.drift is None else own_directions(self.rows, self.drift)
        return Measurements.of(self.rows, self.side, self.basis, directions)

    @cached_property
    def _features(self) -> tuple[Array, Array]:
        """f (T, k) of the instants, and f f' (T, k k)."""
        f = self.features[self.rows.instants.first]
        return f, (f[:, :, None] * f[:, None, :]).reshape(len(f), -1)

    @cached_property
    def _orders(self) -> dict[int, EliminationOrder]:
        """The order of elimination of the systematic errors and the unknowns, by their number."""
        return {}

    def eliminated(self, sigma: dict[C, float]) -> tuple[Estimate, Eliminated]:
        """The same, and what is left of the elimination for derivatives."""
        measured = self._measurements.reduced(sigma)
        systematic = np.repeat([sigma[C.SYSTEMATIC_ROTATION], sigma[C.SYSTEMATIC_TRANSLATION]], 3)
        f, ff = self._features
        if not systematic.any():
            f, ff = f[:, :0], ff[:, :0]
        q, log_det, drift = 6 * f.shape[1], measured.log_det, None
        gram = _products(measured, systematic, f, ff)
        if self.drift is not None:
            drift = EliminatedDrift.of(self.drift, sigma, measured.cross[:, 6:], systematic, f)
            log_det += drift.log_det
            gram -= drift.products()
        # last, the systematic errors and the unknowns, [u | d]
        precision, b = gram[:-1, :-1], gram[:-1, -1]
        precision[np.arange(q), np.arange(q)] += 1.0
        precision[q:, q:] += self.prior_information
        b[q:] += self.prior_gradient
        if len(precision) not in self._orders:
            self._orders[len(precision)] = EliminationOrder.of(precision)
        covariance, more = self._orders[len(precision)].inverse(precision)
        mean = -covariance @ b
        mean -= covariance @ (precision @ mean + b)  # what rounding has left
        value = log_det + more + float(gram[-1, -1] + b @ mean)
        estimate = Estimate(value, mean[q:], np.ascontiguousarray(covariance[q:, q:]))
        return estimate, Eliminated(measured, drift, covariance, mean, systematic, f, ff)


def _products(measured: Reduced, systematic: Array, f: Array, ff: Array) -> Array:
    """Those (q + m, q + m) of the columns [u | d | r]: a systematic error's are E f_k, its products those of E."""
    (T, k), cross, m = f.shape, measured.cross, measured.of.m
    q = 6 * k
    gram = np.empty((q + m, q + m))
    gram[q:, q:] = measured.total
    if q:
        mixed = (f.T @ cross[:, :6, :m].reshape(T, -1)).reshape(k, 6, m) * systematic[:, None]
        gram[:q, q:] = mixed.transpose(1, 0, 2).reshape(q, m)
        gram[q:, :q] = gram[:q, q:].T
        own = cross[:, :6, m : m + 6] * (systematic[:, None] * systematic)
        gram[:q, :q] = (ff.T @ own.reshape(T, 36)).reshape(k, k, 6, 6).transpose(2, 0, 3, 1).reshape(q, q)
    return gram
