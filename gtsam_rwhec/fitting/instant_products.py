"""The single measurements' part of the likelihood: white noise and A's twists eliminated, instant by instant.

The columns [J | r | E | G] of the rows do not change between evaluations, nor do the terms of the variance, which is
a sum of products of standard deviations with them. Left are the products of the columns with the inverse variance of
each instant, and backwards the derivatives by the variances from those by these products.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gtsam_rwhec.fitting.drift import lower_inverse
from gtsam_rwhec.fitting.fit_options import About, C
from gtsam_rwhec.fitting.noise_rows import Instants, Rows, summed
from gtsam_rwhec.geometry.poses import Array


@dataclass(frozen=True)
class Measurements:
    """What of the rows does not depend on the components."""

    instants: Instants
    #: (N, 6, c): Of each row: J by its unknowns, the residual, the twists of A, the states of its drift.
    columns: Array
    #: (N, c): Their places among all m + 6 + s columns.
    places: np.ndarray
    #: The number of all unknowns and the residual, and that of the drift's states.
    m: int
    states: int
    #: Whose product of standard deviations is with each term.
    pairs: tuple[tuple[C, C], ...]
    #: (k, 6, 6, N): Of the variance of a measurement; symmetric. Where an instant has one measurement, A's noise is in
    #: them.
    terms: Array
    #: (S,): The instants that have several measurements.
    shared: np.ndarray
    #: (M,): The measurements of these instants, and the place of each one's instant in ``shared``.
    members: np.ndarray
    shared_of: np.ndarray
    #: (6, 6, N): What is added to the variances, whatever the standard deviations are.
    slides: Array | None = None

    @staticmethod
    def of(rows: Rows, side: About, basis: Array, directions: Array | None) -> Measurements:
        """With the directions (N, 6, 7) of the drift of each measurement's own track, if there is a drift."""
        twist, instants, N = rows.twist[side], rows.instants, len(rows.residual)
        J = rows.by_unknowns.by(basis)
        m = J.count + 1
        parts, places = [J.values, rows.residual[:, :, None], twist], [J.places, np.full((N, 1), m - 1)]
        places.append(np.broadcast_to(np.arange(m, m + 6), (N, 6)))
        states = 0
        if directions is not None:
            track = directions.shape[2]
            states = track * instants.chains
            parts.append(directions)
            places.append(m + 6 + track * instants.chain[:, None] + np.arange(track))
        is_shared = np.bincount(instants.index, minlength=instants.count) > 1
        members = np.flatnonzero(is_shared[instants.index])
        terms = white_terms(rows)
        if not is_shared.all():
            alone = twist * ~is_shared[instants.index][:, None, None]
            turning, moving = alone[:, :, :3], alone[:, :, 3:]
            terms[C.CARRIER_ROTATION, C.CARRIER_ROTATION] = turning @ turning.transpose(0, 2, 1)
            terms[C.CARRIER_TRANSLATION, C.CARRIER_TRANSLATION] = moving @ moving.transpose(0, 2, 1)
        stacked = np.ascontiguousarray(np.stack(list(terms.values())).transpose(0, 2, 3, 1))
        return Measurements(
            instants, np.concatenate(parts, axis=2), np.concatenate(places, axis=1), m, states, tuple(terms), stacked,
            np.flatnonzero(is_shared), members, (np.cumsum(is_shared) - 1)[instants.index[members]],
            None if rows.slides is None else np.ascontiguousarray(rows.slides.transpose(1, 2, 0)),
        )  # fmt: skip

    @property
    def own(self) -> int:
        """The number of columns of a row that are by unknowns or the residual."""
        return int(self.columns.shape[2]) - 6 - self.states // self.instants.chains

    @cached_property
    def is_whole(self) -> bool:
        """Whether every row has all columns, in their order."""
        width = self.m + 6 + self.states
        return self.columns.shape[2] == width and bool((self.places == np.arange(width)).all())

    def reduced(self, sigma: dict[C, float]) -> Reduced:
        """The products of the columns at standard deviations; LinAlgError where a variance is not positive definite."""
        n, m = len(self.columns), self.m
        weights = np.array([sigma[a] * sigma[b] for a, b in self.pairs])
        variance = (weights @ self.terms.reshape(len(weights), -1)).reshape(6, 6, n)
        if self.slides is not None:
            variance += self.slides
        L = np.linalg.cholesky(variance.transpose(2, 0, 1))
        log_det = 2.0 * float(np.log(np.diagonal(L, axis1=1, axis2=2)).sum())
        root = np.ascontiguousarray(lower_inverse(np.ascontiguousarray(L.transpose(1, 2, 0))).transpose(2, 0, 1))
        Z = root @ self.columns
        total, cross = self.gram(Z), self.by_instant(Z, Z)
        if not len(self.shared):
            return Reduced(self, sigma, root, Z, None, total, cross, log_det)
        carrier, of_shared = carrier_of(sigma), cross[self.shared]
        K = np.eye(6) + of_shared[:, :6, m : m + 6] * carrier[:, None] * carrier
        L_K = np.linalg.cholesky(K)
        log_det += 2.0 * float(np.log(np.diagonal(L_K, axis1=1, axis2=2)).sum())
        root_K = np.linalg.inv(L_K)
        lost = (root_K * carrier) @ of_shared[:, :6]
        flat = lost[:, :, :m].reshape(-1, m)
        total -= flat.T @ flat
        cross[self.shared] = of_shared - lost[:, :, m:].transpose(0, 2, 1) @ lost
        return Reduced(self, sigma, root, Z, (root_K, lost), total, cross, log_det)

    def gram(self, Z: Array) -> Array:
        """[J | r]' [J | r] (m, m) of all rows; ``Z`` (N, 6, c) are the rows' own columns, as in the other sums."""
        own = Z[:, :, : self.own]
        if self.is_whole:
            flat = own.reshape(-1, self.m)
            found: Array = flat.T @ flat
            return found
        return summed(own.transpose(0, 2, 1) @ own, self._unknowns_at, (self.m, self.m))

    def with_unknowns(self, V: Array, Z: Array) -> Array:
        """V' [J | r] (k, m) of all rows, V (N, 6, k)."""
        own, k = Z[:, :, : self.own], V.shape[2]
        if self.is_whole:
            found: Array = V.reshape(-1, k).T @ own.reshape(-1, self.m)
            return found
        at = np.broadcast_to(self.places[:, None, : self.own], (len(V), k, self.own)) + self.m * np.arange(k)[:, None]
        return summed(V.transpose(0, 2, 1) @ own, at, (k, self.m))

    def by_instant(self, Z: Array, V: Array) -> Array:
        """[E | G]' V (T, 6 + s, k) of each instant, V (N, 6, k); where V is Z, of all m + 6 + s columns."""
        effects, T = Z[:, :, self.own :], self.instants.count
        products: Array = effects.transpose(0, 2, 1) @ V
        if V is Z and not self.is_whole:
            return summed(products, self._effects_at, (T, 6 + self.states, self.m + 6 + self.states))
        if effects.shape[2] == 6 + self.states:
            return products if len(V) == T else np.add.reduceat(products, self.instants.first)
        k = V.shape[2]
        at = self._effect_rows[:, :, None] * k + np.arange(k)
        return summed(products, at, (T, 6 + self.states, k))

    def along(self, Z: Array, of_unknowns: Array, of_effects: Array) -> Array:
        """[J | r | E | G] v (N, 6) of each row: v is (m,), and (T, 6 + s) of each instant."""
        there = self.of_instants(of_effects) if self.is_whole else of_effects.ravel()[self._effect_rows]
        weights = np.concatenate([of_unknowns[self.places[:, : self.own]], there], axis=1)
        found: Array = (Z @ weights[:, :, None])[:, :, 0]
        return found

    def of_instants(self, values: Array) -> Array:
        """The values (N, ...) of each measurement's instant."""
        return values if self.instants.count == len(self.columns) else values[self.instants.index]

    def of_own_track(self, values: Array) -> Array:
        """The values (T, s, ...) of each measurement's instant and track: (N, 7, ...)."""
        found: Array = values.reshape(-1, *values.shape[2:])[
            self.instants.index[:, None] * self.states + self.places[:, self.own + 6 :] - self.m - 6
        ]
        return found

    @cached_property
    def _unknowns_at(self) -> np.ndarray:
        """The places (N, w, w) of the products of a row's own unknowns and residual."""
        own = self.places[:, : self.own]
        found: np.ndarray = own[:, :, None] * self.m + own[:, None]
        return found

    @cached_property
    def _effect_rows(self) -> np.ndarray:
        """The places (N, 6 + 7) of a row's own effects among all (T, 6 + s)."""
        found: np.ndarray = self.instants.index[:, None] * (6 + self.states) + self.places[:, self.own :] - self.m
        return found

    @cached_property
    def _effects_at(self) -> np.ndarray:
        """The places (N, 6 + 7, c) of their products with the row's own columns."""
        found: np.ndarray = self._effect_rows[:, :, None] * (self.m + 6 + self.states) + self.places[:, None]
        return found


@dataclass(frozen=True)
class Reduced:
    """Products with V^-1 = D^-1 - D^-1 E K^-1 E' D^-1 of each instant, and what the way back needs."""

    of: Measurements
    sigma: dict[C, float]
    #: (N, 6, 6) and (N, 6, c): L^-1 of the variances L L', and L^-1 of the rows' own columns.
    root: Array
    Z: Array
    #: L_K^-1 S_A^(1/2), and the same by E' D^-1 of all columns, of the shared instants.
    carriers: tuple[Array, Array] | None
    #: (m, m): [J | r]' V^-1 [J | r], of all instants.
    total: Array
    #: (T, 6 + s, m + 6 + s): [E | G]' V^-1 [J | r | E | G], of each instant.
    cross: Array
    #: log|V|.
    log_det: float

    @property
    def carrier(self) -> Array:
        """The standard deviations (6,) of a twist of A."""
        return carrier_of(self.sigma)

    def gradient(self, by_total: Array, by_cross: Array) -> dict[C, float]:
        """d / d log sigma of log|V| and of a function of ``total`` and ``cross``, from that by their entries."""
        of, root, Z = self.of, self.root, self.Z
        result = dict.fromkeys(C, 0.0)
        if of.is_whole:
            weighted = _weighted(Z, by_total, of.of_instants(by_cross), of.m)
        else:
            weighted = _weighted(Z, by_total.ravel()[of._unknowns_at], by_cross.ravel()[of._effects_at], of.own)
        inner = np.eye(6) - weighted @ Z.transpose(0, 2, 1)
        if self.carriers is not None:
            root_K, lost = self.carriers
            there, carrier, m = by_cross[of.shared], self.carrier, of.m
            product = lost[:, :, :m] @ by_total
            once = lost[:, :, m:] @ there
            once[:, :, :m] += product
            # E' V^-1 of all columns is root_K' lost, over the carrier's deviations
            root_t = root_K.transpose(0, 2, 1)
            explained = (root_t @ once) * (root_t @ lost)
            each = 2.0 * (1.0 - (root_K**2).sum(axis=1) - explained.sum(axis=2)).sum(axis=0)
            result[C.CARRIER_ROTATION], result[C.CARRIER_TRANSLATION] = float(each[:3].sum()), float(each[3:].sum())
            # Of these rows the columns are Z - W lost, with all columns of their instant.
            own = Z[of.members]
            W = own[:, :, of.own : of.own + 6] @ (root_K * carrier).transpose(0, 2, 1)[of.shared_of]
            both = once @ lost.transpose(0, 2, 1)
            once[:, :, :m] += product
            once[:, :, m:] += lost @ there.transpose(0, 2, 1)
            if of.is_whole:
                once = once[of.shared_of]
            else:
                once = once[of.shared_of[:, None, None], np.arange(6)[:, None], of.places[of.members][:, None]]
            W_t = W.transpose(0, 2, 1)
            inner[of.members] += W @ (once @ own.transpose(0, 2, 1) - (np.eye(6) + both)[of.shared_of] @ W_t)
        by_variance = root.transpose(0, 2, 1) @ inner @ root
        terms = of.terms.reshape(len(of.pairs), -1)
        found = terms @ by_variance.transpose(1, 2, 0).ravel()
        for (a, b), value in zip(of.pairs, found.tolist(), strict=True):
            change = value * self.sigma[a] * self.sigma[b]
            result[a] += change
            result[b] += change
        return result


def carrier_of(sigma: dict[C, float]) -> Array:
    """The standard deviations (6,) of a twist of A."""
    found: Array = np.repeat([sigma[C.CARRIER_ROTATION], sigma[C.CARRIER_TRANSLATION]], 3)
    return found


def white_terms(rows: Rows) -> dict[tuple[C, C], Array]:
    """The terms (N, 6, 6) of the noise of B and of stamps, each by the standard deviations whose product is with it."""
    given = np.zeros((3, *rows.given.shape))
    given[0, :, :3, :3] = rows.given[:, :3, :3]
    given[1, :, 3:, 3:] = rows.given[:, 3:, 3:]
    given[2] = rows.given - given[0] - given[1]
    depth = np.zeros_like(rows.given)
    depth[:, 3:, 3:] = rows.axis[:, :, None] * rows.axis[:, None, :]
    terms = {(C.ROTATION, C.ROTATION): given[0], (C.TRANSLATION, C.TRANSLATION): given[1], (C.DEPTH, C.DEPTH): depth}
    if given[2].any():
        terms[C.ROTATION, C.TRANSLATION] = given[2]
    if rows.rate.any():
        terms[C.JITTER, C.JITTER] = rows.rate[:, :, None] * rows.rate[:, None, :]
    return terms


def _weighted(Z: Array, by_total: Array, by_cross: Array, m: int) -> Array:
    """Z times what the function's derivative by its products of columns is (n, a, c)."""
    result: Array = Z[:, :, m:] @ by_cross
    result[:, :, :m] += Z[:, :, :m] @ by_total
    return result
