"""All measurements of a pair at once: vectorised geodesic residuals and Jacobians, and one factor that holds them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from rwhec_factors import se3
from rwhec_factors.arguments import check_keys, check_time_offset, checked_pairs, checked_twists
from rwhec_factors.se3 import Array
from rwhec_factors.values import number_of, pose_of


@dataclass(frozen=True)
class Linearization:
    """Residuals of N measurements and their derivatives.

    Attributes
    ----------
    residual : (N, 6) array
        [rotation (rad), translation (m)].
    target, sensor, carrier : (N, 6, 6) arrays
        By right perturbations of X, Y and A.
    scale, offset : (N, 6) arrays
        By the scale and by the time offset (s).
    """

    residual: Array
    target: Array
    sensor: Array
    scale: Array
    offset: Array
    carrier: Array


@dataclass(frozen=True)
class BatchResiduals:
    """Measurements of one pair, A X = Y B, with the residual Log(B^-1 S(Y^-1 A X)), S(R, t) = (R, scale t).

    Attributes
    ----------
    A, B : (N, 4, 4) arrays
        T_sensorcarrier_targetcarrier and T_sensor_target; metres (B's times the scale).
    twists : (N, 6) array, optional
        Velocities of the carriers: A(t + d) = A Expmap(d twist), [omega rad/s, v m/s].
    """

    A: Array
    B: Array
    twists: Array | None = None

    def linearize(self, X: Array, Y: Array, scale: float = 1.0, offset_s: float = 0.0) -> Linearization:
        """Residuals and Jacobians at X, Y (4, 4), a scale and a time offset in seconds."""
        predicted = self._predicted(X, Y, offset_s)
        value = self._compared(predicted, scale)
        # Log(E Expmap(d)) = e + Jr^-1(e) d; S(P Expmap([w, v])) = S(P) Expmap([w, scale v]); dS/dscale is v = R' t.
        inverse_jacobian = se3.right_jacobian_inverse(value)
        target = inverse_jacobian * np.r_[1.0, 1.0, 1.0, scale, scale, scale]
        direction = np.einsum("nji,nj->ni", predicted[:, :3, :3], predicted[:, :3, 3])
        # X Expmap(d) moves the prediction P by d, Y Expmap(d) by -Ad(P^-1) d, A Expmap(d) by Ad(X^-1) d.
        carrier = target @ se3.adjoint(np.linalg.inv(X)[None])[0]
        return Linearization(
            residual=value,
            target=target,
            sensor=-target @ se3.adjoint(se3.inverse(predicted)),
            scale=np.einsum("nmi,ni->nm", inverse_jacobian[:, :, 3:], direction),
            offset=np.zeros_like(value) if self.twists is None else np.einsum("nmi,ni->nm", carrier, self.twists),
            carrier=carrier,
        )

    def residuals(self, X: Array, Y: Array, scale: float = 1.0, offset_s: float = 0.0) -> Array:
        """Residuals (N, 6) alone."""
        return self._compared(self._predicted(X, Y, offset_s), scale)

    def _predicted(self, X: Array, Y: Array, offset_s: float) -> Array:
        A = self.A if self.twists is None or offset_s == 0.0 else self.A @ se3.expmap(offset_s * self.twists)
        predicted: Array = np.linalg.inv(Y) @ A @ X
        return predicted

    def _compared(self, predicted: Array, scale: float) -> Array:
        scaled = predicted.copy()
        scaled[:, :3, 3] *= scale
        return se3.logmap(se3.inverse(self.B) @ scaled)


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
) -> gtsam.CustomFactor:
    """All measurements of one pair in one factor: the cost of N single geodesic factors, evaluated at once.

    For the chordal residual take ``edge_summary_factor``.

    Parameters
    ----------
    target_key, sensor_key : int
        Keys of X = T_targetcarrier_target and Y = T_sensorcarrier_sensor, Pose3. One key for both makes every
        measurement A Y = Y B (AX = XB), A and B both T_before_after.
    A, B : (N, 4, 4) arrays or lists of gtsam.Pose3
        T_sensorcarrier_targetcarrier and T_sensor_target; metres.
    sqrt_information : (6, 6) or (N, 6, 6) array
        W: W' W is the information of B's right perturbation, rotation first.
    scale_key : int, optional
        Key of a 1-vector: t_B = scale * (true length).
    time_offset_key : int, optional
        Key of a 1-vector, in seconds: B's stamp t is the carriers' t + offset. Needs ``twists``.
    twists : (N, 6) array, optional
        The carriers' velocity at each stamp: A(t + d) = A Expmap(d twist), [omega rad/s, v m/s].

    Returns
    -------
    gtsam.CustomFactor
        6 N whitened rows with unit noise; keys in the order target, sensor, time offset, scale.

    Raises
    ------
    TypeError, ValueError
        If the arrays' shapes do not agree, a weight is singular or not finite, or two keys are equal.
    """
    A, B = checked_pairs(A, B)
    check_time_offset(time_offset_key, twists)
    batch = BatchResiduals(A, B, None if twists is None else checked_twists(twists, (len(A), 6)))
    whitening = _whitening(sqrt_information, len(A))
    ends = [target_key] if target_key == sensor_key else [target_key, sensor_key]
    keys = ends + [key for key in (time_offset_key, scale_key) if key is not None]
    check_keys(keys)

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Any] | None) -> Array:
        X = pose_of(values, target_key, "X = T_targetcarrier_target").matrix()
        Y = pose_of(values, sensor_key, "Y = T_sensorcarrier_sensor").matrix()
        scale = 1.0 if scale_key is None else number_of(values, scale_key, "the scale")
        offset = 0.0 if time_offset_key is None else number_of(values, time_offset_key, "the time offset in seconds")
        if jacobians is None:
            residual = batch.residuals(X, Y, scale, offset)
        else:
            at = batch.linearize(X, Y, scale, offset)
            residual = at.residual
            blocks = [at.target + at.sensor] if len(ends) == 1 else [at.target, at.sensor]
            if time_offset_key is not None:
                blocks.append(at.offset[:, :, None])
            if scale_key is not None:
                blocks.append(at.scale[:, :, None])
            for i, block in enumerate(blocks):
                jacobians[i] = np.asfortranarray((whitening @ block).reshape(residual.size, -1))
        whitened: Array = np.einsum("nij,nj->ni", whitening, residual).ravel()
        return whitened

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(6 * len(A)), keys, error)


def _whitening(sqrt_information: object, count: int) -> Array:
    """The checked square roots of the information, (N, 6, 6)."""
    if isinstance(sqrt_information, gtsam.noiseModel.Base):
        raise TypeError("sqrt_information is a noise model; give a (6, 6) array: noise.R() of a Gaussian model")
    root = np.asarray(sqrt_information, dtype=np.float64)
    if root.shape not in ((6, 6), (count, 6, 6)):
        raise ValueError(f"sqrt_information has shape {root.shape}; give (6, 6) or ({count}, 6, 6)")
    if not np.isfinite(root).all():
        raise ValueError("sqrt_information has entries that are NaN or infinite; is a covariance singular?")
    if not (np.linalg.svd(root, compute_uv=False)[..., -1] > 0.0).all():
        raise ValueError("sqrt_information is singular: along some direction it holds no information; give full rank")
    return np.broadcast_to(root, (count, 6, 6))
