"""The drift of a track: a walk of its pose in the frame of the sensor or of the target, and of its scale's logarithm.

T_target_sensor as measured is the true one times Expmap(w) (in the sensor's frame), or T_sensor_target is (in the
target's). A random walk is w_k = Ad(motion^-1) w_{k-1} + xi_k: what odometry does, whose error of a step is made where
the frame is. Its scale walks too, and stretches each step from then on, not the whole way. With a correlation time it
is w_k = phi w_{k-1} + xi_k, as errors of a detector are that vary slowly.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from rwhec_factors import se3
from scipy.linalg import cholesky_banded

from gtsam_rwhec.fitting.fit_options import C, Walk
from gtsam_rwhec.fitting.noise_rows import Rows
from gtsam_rwhec.geometry.poses import Array

#: A state has rotation, translation, and the logarithm of the scale.
TRACK = 7
#: What a standard deviation of zero stands for: rad or m, and as a share of the other's.
SMALLEST, SMALLEST_SHARE = 1e-12, 1e-4


@dataclass(frozen=True)
class DriftPrior:
    """The walk of all tracks' states from instant to instant."""

    #: (T - 1, s, s): From the state of one instant to that of the next.
    transport: Array
    #: (T, s): Of the steps, in those of a typical step.
    variance: Array
    #: (T - 1,): Whether an instant continues the one before.
    linked: np.ndarray
    walk: Walk

    @property
    def correlation(self) -> float:
        """Of errors from one step to the next; 1 is a random walk."""
        return self.walk.correlation

    @property
    def states(self) -> int:
        """The number of states of an instant."""
        return int(self.transport.shape[1])

    @staticmethod
    def of(rows: Rows, walk: Walk) -> DriftPrior:
        """A random walk from the first instant on (correlation 1), or a stationary one."""
        instants, correlation = rows.instants, walk.correlation
        T, s = instants.count, TRACK * instants.chains
        linked = instants.step[1:] > 0.0
        step = np.where(instants.step > 0.0, instants.step, 1.0)
        transport = np.zeros((T - 1, s, s))
        variance = np.repeat(step[:, None], s, axis=1)
        if correlation < 1.0:
            phi = correlation ** step[1:]
            transport[:] = np.eye(s) * phi[:, None, None]
            variance[1:] = (1.0 - phi**2)[:, None]
            variance[np.r_[True, ~linked]] = 1.0
        else:
            transport[:] = np.eye(s)
        if walk.is_of_a_trajectory:
            for chain in range(instants.chains):
                own = np.flatnonzero(instants.chain == chain)
                at, first_of = np.unique(instants.index[own], return_index=True)
                poses = (rows.carriers if walk.is_shared else rows.predicted)[own[first_of]]
                if walk.frame in ("target", "targetcarrier"):
                    poses = se3.inverse(poses)
                back = poses[1:] @ se3.inverse(poses[:-1])  # motion^-1, motion = T_before_after
                first = TRACK * chain
                transport[at[1:] - 1, first : first + 6, first : first + 6] = se3.adjoint(back)
                transport[at[1:] - 1, first + 3 : first + 6, first + 6] = back[:, :3, 3]
        transport[~linked] = 0.0
        return DriftPrior(transport, variance, linked, walk)

    def factor(self, added: Array, sigma: dict[C, float]) -> tuple[ChainFactor, float]:
        """Of the unit states' precision, with the measurements' (T, s, s) ``added``; log|precision| - log|prior|."""
        F, weight = self.unit_transport(sigma), 1.0 / self.variance
        diagonal = added.copy()
        states = np.arange(self.states)
        diagonal[:, states, states] += weight
        weighted = F * weight[1:, :, None]
        diagonal[:-1] += F.transpose(0, 2, 1) @ weighted
        factor = ChainFactor.of(diagonal, -weighted)
        return factor, factor.log_det - float(np.log(weight).sum())

    def gradient(self, own: Array, below: Array, sigma: dict[C, float]) -> dict[C, float]:
        """d(-2l) / d log sigma = sum 2 (1 - E[xi^2] / variance), xi the unit steps (Fisher's identity).

        ``own`` (T, s, s) and ``below`` (T - 1, s, s) are E[w_t w_t'] and E[w_t+1 w_t'] of the unit states.
        """
        F = self.unit_transport(sigma)
        square = np.einsum("tii->ti", own).copy()
        square[1:] += ((F @ own[:-1] - 2.0 * below) * F).sum(axis=2)
        by_state = 2.0 * (1.0 - square / self.variance).sum(axis=0).reshape(-1, TRACK).sum(axis=0)
        return {
            C.DRIFT_ROTATION: float(by_state[:3].sum()),
            C.DRIFT_TRANSLATION: float(by_state[3:6].sum()),
            C.DRIFT_SCALE: float(by_state[6]),
        }

    def walked(self, states: Array, kinds: Array, sigma: dict[C, float]) -> Array:
        """The part (T, s, k) of the unit states (T, s) that the steps of some kinds (s, k) make."""
        F = self.unit_transport(sigma)
        steps = states.copy()
        steps[1:] -= (F @ states[:-1, :, None])[:, :, 0]
        result: Array = steps[:, :, None] * kinds
        for before, after, here in zip(result[:-1], result[1:], F, strict=True):
            after += here @ before
        return result

    def unit_transport(self, sigma: dict[C, float]) -> Array:
        """``transport`` between states in the units of their own steps' standard deviations."""
        unit = np.tile(unit_of(sigma), self.states // TRACK)
        found: Array = self.transport * (unit / unit[:, None])
        return found


def unit_of(sigma: dict[C, float]) -> Array:
    """Standard deviations (7,) of a track's step. Those that are zero stand for something very small.

    The transport turns rotations into translations of so many units, so these must not differ without bounds.
    """
    rotation, translation, scale = sigma[C.DRIFT_ROTATION], sigma[C.DRIFT_TRANSLATION], sigma[C.DRIFT_SCALE]
    least = max(SMALLEST_SHARE * max(rotation, translation), SMALLEST)
    found: Array = np.repeat([rotation or least, translation or least, scale or SMALLEST], [3, 3, 1])
    return found


def drift_columns(rows: Rows, sigma: dict[C, float], prior: DriftPrior) -> Array:
    """G (N, 6, s): the residual's change by the unit states of its instant."""
    own = own_directions(rows, prior) * unit_of(sigma)
    result = np.zeros((len(own), 6, rows.instants.chains, TRACK))
    result[np.arange(len(own)), :, rows.instants.chain] = own
    return result.reshape(len(own), 6, -1)


def own_directions(rows: Rows, prior: DriftPrior) -> Array:
    """The residual's change (N, 6, 7) by its own track's state in rad, m and the logarithm of the scale."""
    N = len(rows.residual)
    own = np.zeros((N, 6, TRACK))
    frame = prior.walk.frame
    back = se3.inverse(rows.predicted)
    if frame == "targetcarrier" or frame == "sensorcarrier":
        own[:, :, :6] = rows.twist[frame]
    elif frame == "sensor":
        own[:, :, :6] = se3.adjoint(back)
    else:
        own[:, :3, :3] = np.eye(3)
        own[:, 3:, 3:6] = np.eye(3) if frame == "target" else back[:, :3, :3]
    if not prior.walk.is_of_a_trajectory:
        own[:, 3:, 6] = rows.length
    return own


@dataclass(frozen=True)
class ChainFactor:
    """The Cholesky factor L of a precision P = L L' of T states of s numbers, each tied to the one before."""

    #: (T, s, s): Of the blocks L_tt.
    inverse: Array
    #: (T - 1, s, s): The blocks L_t+1,t.
    below: Array
    #: log|P|.
    log_det: float

    @staticmethod
    def of(diagonal: Array, below: Array) -> ChainFactor:
        """Of the precision's blocks P_tt (T, s, s) and P_t+1,t (T - 1, s, s); LinAlgError if it is not definite."""
        T, s = diagonal.shape[:2]
        banded = np.zeros((2 * s, T, s))
        for j in range(s):
            banded[: s - j, :, j] = diagonal[:, j:, j].T
            banded[s - j : 2 * s - j, :-1, j] = below[:, :, j].T
        banded = cholesky_banded(banded.reshape(2 * s, T * s), lower=True, overwrite_ab=True, check_finite=False)
        by_row = banded.reshape(2 * s, T, s)
        own, before = np.zeros((s, s, T)), np.empty((T - 1, s, s))
        for j in range(s):
            own[j:, j] = by_row[: s - j, :, j]
            before[:, :, j] = by_row[s - j : 2 * s - j, :-1, j].T
        log_det = 2.0 * float(np.log(banded[0]).sum())
        return ChainFactor(np.ascontiguousarray(lower_inverse(own).transpose(2, 0, 1)), before, log_det)

    def half(self, own: Array) -> Array:
        """L^-1 B (T, s, c) in place of ``own``, which has L_tt^-1 B_t."""
        step = self.inverse[1:] @ self.below
        change, last = np.empty(own.shape[1:]), own[0]
        for here, S in zip(own[1:], step, strict=True):
            here -= np.dot(S, last, change)
            last = here
        return own

    def whole(self, half: Array) -> Array:
        """P^-1 B (T, s, c), from L^-1 B."""
        result: Array = self.inverse.transpose(0, 2, 1) @ half
        change, last = np.empty(result.shape[1:]), result[-1]
        for here, S in zip(result[-2::-1], self._gain[::-1], strict=True):
            here -= np.dot(S.T, last, change)
            last = here
        return result

    def inverse_blocks(self) -> tuple[Array, Array]:
        """The blocks (P^-1)_tt (T, s, s) and (P^-1)_t+1,t (T - 1, s, s)."""
        own: Array = self.inverse.transpose(0, 2, 1) @ self.inverse
        gain = self._gain
        below = np.empty_like(gain)
        change, last = np.empty(own.shape[1:]), own[-1]
        for here, S, mixed in zip(own[-2::-1], gain[::-1], below[::-1], strict=True):
            np.dot(last, S, mixed)
            here += np.dot(S.T, mixed, change)
            last = here
        return own, -below

    @property
    def _gain(self) -> Array:
        found: Array = self.below @ self.inverse[:-1]
        return found


def lower_inverse(L: Array) -> Array:
    """The inverses of lower triangles (n, n, N), N at once."""
    result = np.zeros_like(L)
    for i in range(len(L)):
        result[i, i] = 1.0 / L[i, i]
        if i:
            result[i, :i] = np.einsum("jn,jkn->kn", L[i, :i], result[:i, :i]) * -result[i, i]
    return result


@dataclass(frozen=True)
class EliminatedDrift:
    """What the elimination of the drift leaves."""

    prior: DriftPrior
    sigma: dict[C, float]
    #: Of the precision of the unit states.
    factor: ChainFactor
    #: (T, s, q + m): L^-1 of their products with the columns of the systematic errors, the unknowns and the residual.
    half: Array
    #: (s,): The states' standard deviations.
    unit: Array
    #: (6,): Standard deviations of the systematic errors.
    systematic: Array
    #: (T, k): f of each instant; the columns of the systematic errors are E f.
    features: Array
    #: log|precision| - log|prior precision|.
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
