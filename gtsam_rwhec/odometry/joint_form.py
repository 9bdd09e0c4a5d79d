"""The joint quadratic cost of all sensors' motions, which is certified (design fact 24).

With w_k the rotation vector and s_k the translation of sensor k over a window, and R_0 = I, t_0 = 0:

    R_k w_k                                     is the vehicle's rotation vector, for every sensor,
    R_k s_k + (I - V) t_k                       its translation, for every sensor of known scale,
    R_k s_k + (I - V) t'_k - alpha_k v = 0      for a sensor of unknown scale alpha_k, t' = alpha t.

The vehicle's rotation vector and translation are eliminated: residuals are the differences from the weighted mean, so
every pair of sensors counts and loops are consistent. V and v are the fused motion at the estimate before, and given
here. What is left is a quadratic form of y = [vec R_k, t_k, alpha_k, 1], with R_k the only constrained numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.unknowns import State
from gtsam_rwhec.odometry.window_motions import WindowMotions
from gtsam_rwhec.solver.reduced_form import ReducedForm, generalised_inverse_factor

I3 = np.eye(3)


@dataclass(frozen=True)
class JointForm:
    """x' Q x over y = [vec R_1, ..., vec R_K, t_1, ..., t_K, alpha of the scaled sensors, 1], the cost with its 1/2.

    Attributes
    ----------
    Q : (d, d) array
    sensors : int
        K: all but sensor 0.
    scaled : (s,) integers
        Which of the K have an unknown scale (0 is the first after sensor 0).
    """

    Q: Array
    sensors: int
    scaled: np.ndarray

    @cached_property
    def _of_rotations(self) -> np.ndarray:
        """Numbers of the rotations' entries and of the constant."""
        numbers: np.ndarray = np.r_[np.arange(9 * self.sensors), len(self.Q) - 1]
        return numbers

    @cached_property
    def _linear(self) -> np.ndarray:
        """Numbers of translations and scales."""
        return np.arange(9 * self.sensors, len(self.Q) - 1)

    @cached_property
    def _eliminated(self) -> tuple[Array, Array]:
        """The best translations and scales as a matrix times [vec R, 1], and the reduced form."""
        r, t = self._of_rotations, self._linear
        factor, _ = generalised_inverse_factor(self.Q[np.ix_(t, t)])
        rows = factor.T @ self.Q[np.ix_(t, r)]
        reduced = self.Q[np.ix_(r, r)] - rows.T @ rows
        return -factor @ rows, 0.5 * (reduced + reduced.T)

    @property
    def reduced(self) -> ReducedForm:
        """The form of the rotations alone, for the search."""
        return ReducedForm.of_rotations(self._eliminated[1])

    def with_scales_near(self, scale: Array, share: float) -> JointForm:
        """The form with a row for each unknown scale (K,): off by ``share`` of it costs a half, as one deviation does.

        A mirror image has a negative scale (design fact 5) and may cost less where the vehicle turned about one axis.
        """
        Q = self.Q.copy()
        for i, k in enumerate(self.scaled):
            row = np.zeros(len(Q))
            row[12 * self.sensors + i], row[-1] = 1.0 / (share * scale[k]), -1.0 / share
            Q += 0.5 * np.outer(row, row)
        return JointForm(Q, self.sensors, self.scaled)

    def completed(self, x: Array) -> Array:
        """y (d,) from x = [vec R, 1]: the best translations and scales."""
        y: Array = np.r_[x[:-1], self._eliminated[0] @ x, 1.0]
        return y

    def poses(self, y: Array) -> tuple[Array, Array]:
        """Poses (K, 4, 4) and scales (K,) of an answer; a scaled sensor's translation is divided by its scale."""
        K = self.sensors
        R = y[: 9 * K].reshape(K, 3, 3).transpose(0, 2, 1)
        scale = np.ones(K)
        scale[self.scaled] = y[12 * K : -1]
        T = np.tile(np.eye(4), (K, 1, 1))
        T[:, :3, :3], T[:, :3, 3] = R, y[9 * K : 12 * K].reshape(K, 3) / scale[:, None]
        return T, scale


def joint_form(
    windows: WindowMotions, state: State, variances: Array, scaled: np.ndarray, prior_rows: Array | None = None
) -> JointForm:
    """The form at given turns and ways of the windows, those of ``state.motion``.

    Parameters
    ----------
    variances : (m, 2) array
        Noise of rotation and translation a second.
    scaled : (m,) booleans
    prior_rows : (q, d) array, optional
        Rows over y, whitened: what a person gives.
    """
    m, n = windows.used.shape
    K = m - 1
    which = np.flatnonzero(scaled[1:])
    d = 12 * K + len(which) + 1
    w, s, used = windows.rotation_vectors(), windows.M[..., :3, 3], windows.used
    V, v = state.motion[:, :3, :3], state.motion[:, :3, 3]
    of_rotation = used / (windows.length * variances[:, :1] + ~used)
    # The rotation's noise moves the way that is still to go: its mean square distance counts.
    turned = 2.0 / 3.0 * variances[:, :1] * np.einsum("mnii->mn", windows.second)
    of_translation = used / (windows.length * variances[:, 1:] + turned + ~used)

    E = np.zeros((m, n, 3, d))
    for k in range(m):
        if k:
            E[k, :, :, 9 * k - 9 : 9 * k] = _times(w[k])
        else:
            E[k, :, :, -1] = w[k]
    rows = [_contrasts(E, of_rotation)]

    E = np.zeros((m, n, 3, d))
    for k in range(m):
        if k:
            E[k, :, :, 9 * k - 9 : 9 * k] = _times(s[k])
            E[k, :, :, 9 * K + 3 * k - 3 : 9 * K + 3 * k] = I3 - V
        else:
            E[k, :, :, -1] = s[k]
    metric = ~scaled
    rows.append(_contrasts(E[metric], of_translation[metric]))
    # v is known from the sensors of known scale; its noise is that of their mean.
    of_v = 1.0 / np.maximum(of_translation[metric].sum(axis=0), 1e-300)
    has_v = used[metric].any(axis=0)
    for i, k in enumerate((which + 1).tolist()):
        E[k, :, :, 12 * K + i] = -v
        weight = has_v / (1.0 / np.where(used[k], of_translation[k], 1.0) + state.scale[k] ** 2 * of_v) * used[k]
        rows.append((np.sqrt(weight)[:, None, None] * E[k]).reshape(-1, d))
    if prior_rows is not None and len(prior_rows):
        rows.append(prior_rows)
    Q = np.zeros((d, d))
    for part in rows:
        Q += 0.5 * part.T @ part
    return JointForm(0.5 * (Q + Q.T), K, which)


def _times(w: Array) -> Array:
    """(n, 3, 9): R w is this times vec R, which stacks columns."""
    matrix: Array = np.einsum("nj,ik->nijk", w, I3).reshape(len(w), 3, 9)
    return matrix


def _contrasts(E: Array, weight: Array) -> Array:
    """Whitened differences from the weighted mean over sensors: (m n 3, d) from (m, n, 3, d) and weights (m, n)."""
    total = weight.sum(axis=0)
    mean = np.einsum("mn,mnid->nid", weight, E) / np.where(total > 0.0, total, 1.0)[:, None, None]
    rows: Array = (np.sqrt(weight)[:, :, None, None] * (E - mean)).reshape(-1, E.shape[-1])
    return rows
