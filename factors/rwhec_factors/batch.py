"""All measurements of a pair at once: residuals and Jacobians, vectorised, and one factor that holds them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import gtsam
import numpy as np

from rwhec_factors import se3
from rwhec_factors.se3 import Array
from rwhec_factors.values import number_of, pose_of

Residual = Literal["geodesic", "chordal"]


@dataclass(frozen=True)
class Linearization:
    """Residuals of N measurements and what they do to first order.

    m is 6 (geodesic) or 12 (chordal). residual (N, m); by right perturbations of X, Y and A: target, sensor, carrier
    (N, m, 6); by the scale and by the time offset: scale, offset (N, m).
    """

    residual: Array
    target: Array
    sensor: Array
    scale: Array
    offset: Array
    carrier: Array


@dataclass(frozen=True)
class BatchResiduals:
    """Measurements of one pair, A X = Y B.

    Attributes
    ----------
    A, B : (N, 4, 4) arrays or lists of gtsam.Pose3
        T_sensorcarrier_targetcarrier and T_sensor_target; metres (B's times the scale).
    residual : "geodesic" or "chordal"
        Log(B^-1 S(Y^-1 A X)), (6,), with S(R, t) = (R, scale t); or (12,) [vec(R_A R_X - R_Y R_B),
        scale (R_A t_X + t_A - t_Y) - R_Y t_B] (RWHEC paper, eq. 18, in true metres).
    twists : (N, 6) array, optional
        A(t + d) = A Expmap(d twist), [omega rad/s, v m/s].
    """

    A: Array
    B: Array
    residual: Residual = "geodesic"
    twists: Array | None = None

    def linearize(self, X: Array, Y: Array, scale: float = 1.0, offset_s: float = 0.0) -> Linearization:
        """Residuals and Jacobians at X, Y (4, 4), a scale and a time offset in seconds."""
        A = self._moved(offset_s)
        predicted = np.linalg.inv(Y) @ A @ X  # B as the extrinsics have it, in true metres
        # Right perturbations of predicted: X's as it is, Y's by -Ad(predicted^-1), A's by Ad(X^-1).
        by_sensor = -se3.adjoint(se3.inverse(predicted))
        by_carrier = se3.adjoint(np.linalg.inv(X)[None])[0]
        if self.residual == "geodesic":
            value, by_predicted, by_scale = self._geodesic(predicted, scale)
        else:
            value, by_predicted, by_scale = self._chordal(predicted, Y, scale)
        target = by_predicted
        sensor = by_predicted @ by_sensor
        if self.residual == "chordal":  # Y stands outside the prediction too: the residual is turned by R_Y
            sensor = sensor + self._chordal_turning(value, Y)
        carrier = by_predicted @ by_carrier
        offset = np.zeros_like(value) if self.twists is None else np.einsum("nmi,ni->nm", carrier, self.twists)
        return Linearization(value, target, sensor, by_scale, offset, carrier)

    def residuals(self, X: Array, Y: Array, scale: float = 1.0, offset_s: float = 0.0) -> Array:
        """Residuals (N, m) alone."""
        predicted = np.linalg.inv(Y) @ self._moved(offset_s) @ X
        if self.residual == "geodesic":
            predicted[:, :3, 3] *= scale
            return se3.logmap(se3.inverse(self.B) @ predicted)
        return self._chordal_value(predicted, Y, scale)

    def _moved(self, offset_s: float) -> Array:
        if self.twists is None or offset_s == 0.0:
            return self.A
        moved: Array = self.A @ se3.expmap(offset_s * self.twists)
        return moved

    def _geodesic(self, predicted: Array, scale: float) -> tuple[Array, Array, Array]:
        scaled = predicted.copy()
        scaled[:, :3, 3] *= scale
        value = se3.logmap(se3.inverse(self.B) @ scaled)
        inverse_jacobian = se3.right_jacobian_inverse(value)
        by_predicted = inverse_jacobian * np.r_[1.0, 1.0, 1.0, scale, scale, scale]
        # d(scale t) = t dscale is v = R' t dscale
        direction = np.einsum("nji,nj->ni", predicted[:, :3, :3], predicted[:, :3, 3])
        return value, by_predicted, np.einsum("nmi,ni->nm", inverse_jacobian[:, :, 3:], direction)

    def _chordal_value(self, predicted: Array, Y: Array, scale: float) -> Array:
        R_Y = Y[:3, :3]
        rotation = R_Y @ (predicted[:, :3, :3] - self.B[:, :3, :3])
        translation = (scale * predicted[:, :3, 3] - self.B[:, :3, 3]) @ R_Y.T
        return np.concatenate([rotation.transpose(0, 2, 1).reshape(-1, 9), translation], axis=1)

    def _chordal(self, predicted: Array, Y: Array, scale: float) -> tuple[Array, Array, Array]:
        value = self._chordal_value(predicted, Y, scale)
        R = Y[:3, :3] @ predicted[:, :3, :3]  # R_A R_X
        by_predicted = np.zeros((len(value), 12, 6))
        for i in range(3):  # d vec(R hat(omega)): column i of hat(omega) is omega x e_i
            by_predicted[:, 3 * i : 3 * i + 3, :3] = -R @ se3.hat(np.eye(3)[i])
        by_predicted[:, 9:, 3:] = scale * R
        by_scale = np.zeros_like(value)
        by_scale[:, 9:] = predicted[:, :3, 3] @ Y[:3, :3].T
        return value, by_predicted, by_scale

    def _chordal_turning(self, value: Array, Y: Array) -> Array:
        """By Y's right perturbation with the prediction held: R_Y Expmap(omega) u, u = R_Y' value, column by column."""
        R_Y = Y[:3, :3]
        result = np.zeros((len(value), 12, 6))
        for block in range(4):
            rows = slice(3 * block, 3 * block + 3)
            result[:, rows, :3] = -R_Y @ se3.hat(value[:, rows] @ R_Y)
        return result


def robot_world_hand_eye_batch_factor(
    target_key: int,
    sensor_key: int,
    A: Array,
    B: Array,
    sqrt_information: Array,
    *,
    scale_key: int | None = None,
    time_offset_key: int | None = None,
    twists: Array | None = None,
    residual: Residual = "geodesic",
) -> gtsam.CustomFactor:
    """All measurements of one pair in one factor, evaluated at once: what N single factors cost, far faster.

    Parameters
    ----------
    target_key, sensor_key : int
        Keys of X = T_targetcarrier_target and Y = T_sensorcarrier_sensor, Pose3. One key for both makes every
        measurement A Y = Y B (AX = XB), A and B both T_before_after.
    A, B : (N, 4, 4) arrays or lists of gtsam.Pose3
        T_sensorcarrier_targetcarrier and T_sensor_target; metres.
    sqrt_information : (6, 6) or (N, 6, 6) array
        W with W' W the information of B's right perturbation, rotation first. For the chordal residual W must be
        diag(a, a, a, b, b, b): a = sqrt(2 kappa) 1/rad, b = 1/sigma 1/m.
    scale_key : int, optional
        Key of a 1-vector: t_B = scale * (true length).
    time_offset_key : int, optional
        Key of a 1-vector, in seconds: B's stamp t is the carriers' t + offset. Needs ``twists``.
    twists : (N, 6) array, optional
        The carriers' velocity at each stamp: A(t + d) = A Expmap(d twist), [omega rad/s, v m/s].
    residual : "geodesic" or "chordal"

    Returns
    -------
    gtsam.CustomFactor
        Of N times 6 (or 12) whitened rows with unit noise; keys in the order target, sensor, time offset, scale.

    Raises
    ------
    ValueError
        For arrays that do not go together, or weights that the chordal residual cannot hold.
    """
    A, B = se3.stacked(A), se3.stacked(B)
    if A.ndim != 3 or A.shape[1:] != (4, 4) or A.shape != B.shape or len(A) == 0:
        raise ValueError(f"A has shape {A.shape} and B {B.shape}; both must be (N, 4, 4) with one N of at least 1")
    count = len(A)
    if (time_offset_key is None) != (twists is None):
        raise ValueError("a time offset needs both its key (time_offset_key=) and the carriers' twists (twists=)")
    if twists is not None and np.shape(twists) != (count, 6):
        raise ValueError(f"twists have shape {np.shape(twists)}; give ({count}, 6), [omega rad/s, v m/s]")
    if isinstance(sqrt_information, gtsam.noiseModel.Base):
        raise TypeError("sqrt_information is a noise model; give a (6, 6) array: noise.R() of a Gaussian one")
    whitening = _whitening(np.asarray(sqrt_information, dtype=np.float64), count, residual)
    batch = BatchResiduals(A, B, residual, None if twists is None else np.asarray(twists, dtype=np.float64))
    ends = [target_key] if target_key == sensor_key else [target_key, sensor_key]
    keys = ends + [key for key in (time_offset_key, scale_key) if key is not None]
    if len(set(keys)) != len(keys):
        raise ValueError(f"keys {[gtsam.DefaultKeyFormatter(key) for key in keys]} are not all different")
    rows = whitening.shape[-2] * count

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Any] | None) -> Array:
        X = pose_of(values, target_key, "X = T_targetcarrier_target").matrix()
        Y = pose_of(values, sensor_key, "Y = T_sensorcarrier_sensor").matrix()
        scale = 1.0 if scale_key is None else number_of(values, scale_key, "the scale")
        offset = 0.0 if time_offset_key is None else number_of(values, time_offset_key, "the time offset in seconds")
        if jacobians is None:
            plain: Array = np.einsum("nij,nj->ni", whitening, batch.residuals(X, Y, scale, offset)).ravel()
            return plain
        at = batch.linearize(X, Y, scale, offset)
        blocks = [at.target + at.sensor] if len(ends) == 1 else [at.target, at.sensor]
        if time_offset_key is not None:
            blocks.append(at.offset[:, :, None])
        if scale_key is not None:
            blocks.append(at.scale[:, :, None])
        for i, block in enumerate(blocks):
            jacobians[i] = np.asfortranarray((whitening @ block).reshape(rows, -1))
        whitened: Array = np.einsum("nij,nj->ni", whitening, at.residual).ravel()
        return whitened

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(rows), keys, error)


def _whitening(root: Array, count: int, residual: Residual) -> Array:
    """(N, m, m) from square roots of the information of B's perturbation."""
    if root.shape not in ((6, 6), (count, 6, 6)):
        raise ValueError(f"sqrt_information has shape {root.shape}; give (6, 6) or ({count}, 6, 6)")
    if not np.isfinite(root).all():
        raise ValueError("sqrt_information has entries that are NaN or infinite; is a covariance singular?")
    if not (np.linalg.svd(root, compute_uv=False)[..., -1] > 0.0).all():
        raise ValueError("sqrt_information is singular: it says nothing of some direction")
    root = np.broadcast_to(root, (count, 6, 6))
    if residual == "geodesic":
        return root
    if residual != "chordal":
        raise ValueError(f"residual={residual!r} is not 'geodesic' or 'chordal'")
    a, b = root[:, 0, 0], root[:, 3, 3]
    isotropic = np.concatenate([np.repeat(a[:, None], 3, axis=1), np.repeat(b[:, None], 3, axis=1)], axis=1)
    off = np.abs(root - isotropic[:, :, None] * np.eye(6)).max(axis=(1, 2))
    worst = int(np.argmax(off / np.abs(root).max(axis=(1, 2))))
    if off[worst] > 1e-9 * np.abs(root[worst]).max():
        raise ValueError(
            f"the chordal residual holds one weight for rotation and one for translation; sqrt_information of "
            f"measurement {worst} is not diag(a, a, a, b, b, b); take residual='geodesic'"
        )
    # |R - R_0|_F^2 = 2 theta^2: nine rows of weight a / sqrt(2)
    weights = np.concatenate([np.repeat(a[:, None] / np.sqrt(2.0), 9, axis=1), np.repeat(b[:, None], 3, axis=1)], 1)
    chordal: Array = weights[:, :, None] * np.eye(12)
    return chordal
