"""The curvature of the restricted likelihood by the components, as the average of the observed and the expected one.

For -2 l and V_i = dV / d log sigma_i it is a_ij = (V_i P r)' P (V_j P r) (Gilmour, Thompson and Cullis 1995). For an
effect with the columns Z, V_i P r = 2 Z times its part of the predicted effect, so what is needed beside the
likelihood is its elimination of one more column for each component. It is never indefinite.
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.noise_model.components import C
from gtsam_rwhec.noise_model.drift import TRACK
from gtsam_rwhec.noise_model.gradient import Eliminated

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
