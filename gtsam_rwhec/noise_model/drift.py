"""The drift of a track: a walk of its pose in the frame of the sensor or of the target, and of its scale's logarithm.

T_target_sensor as measured is the true one times Expmap(w) (in the sensor's frame), or T_sensor_target is (in the
target's). A random walk is w_k = Ad(motion^-1) w_{k-1} + xi_k: what odometry does, whose error of a step is made where
the frame is. With a correlation time it is w_k = phi w_{k-1} + xi_k, as errors of a detector are that vary slowly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.noise_model.components import C
from gtsam_rwhec.noise_model.rows import Rows
from gtsam_rwhec.noise_model.tridiagonal import ChainFactor

#: A state has rotation, translation, and the logarithm of the scale.
TRACK = 7
#: What a standard deviation of zero stands for: rad or m, and as a share of the other's.
SMALLEST, SMALLEST_SHARE = 1e-12, 1e-4


#: Whose frame an error is made in; "detection": rotations in the target's axes, translations along the sensor's.
Frame = Literal["sensor", "target", "detection"]


class Walk(NamedTuple):
    """A kind of drift: the correlation of errors from step to step (1: a random walk), and whose frame they are in."""

    correlation: float
    frame: Frame


@dataclass(frozen=True)
class DriftPrior:
    """The walk of all tracks' states from instant to instant.

    Attributes
    ----------
    transport : (T - 1, s, s) array
        From the state of one instant to that of the next.
    variance : (T, s) array
        Of the steps, in those of a typical step.
    linked : (T - 1,) array
        Whether an instant continues the one before.
    walk : Walk
    """

    transport: Array
    variance: Array
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
        if correlation == 1.0 and walk.frame != "detection":
            for chain in range(instants.chains):
                own = np.flatnonzero(instants.chain == chain)
                at, first_of = np.unique(instants.index[own], return_index=True)
                poses = rows.predicted[own[first_of]]
                if walk.frame == "target":
                    poses = se3.inverse(poses)
                motion = se3.adjoint(poses[1:] @ se3.inverse(poses[:-1]))  # Ad(motion^-1), motion = T_before_after
                first = TRACK * chain
                transport[at[1:] - 1, first : first + 6, first : first + 6] = motion
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
    found: Array = drift_directions(rows, prior) * np.tile(unit_of(sigma), rows.instants.chains)
    return found


def drift_directions(rows: Rows, prior: DriftPrior) -> Array:
    """The same by states in rad, m and logarithms of the scale."""
    own, N = own_directions(rows, prior), len(rows.residual)
    if rows.instants.chains == 1:
        return own
    result = np.zeros((N, 6, rows.instants.chains, TRACK))
    result[np.arange(N), :, rows.instants.chain] = own
    return result.reshape(N, 6, -1)


def own_directions(rows: Rows, prior: DriftPrior) -> Array:
    """The same (N, 6, 7) by the states of each measurement's own track."""
    N = len(rows.residual)
    own = np.zeros((N, 6, TRACK))
    back = se3.inverse(rows.predicted)
    if prior.walk.frame == "sensor":
        own[:, :, :6] = se3.adjoint(back)
    else:
        own[:, :3, :3] = np.eye(3)
        own[:, 3:, 3:6] = np.eye(3) if prior.walk.frame == "target" else back[:, :3, :3]
    own[:, 3:, 6] = rows.length
    return own
