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

from gtsam_rwhec.fitting.drift import TRACK, DriftPrior, EliminatedDrift, own_directions
from gtsam_rwhec.fitting.fit_options import About, C
from gtsam_rwhec.fitting.instant_products import Measurements, Reduced, carrier_of, white_terms
from gtsam_rwhec.fitting.joint_covariance import EliminationOrder
from gtsam_rwhec.fitting.noise_rows import Rows
from gtsam_rwhec.geometry.poses import Array


@dataclass(frozen=True)
class Estimate:
    """What one evaluation gives."""

    #: Of the restricted likelihood.
    minus_two_log: float
    #: (p,): The unknowns' best change, in the basis of the model.
    step: Array
    #: (p, p)
    covariance: Array
    #: Of all factors, at that change.
    cost: float = 0.0

    @property
    def farthest(self) -> float:
        """The longest step of a direction, in its standard deviations."""
        return float(np.abs(self.step / np.sqrt(np.diagonal(self.covariance))).max(initial=0.0))


@dataclass(frozen=True)
class NoiseModel:
    """Rows, and what of them the components act on."""

    rows: Rows
    side: About
    #: (d, p): The directions of the unknowns that the measurements determine.
    basis: Array
    #: (p, p) and (p,): What the problem's priors know of the unknowns' change.
    prior_information: Array
    prior_gradient: Array
    drift: DriftPrior | None
    #: (N, k): f, which measurements of one instant share.
    features: Array
    #: The priors' cost before that change.
    prior_cost: float = 0.0

    def evaluate(self, sigma: dict[C, float]) -> Estimate:
        """The restricted likelihood at standard deviations, with the estimate and its covariance."""
        return self.eliminated(sigma).estimate

    def white(self, sigma: dict[C, float]) -> Array:
        """D (N, 6, 6): the noise of single measurements, of B and of stamps."""
        found: Array = sum(
            (sigma[a] * sigma[b] * term for (a, b), term in white_terms(self.rows).items()),
            start=np.zeros_like(self.rows.given) if self.rows.slides is None else self.rows.slides,
        )
        return found

    def carrier(self, sigma: dict[C, float]) -> Array:
        """E (N, 6, 6): the residual's change by the unit twists of A."""
        found: Array = self.rows.twist[self.side] * carrier_of(sigma)
        return found

    @cached_property
    def _measurements(self) -> Measurements:
        directions = None if self.drift is None else own_directions(self.rows, self.drift)
        return Measurements.of(self.rows, self.side, self.basis, directions)

    @cached_property
    def _orders(self) -> dict[int, EliminationOrder]:
        """The order of elimination of the systematic errors and the unknowns, by their number."""
        return {}

    def eliminated(self, sigma: dict[C, float]) -> Eliminated:
        """The same, and what is left of the elimination for derivatives."""
        measured = self._measurements.reduced(sigma)
        systematic = np.repeat([sigma[C.SYSTEMATIC_ROTATION], sigma[C.SYSTEMATIC_TRANSLATION]], 3)
        f = self.features[self.rows.instants.first]
        if not systematic.any():
            f = f[:, :0]
        q, log_det, drift = 6 * f.shape[1], measured.log_det, None
        gram = _products(measured, systematic, f)
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
        squares = float(gram[-1, -1] + b @ mean)
        estimate = Estimate(
            log_det + more + squares,
            mean[q:],
            np.ascontiguousarray(covariance[q:, q:]),
            0.5 * squares + self.prior_cost,
        )
        return Eliminated(estimate, measured, drift, covariance, mean, systematic, f)


def _products(measured: Reduced, systematic: Array, f: Array) -> Array:
    """Those (q + m, q + m) of the columns [u | d | r]: a systematic error's are E f_k, its products those of E."""
    (T, k), cross, m = f.shape, measured.cross, measured.of.m
    q = 6 * k
    gram = np.empty((q + m, q + m))
    gram[q:, q:] = measured.total
    if q:
        mixed = (f.T @ cross[:, :6, :m].reshape(T, -1)).reshape(k, 6, m) * systematic[:, None]
        gram[:q, q:] = mixed.transpose(1, 0, 2).reshape(q, m)
        gram[q:, :q] = gram[:q, q:].T
        own = (cross[:, :6, m : m + 6] * (systematic[:, None] * systematic)).reshape(T, 36)
        both = np.empty((k, k, 36))
        for i in range(k):  # symmetric
            both[i, i:] = both[i:, i] = (f[:, i:] * f[:, i, None]).T @ own
        gram[:q, :q] = both.reshape(k, k, 6, 6).transpose(2, 0, 3, 1).reshape(q, q)
    return gram


@dataclass(frozen=True)
class Eliminated:
    """What one evaluation of the likelihood leaves for its gradient."""

    estimate: Estimate
    #: The single measurements.
    measured: Reduced
    drift: EliminatedDrift | None
    #: (q + p, q + p): Of the unit systematic errors and the unknowns.
    covariance: Array
    #: (q + p,): Theirs.
    mean: Array
    #: (6,): Standard deviations of the systematic errors.
    systematic: Array
    #: (T, k): f of each instant; k = 0 without systematic errors.
    features: Array

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
            own = G[:q, :q].reshape(6, k, 6, k).transpose(1, 3, 0, 2).reshape(k, k * 36)
            of_twists = self.features[:, None] @ (self.features @ own).reshape(T, k, 36)
            both = self.systematic[:, None] * self.systematic
            by_cross[:, :6, m : m + 6] = both * of_twists.reshape(T, 6, 6)
        if self.drift is not None:
            by_cross[:, 6:], by_drift = self.drift.gradient(G)
            result |= by_drift
        return self.measured.gradient(G[q:, q:], by_cross) | result


#: Rotation and translation of a twist, and those and the scale of a drift's state.
TWIST = np.repeat(np.eye(2), 3, axis=0)
STATE = np.repeat(np.eye(3), [3, 3, 1], axis=0)


def average_information(eliminated: Eliminated, active: tuple[C, ...]) -> Array:
    """a (k, k) of the active components, for -2 log of the likelihood by logarithms of standard deviations."""
    e, measured = eliminated, eliminated.measured
    m, q = measured.of.m, 6 * e.features.shape[1]
    V = _working_columns(e, active)
    k = V.shape[2]
    flat = V.reshape(-1, k)
    own, mixed = flat.T @ flat, measured.of.with_unknowns(V, measured.Z)
    cross = measured.of.by_instant(measured.Z, V)
    if measured.carriers is not None:
        shared, (root, lost) = measured.of.shared, measured.carriers
        lost_V = (root * measured.carrier) @ cross[shared, :6]
        flat = lost_V.reshape(-1, k)
        own -= flat.T @ flat
        mixed -= flat.T @ lost[:, :, :m].reshape(-1, m)
        cross[shared] -= lost[:, :, m:].transpose(0, 2, 1) @ lost_V
    gram = np.empty((k, q + m - 1))
    gram[:, q:] = mixed[:, :-1]
    if q:
        by_feature = (e.features.T @ cross[:, :6].reshape(len(cross), -1)).reshape(-1, 6, k)
        gram[:, :q] = (by_feature * e.systematic[:, None]).transpose(2, 1, 0).reshape(k, q)
    if e.drift is not None:
        half = e.drift.factor.half((e.drift.factor.inverse * e.drift.unit) @ cross[:, 6:]).reshape(-1, k)
        own -= half.T @ half
        gram -= half.T @ e.drift.half.reshape(len(half), -1)[:, :-1]
    found: Array = own - gram @ e.covariance @ gram.T
    return found


def _working_columns(e: Eliminated, active: tuple[C, ...]) -> Array:
    """V_i P r (N, 6, k), by L^-1 of B's and the stamps' noise."""
    measured, of = e.measured, e.measured.of
    Z = measured.Z
    added: dict[C, Array] = {}
    effects, carrier = e.effects
    left, twists = e.left(Z), Z[:, :, of.own : of.own + 6]
    if measured.carriers is not None:
        parts = _split(twists, of.of_instants(carrier[:, :, None] * TWIST))
        added |= dict(zip((C.CARRIER_ROTATION, C.CARRIER_TRANSLATION), parts, strict=True))
    if e.features.shape[1]:
        parts = _split(twists, of.of_instants(effects[:, :6, None] * TWIST))
        added |= dict(zip((C.SYSTEMATIC_ROTATION, C.SYSTEMATIC_TRANSLATION), parts, strict=True))
    if e.drift is not None:
        kinds = np.tile(STATE, (len(e.drift.unit) // TRACK, 1))
        walks = e.drift.prior.walked(e.states, kinds, e.drift.sigma) * e.drift.unit[:, None]
        parts = _split(Z[:, :, of.own + 6 :], of.of_own_track(walks))
        added |= dict(zip((C.DRIFT_ROTATION, C.DRIFT_TRANSLATION, C.DRIFT_SCALE), parts, strict=True))
    weighted = measured.root.transpose(0, 2, 1) @ left[:, :, None]
    for (a, b), term in zip(of.pairs, of.terms, strict=True):
        product = measured.sigma[a] * measured.sigma[b]
        if product:
            moved = np.einsum("ijn,nj->ni", term, weighted[:, :, 0]) * product
            change = (measured.root @ moved[:, :, None])[:, :, 0]
            for component in (a, b):
                added[component] = added[component] + change if component in added else change
    return np.stack([added.get(c, np.zeros_like(left)) for c in active], axis=2)


def _split(columns: Array, parts: Array) -> Array:
    """-2 Z times the parts (N, j, k) of an effect: (k, N, 6)."""
    found: Array = -2.0 * (columns @ parts).transpose(2, 0, 1)
    return found
