"""All measurements of a pair in one factor of at most 25 rows: exactly the certified cost (design fact 2).

The chordal cost of any number of measurements is one quadratic form x' Q x (RWHEC paper, eqs. 24-42) of

    x = [s (t_X - c), s (t_Y - a), s, vec R_X, vec R_Y]

with the scale s, the origins c (target's carrier) and a (sensor's carrier), and vec stacking columns. With 2 Q = L' L
the residual L x has the cost 1/2 |L x|^2, the gradient and the Gauss-Newton Hessian of all the measurements together.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from rwhec_factors.arguments import check_keys, checked_pairs, number_of, pose_of
from rwhec_factors.se3 import HATS, Array

#: This number of measurements is summed at once, which bounds the memory.
BLOCK = 4096
#: Eigenvalues of the scaled Q below this share of the largest are rounding error and make no row.
ROUNDING = 1e-15

T_X, T_Y, SCALE, R_X, R_Y = slice(0, 3), slice(3, 6), 6, slice(7, 16), slice(16, 25)


@dataclass(frozen=True)
class EdgeSummary:
    """A pair's measurements as one quadratic form. ``a + b`` holds the measurements of both, about a's origins."""

    #: (25, 25): Q: x' Q x is the cost 1/2 sum (kappa |R_A R_X - R_Y R_B|_F^2 + |s (R_A t_X + t_A - t_Y) - R_Y t_B|^2 /
    #: sigma^2)
    form: Array
    count: int  #: Number of measurements
    #: (3,): c and a, in metres: t_X and t_Y are relative to them. Origins near the poses keep the form's digits.
    target_origin: Array = field(default_factory=lambda: np.zeros(3))
    sensor_origin: Array = field(default_factory=lambda: np.zeros(3))

    @staticmethod
    def of(
        A: ArrayLike,
        B: ArrayLike,
        sigma: ArrayLike,
        kappa: ArrayLike,
        *,
        target_origin: ArrayLike = (0.0, 0.0, 0.0),
        sensor_origin: ArrayLike = (0.0, 0.0, 0.0),
    ) -> EdgeSummary:
        """Summarise measurements A X = Y B.

        Parameters
        ----------
        A, B : (N, 4, 4) arrays or lists of gtsam.Pose3
            T_sensorcarrier_targetcarrier and T_sensor_target; metres (B's times the scale).
        sigma, kappa : float or (N,)
            Standard deviation of B's translation, m an axis; concentration of its rotation, 1 / (2 s^2) for s rad an
            axis.
        target_origin, sensor_origin : (3,), optional
            A point in each carrier near which the poses are.

        Raises
        ------
        ValueError
            If the shapes of A and B differ, an entry is not finite, or a weight is not positive and finite.
        """
        A, B = checked_pairs(A, B)
        weights = []
        for name, value in (("sigma", sigma), ("kappa", kappa)):
            weight = np.asarray(value, dtype=np.float64)
            if weight.shape not in ((), (len(A),)):
                raise ValueError(f"{name} has shape {weight.shape}; give one number, or one for each of {len(A)}")
            if not (np.isfinite(weight).all() and (weight > 0.0).all()):
                raise ValueError(f"{name} is {value!r}; it must be positive and finite")
            weights.append(np.broadcast_to(weight, len(A)))
        c, a = np.asarray(target_origin, dtype=np.float64), np.asarray(sensor_origin, dtype=np.float64)
        form = np.zeros((25, 25))
        for first in range(0, len(A), BLOCK):
            part = slice(first, first + BLOCK)
            rows = _rows(A[part], B[part], 1.0 / weights[0][part], np.sqrt(weights[1][part]), c, a)
            form += 0.5 * rows.T @ rows
        return EdgeSummary(form, len(A), c, a)

    def about(self, target_origin: Array, sensor_origin: Array) -> EdgeSummary:
        """The same form about other origins, exact but for rounding (origins far away cost digits)."""
        shift = np.eye(25)
        shift[T_X, SCALE] = target_origin - self.target_origin
        shift[T_Y, SCALE] = sensor_origin - self.sensor_origin
        return EdgeSummary(shift.T @ self.form @ shift, self.count, target_origin, sensor_origin)

    def __add__(self, other: EdgeSummary) -> EdgeSummary:
        if not isinstance(other, EdgeSummary):
            return NotImplemented
        moved = other.about(self.target_origin, self.sensor_origin)
        return EdgeSummary(self.form + moved.form, self.count + other.count, self.target_origin, self.sensor_origin)


def _rows(A: Array, B: Array, root_weight: Array, root_kappa: Array, c: Array, a: Array) -> Array:
    """Whitened rows (12 N, 25): M_R (eq. 25) and M_t (eq. 30), about the origins."""
    count = len(A)
    R_A, R_B, t_B = A[:, :3, :3], B[:, :3, :3], B[:, :3, 3]
    t_A = A[:, :3, 3] + R_A @ c - a
    I3 = np.eye(3)
    M = np.zeros((count, 4, 3, 25))  # three columns of the rotation residual, then the translation residual
    for j in range(3):  # column j: R_A R_X e_j - R_Y R_B e_j
        M[:, j, :, 7 + 3 * j : 10 + 3 * j] = R_A
        M[:, j, :, R_Y] = -np.einsum("nk,il->nikl", R_B[:, :, j], I3).reshape(count, 3, 9)
    M[:, :3] *= root_kappa[:, None, None, None]
    M[:, 3, :, T_X], M[:, 3, :, T_Y], M[:, 3, :, SCALE] = R_A, -I3, t_A
    M[:, 3, :, R_Y] = -np.einsum("nk,il->nikl", t_B, I3).reshape(count, 3, 9)
    M[:, 3] *= root_weight[:, None, None]
    return M.reshape(12 * count, 25)


def square_root(form: Array) -> Array:
    """L (r, 25), r <= 25, with L' L = 2 Q.

    Q is scaled to a unit diagonal first: weights of translations and rotations may be orders of magnitude apart.

    Raises
    ------
    ValueError
        If the form is not finite, or not positive semidefinite up to rounding.
    """
    form = np.asarray(form, dtype=np.float64)
    if form.shape != (25, 25) or not np.isfinite(form).all():
        raise ValueError(
            f"the form has shape {form.shape}, or entries that are not finite; give EdgeSummary.of(A, B, sigma, kappa)"
        )
    doubled = form + form.T
    diagonal = np.diagonal(doubled)
    size = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(doubled / size[:, None] / size)
    largest = values[-1]
    if values[0] < -1e-9 * max(largest, 1e-300):
        raise ValueError(
            f"the form is not positive semidefinite (eigenvalue {values[0]:.3g} after scaling); "
            "give EdgeSummary.of(A, B, sigma, kappa)"
        )
    kept = values > ROUNDING * largest
    root: Array = (np.sqrt(values[kept]) * vectors[:, kept]).T * size
    return root


def edge_summary_factor(
    target_key: int, sensor_key: int, summary: EdgeSummary, *, scale_key: int | None = None
) -> gtsam.CustomFactor:
    """All measurements of a target by a sensor as one factor, with the chordal residual of the certified cost.

    Parameters
    ----------
    target_key, sensor_key : int
        Keys of X = T_targetcarrier_target and Y = T_sensorcarrier_sensor, Pose3, true metres.
    summary : EdgeSummary
    scale_key : int, optional
        Key of a 1-vector: t_B = scale * (true length); 1 when left out.

    Returns
    -------
    gtsam.CustomFactor
        At most 25 rows, unit noise; the weights are in the summary. A robust loss weighs single measurements, so it
        needs single factors; or re-weight the measurements and summarise them anew.

    Raises
    ------
    ValueError, TypeError
        If two keys are equal (motions of one sensor take ``hand_eye_summary_factor``), or the summary is not valid.
    """
    check_keys([target_key, sensor_key])
    return _summary_factor([target_key, sensor_key], summary, scale_key)


def hand_eye_summary_factor(
    sensor_key: int, summary: EdgeSummary, *, scale_key: int | None = None
) -> gtsam.CustomFactor:
    """All motions of one sensor, A Y = Y B (AX = XB), as one factor; A and B both T_before_after.

    Parameters, result and errors are ``edge_summary_factor``'s, with Y for both poses and one origin for both carriers.
    """
    if isinstance(summary, EdgeSummary) and not np.array_equal(summary.target_origin, summary.sensor_origin):
        summary = summary.about(summary.sensor_origin, summary.sensor_origin)
    return _summary_factor([sensor_key], summary, scale_key)


def _summary_factor(ends: list[int], summary: EdgeSummary, scale_key: int | None) -> gtsam.CustomFactor:
    if not isinstance(summary, EdgeSummary):
        raise TypeError(f"the summary is a {type(summary).__name__}; give EdgeSummary.of(A, B, sigma, kappa)")
    keys = ends + ([] if scale_key is None else [scale_key])
    check_keys(keys)
    L = square_root(summary.form)
    origins = (summary.target_origin, summary.sensor_origin)
    names = ("X = T_targetcarrier_target", "Y = T_sensorcarrier_sensor")
    first_of = ((T_X, R_X), (T_Y, R_Y))
    parts = [(np.ascontiguousarray(L[:, t]), np.ascontiguousarray(L[:, R])) for t, R in first_of]
    if len(ends) == 1:
        names = (names[1], names[1])

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Any] | None) -> Array:
        poses = [pose_of(values, key, name) for key, name in zip((ends[0], ends[-1]), names, strict=True)]
        scale = 1.0 if scale_key is None else number_of(values, scale_key, "the scale")
        x = np.empty(25)
        x[SCALE] = scale
        for pose, origin, (t, R) in zip(poses, origins, first_of, strict=True):
            x[t] = scale * (pose.translation() - origin)
            x[R] = pose.rotation().matrix().ravel(order="F")
        if jacobians is not None:
            blocks = []
            for pose, (L_t, L_R) in zip(poses, parts, strict=True):
                R_pose = pose.rotation().matrix()
                block = np.empty((len(L), 6), order="F")
                block[:, :3] = -L_R @ (R_pose @ HATS).reshape(9, 3)
                block[:, 3:] = L_t @ (scale * R_pose)
                blocks.append(block)
            if len(ends) == 1:
                blocks = [blocks[0] + blocks[1]]
            for i, block in enumerate(blocks):
                jacobians[i] = block
            if scale_key is not None:  # x's first seven entries are scale times something
                metres = np.r_[poses[0].translation() - origins[0], poses[1].translation() - origins[1], 1.0]
                jacobians[len(blocks)] = np.asfortranarray((L[:, :7] @ metres)[:, None])
        return L @ x

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(L)), keys, error)
