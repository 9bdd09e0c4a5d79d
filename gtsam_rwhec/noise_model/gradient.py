"""The gradient of the restricted likelihood by the components: the way back through its elimination.

Fisher's identity for unit effects u scaled by sigma: d(-2 l) / d log sigma = sum 2 (1 - E[u^2]), with the second
moments given the residuals. The derivative by the products of the columns [u | d | r] is G = y y' + blkdiag(C, 0),
y = (mean of the systematic errors and the unknowns, 1) and C their covariance; those of the drift and of white noise
follow. No step divides by a sigma.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.noise_model.components import C
from gtsam_rwhec.noise_model.eliminated_drift import EliminatedDrift
from gtsam_rwhec.noise_model.measurements import Reduced


@dataclass(frozen=True)
class Eliminated:
    """What one evaluation of the likelihood leaves for its gradient.

    Attributes
    ----------
    measured : Reduced
        The single measurements.
    drift : EliminatedDrift or None
    covariance : (q + p, q + p) array
        Of the unit systematic errors and the unknowns.
    mean : (q + p,) array
        Theirs.
    systematic : (6,) array
        Standard deviations of the systematic errors.
    features, products : (T, k) and (T, k k) arrays
        f of each instant, and f f'; k = 0 without systematic errors.
    """

    measured: Reduced
    drift: EliminatedDrift | None
    covariance: Array
    mean: Array
    systematic: Array
    features: Array
    products: Array

    @cached_property
    def states(self) -> Array:
        """The drift's unit states (T, s); of no drift, (T, 0)."""
        if self.drift is None:
            return np.zeros((len(self.features), 0))
        found: Array = -(self.drift.whole @ np.append(self.mean, 1.0))
        return found

    @cached_property
    def effects(self) -> tuple[Array, Array]:
        """Twists of the systematic errors and the drift's states (T, 6 + s), and shared twists of A (T, 6); rad, m."""
        measured, of, q = self.measured, self.measured.of, 6 * self.features.shape[1]
        varying = self.features @ (self.mean[:q].reshape(6, -1) * self.systematic[:, None]).T
        drift = self.states * (1.0 if self.drift is None else self.drift.unit)
        found = np.hstack([varying, drift])
        carrier = np.zeros((len(found), 6))
        if measured.carriers is not None:
            root, lost = measured.carriers
            seen = lost[:, :, : of.m] @ np.append(self.mean[q:], 1.0)
            seen += (lost[:, :, of.m :] @ found[of.shared, :, None])[:, :, 0]
            carrier[of.shared] = -(root.transpose(0, 2, 1) @ seen[:, :, None])[:, :, 0] * measured.carrier
        return found, carrier

    def left(self, columns: Array) -> Array:
        """What is left (N, 6) of the residuals; ``columns`` are those of the rows, or whitened: ``Reduced.Z``."""
        of, (effects, carrier) = self.measured.of, self.effects
        found = of.along(columns, np.append(self.mean[6 * self.features.shape[1] :], 1.0), effects)
        if self.measured.carriers is not None:
            twists = columns[:, :, of.own : of.own + 6]
            found += (twists @ of.of_instants(carrier)[:, :, None])[:, :, 0]
        return found

    def gradient_by(self, active: tuple[C, ...]) -> Array:
        """d(-2 l) / d log sigma (k,) of the active components."""
        gradient = self.gradient()
        return np.array([gradient[component] for component in active])

    def gradient(self) -> dict[C, float]:
        """d(-2 l) / d log sigma of each component."""
        (T, k), m = self.features.shape, self.measured.of.m
        q = 6 * k
        y = np.append(self.mean, 1.0)
        G = y[:, None] * y
        G[:-1, :-1] += self.covariance
        each = 2.0 * (1.0 - np.diagonal(G)[:q]).reshape(2, 3 * k).sum(axis=1)
        result = {C.SYSTEMATIC_ROTATION: float(each[0]), C.SYSTEMATIC_TRANSLATION: float(each[1])}
        by_cross = np.zeros_like(self.measured.cross)
        if q:
            mixed = self.features @ G[:q, q:].reshape(6, k, m).transpose(1, 0, 2).reshape(k, 6 * m)
            by_cross[:, :6, :m] = 2.0 * self.systematic[:, None] * mixed.reshape(T, 6, m)
            own = G[:q, :q].reshape(6, k, 6, k).transpose(1, 3, 0, 2).reshape(k * k, 36)
            both = self.systematic[:, None] * self.systematic
            by_cross[:, :6, m : m + 6] = both * (self.products @ own).reshape(T, 6, 6)
        if self.drift is not None:
            by_cross[:, 6:], by_drift = self.drift.gradient(G)
            result |= by_drift
        return self.measured.gradient(G[q:, q:], by_cross) | result
