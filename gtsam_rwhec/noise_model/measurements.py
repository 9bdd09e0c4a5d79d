"""The single measurements' part of the likelihood: white noise and A's twists eliminated, instant by instant.

The columns [J | r | E | G] of the rows do not change between evaluations, nor do the terms of the variance, which is
a sum of products of standard deviations with them. Left are the products of the columns with the inverse variance of
each instant, and backwards the derivatives by the variances from those by these products.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.noise_model.components import C
from gtsam_rwhec.noise_model.rows import Instants, Rows, Side
from gtsam_rwhec.noise_model.tridiagonal import lower_inverse


@dataclass(frozen=True)
class Measurements:
    """What of the rows does not depend on the components.

    Attributes
    ----------
    columns : (N, 6, m + 6 + s) array
        J by the unknowns, the residual, the twists of A, the states of the drift.
    m : int
        The number of the unknowns and the residual.
    pairs : tuple of pairs of Component
        Whose product of standard deviations is with each term.
    terms : (k, 6, 6, N) array
        Of the variance of a measurement; symmetric.
    single : bool
        Every instant has one measurement: A's noise is in the terms.
    """

    instants: Instants
    columns: Array
    m: int
    pairs: tuple[tuple[C, C], ...]
    terms: Array
    single: bool

    @staticmethod
    def of(rows: Rows, side: Side, basis: Array, directions: Array | None) -> Measurements:
        """With the directions (N, 6, s) of the drift, if there is one."""
        twist = rows.twist[side]
        parts = [rows.jacobian @ basis, rows.residual[:, :, None], twist]
        if directions is not None:
            parts.append(directions)
        single = rows.instants.count == len(twist)
        terms = white_terms(rows)
        if single:
            turning, moving = twist[:, :, :3], twist[:, :, 3:]
            terms[C.CARRIER_ROTATION, C.CARRIER_ROTATION] = turning @ turning.transpose(0, 2, 1)
            terms[C.CARRIER_TRANSLATION, C.CARRIER_TRANSLATION] = moving @ moving.transpose(0, 2, 1)
        stacked = np.ascontiguousarray(np.stack(list(terms.values())).transpose(0, 2, 3, 1))
        columns = np.concatenate(parts, axis=2)
        return Measurements(rows.instants, columns, basis.shape[1] + 1, tuple(terms), stacked, single)

    def reduced(self, sigma: dict[C, float]) -> Reduced:
        """The products of the columns at standard deviations; LinAlgError where a variance is not positive definite."""
        n, m = len(self.columns), self.m
        weights = np.array([sigma[a] * sigma[b] for a, b in self.pairs])
        variance = (weights @ self.terms.reshape(len(weights), -1)).reshape(6, 6, n)
        L = np.linalg.cholesky(variance.transpose(2, 0, 1))
        log_det = 2.0 * float(np.log(np.diagonal(L, axis1=1, axis2=2)).sum())
        root = np.ascontiguousarray(lower_inverse(np.ascontiguousarray(L.transpose(1, 2, 0))).transpose(2, 0, 1))
        Z = root @ self.columns
        flat = Z[:, :, :m].reshape(-1, m)
        total = flat.T @ flat
        cross = self.by_instant(Z[:, :, m:], Z)
        if self.single:
            return Reduced(self, sigma, root, Z, None, total, cross, log_det)
        carrier = carrier_of(sigma)
        K = np.eye(6) + cross[:, :6, m : m + 6] * carrier[:, None] * carrier
        L_K = np.linalg.cholesky(K)
        log_det += 2.0 * float(np.log(np.diagonal(L_K, axis1=1, axis2=2)).sum())
        root_K = np.linalg.inv(L_K)
        lost = (root_K * carrier) @ cross[:, :6]
        flat = lost[:, :, :m].reshape(-1, m)
        total -= flat.T @ flat
        cross -= lost[:, :, m:].transpose(0, 2, 1) @ lost
        return Reduced(self, sigma, root, Z, (root_K, lost), total, cross, log_det)

    def by_instant(self, left: Array, right: Array) -> Array:
        """Sums (T, a, b) of the products of (N, 6, a) and (N, 6, b)."""
        T, n = self.instants.count, len(left)
        if T * (n // T) == n and np.array_equal(self.instants.first, np.arange(T) * (n // T)):
            left, right = left.reshape(T, -1, left.shape[2]), right.reshape(T, -1, right.shape[2])
            products: Array = left.transpose(0, 2, 1) @ right
            return products
        products = left.transpose(0, 2, 1) @ right
        found: Array = np.add.reduceat(products, self.instants.first)
        return found

    def of_instants(self, values: Array) -> Array:
        """The values (N, ...) of each measurement's instant."""
        return values if self.single else values[self.instants.index]


@dataclass(frozen=True)
class Reduced:
    """Products with V^-1 = D^-1 - D^-1 E K^-1 E' D^-1 of each instant, and what the way back needs.

    Attributes
    ----------
    root, Z : (N, 6, 6) and (N, 6, c) arrays
        L^-1 of the variances L L', and L^-1 of the columns.
    carriers : tuple of (T, 6, 6) and (T, 6, c) arrays, or None
        L_K^-1 S_A^(1/2), and the same by E' D^-1 of the columns, where instants are shared.
    total : (m, m) array
        [J | r]' V^-1 [J | r], of all instants.
    cross : (T, 6 + s, c) array
        [E | G]' V^-1 [J | r | E | G], of each instant.
    log_det : float
        log|V|.
    """

    of: Measurements
    sigma: dict[C, float]
    root: Array
    Z: Array
    carriers: tuple[Array, Array] | None
    total: Array
    cross: Array
    log_det: float

    @property
    def carrier(self) -> Array:
        """The standard deviations (6,) of a twist of A."""
        return carrier_of(self.sigma)

    def gradient(self, by_total: Array, by_cross: Array) -> dict[C, float]:
        """d / d log sigma of log|V| and of a function of ``total`` and ``cross``, from that by their entries."""
        measurements, root, Z = self.of, self.root, self.Z
        result = dict.fromkeys(C, 0.0)
        inner = np.eye(6)
        if self.carriers is not None:
            root_K, lost = self.carriers
            carrier = self.carrier
            twists = self.cross[:, :6] * carrier[:, None]
            explained = _weighted(twists, by_total, by_cross, measurements.m) * twists
            each = 2.0 * (1.0 - (root_K**2).sum(axis=1) - explained.sum(axis=2)).sum(axis=0)
            result[C.CARRIER_ROTATION], result[C.CARRIER_TRANSLATION] = float(each[:3].sum()), float(each[3:].sum())
            E = Z[:, :, measurements.m : measurements.m + 6]
            W = E @ measurements.of_instants((root_K * carrier).transpose(0, 2, 1))
            Z = Z - W @ measurements.of_instants(lost)
            inner = inner - W @ W.transpose(0, 2, 1)
        weighted = _weighted(Z, by_total, measurements.of_instants(by_cross), measurements.m)
        by_variance = root.transpose(0, 2, 1) @ (inner - weighted @ Z.transpose(0, 2, 1)) @ root
        terms = measurements.terms.reshape(len(measurements.pairs), -1)
        found = terms @ by_variance.transpose(1, 2, 0).ravel()
        for (a, b), value in zip(measurements.pairs, found.tolist(), strict=True):
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
