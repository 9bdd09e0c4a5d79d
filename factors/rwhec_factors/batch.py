"""All measurements of a pair at once: vectorised geodesic residuals and Jacobians, and one factor that holds them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from rwhec_factors import se3
from rwhec_factors.arguments import (
    check_keys,
    check_time_offset,
    checked_effect,
    checked_pairs,
    checked_twists,
    number_of,
    pose_of,
    vector_of,
)
from rwhec_factors.se3 import Array

#: Some measurements, and their effects by key.
Part = tuple[slice, Mapping[int, ArrayLike]]


@dataclass(frozen=True)
class Linearization:
    """Residuals of N measurements and their derivatives."""

    residual: Array  #: (N, 6): [rotation (rad), translation (m)]
    #: (N, 6, 6): by right perturbations of X, Y and A
    target: Array
    sensor: Array
    #: (N, 6): by the scale and by the time offset (s)
    scale: Array
    offset: Array
    carrier: Array  #: (N, 6, 6): by right perturbations of X, Y and A


@dataclass(frozen=True)
class BatchResiduals:
    """Measurements of one pair, A X = Y B, with the residual Log(B^-1 S(Y^-1 A X)), S(R, t) = (R, scale t)."""

    #: (N, 4, 4): T_sensorcarrier_targetcarrier and T_sensor_target; metres (B's times the scale)
    A: Array
    B: Array
    #: (N, 6): velocities of the carriers: A(t + d) = A Expmap(d twist), [omega rad/s, v m/s]
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
        return np.linalg.inv(Y) @ A @ X

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
    return robot_world_hand_eye_effects_factor(
        target_key, sensor_key, A, B, sqrt_information, {}, scale_key=scale_key, time_offset_key=time_offset_key,
        twists=twists,
    )  # fmt: skip


@dataclass
class _Whitened:
    """All measurements of a pair, whitened; the last evaluation is kept for the other factors of the same pair."""

    batch: BatchResiduals
    whitening: Array
    target_key: int
    sensor_key: int
    scale_key: int | None
    time_offset_key: int | None
    _at: bytes = b""
    _residual: Array = field(default_factory=lambda: np.zeros(0))
    _jacobians: tuple[Array, ...] = ()

    @property
    def keys(self) -> list[int]:
        ends = [self.target_key] if self.target_key == self.sensor_key else [self.target_key, self.sensor_key]
        return ends + [key for key in (self.time_offset_key, self.scale_key) if key is not None]

    def at(self, values: gtsam.Values, *, linearized: bool) -> tuple[Array, tuple[Array, ...]]:
        """Residuals (6 N,) and, if asked for, the Jacobians (6 N, m) by ``keys``."""
        X = pose_of(values, self.target_key, "X = T_targetcarrier_target").matrix()
        Y = pose_of(values, self.sensor_key, "Y = T_sensorcarrier_sensor").matrix()
        scale = 1.0 if self.scale_key is None else number_of(values, self.scale_key, "the scale")
        offset = 0.0
        if self.time_offset_key is not None:
            offset = number_of(values, self.time_offset_key, "the time offset in seconds")
        here = np.concatenate([X.ravel(), Y.ravel(), [scale, offset]]).tobytes()
        is_known = self._at == here
        self._at = here
        if linearized and not (is_known and self._jacobians):
            at = self.batch.linearize(X, Y, scale, offset)
            blocks = [at.target + at.sensor] if self.target_key == self.sensor_key else [at.target, at.sensor]
            if self.time_offset_key is not None:
                blocks.append(at.offset[:, :, None])
            if self.scale_key is not None:
                blocks.append(at.scale[:, :, None])
            self._jacobians = tuple(_rows(self.whitening @ block) for block in blocks)
            self._residual = _rows(self.whitening @ at.residual[:, :, None])[:, 0]
        elif not is_known:
            self._jacobians = ()
            self._residual = _rows(self.whitening @ self.batch.residuals(X, Y, scale, offset)[:, :, None])[:, 0]
        return self._residual, self._jacobians


def _factor_of_part(whole: _Whitened, rows: slice, effects: Mapping[int, ArrayLike]) -> gtsam.CustomFactor:
    """One factor of the measurements in a slice."""
    first, end, _ = rows.indices(len(whole.whitening))
    if end <= first or rows.step not in (None, 1):
        raise ValueError(f"{rows} of {len(whole.whitening)} measurements holds none, or has a step; give slice(i, j)")
    keys, whitening, own = whole.keys, whole.whitening[rows], slice(6 * first, 6 * end)
    check_keys(keys + list(effects))
    # The residual is linear in x_k: the Jacobian is constant, for all variables together and for each one.
    linear = [-_rows(whitening @ checked_effect(effect, key, end - first)) for key, effect in effects.items()]
    of_all = np.hstack(linear) if linear else np.zeros((len(whitening), 0))
    dimensions = {key: block.shape[1] for key, block in zip(effects, linear, strict=True)}

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Any] | None) -> Array:
        residual, blocks = whole.at(values, linearized=jacobians is not None)
        if jacobians is not None:
            for i, block in enumerate(blocks):
                jacobians[i] = np.asfortranarray(block[own])
            for i, block in enumerate(linear, len(blocks)):
                jacobians[i] = block
        whitened: Array = residual[own]
        if dimensions:
            x = [vector_of(values, key, size, "the coefficients of an effect") for key, size in dimensions.items()]
            whitened = whitened + of_all @ np.concatenate(x)
        return whitened

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(6 * (end - first)), keys + list(effects), error)


def _rows(blocks: Array) -> Array:
    """The rows (6 N, m) of blocks (N, 6, m), as GTSAM stores matrices."""
    return np.asfortranarray(blocks.reshape(-1, blocks.shape[2]))


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


def robot_world_hand_eye_effects_factor(
    target_key: int,
    sensor_key: int,
    A: Array,
    B: Array,
    sqrt_information: Array,
    effects: Mapping[int, ArrayLike],
    *,
    scale_key: int | None = None,
    time_offset_key: int | None = None,
    twists: Array | None = None,
) -> gtsam.CustomFactor:
    """All measurements of one pair in one factor, with errors that are linear in further variables.

    The residual of measurement n is Log(B_n^-1 S(Y^-1 A_n X)) - sum_k effects[k][n] x_k, S(R, t) = (R, scale t). What
    several measurements have in common (the drift of a track, an error of the arm's kinematics, the noise of one A that
    several sensors share) is an x_k; give it a prior, or tie it to its neighbours. The effects are of first order: take
    the residual's derivatives near the answer (``BatchResiduals.linearize``).

    Parameters
    ----------
    target_key, sensor_key, A, B, scale_key, time_offset_key, twists
        As in ``robot_world_hand_eye_batch_factor``.
    sqrt_information : (6, 6) or (N, 6, 6) array
        W: W' W is the information of what is left of the residual, rotation first.
    effects : dict of int to (N, 6, m) array
        By the key of each x_k, an m-vector: the residual's derivative by it, with zeros for measurements that it does
        not change. [rotation (rad), translation (m)] by the unit of x_k.

    Returns
    -------
    gtsam.CustomFactor
        6 N whitened rows with unit noise; keys in the order target, sensor, time offset, scale, effects.

    Raises
    ------
    TypeError, ValueError
        If the arrays' shapes do not agree, an effect is not finite, a weight is singular or not finite, or two keys are
        equal.
    """
    (factor,) = robot_world_hand_eye_effects_factors(
        target_key, sensor_key, A, B, sqrt_information, [(slice(None), effects)], scale_key=scale_key,
        time_offset_key=time_offset_key, twists=twists,
    )  # fmt: skip
    return factor


def robot_world_hand_eye_effects_factors(
    target_key: int,
    sensor_key: int,
    A: Array,
    B: Array,
    sqrt_information: Array,
    parts: Sequence[Part],
    *,
    scale_key: int | None = None,
    time_offset_key: int | None = None,
    twists: Array | None = None,
) -> list[gtsam.CustomFactor]:
    """The measurements of one pair in several factors, each with effects of its own, evaluated at once.

    For effects that belong to short times (drift), where one factor of all measurements would tie all of them together.
    At each point the first of the factors that is asked computes the residuals of all.

    Parameters
    ----------
    parts : sequence of (slice, dict of int to array)
        Which measurements a factor has, and its effects by key: (n, 6, m) arrays for these n measurements.

    The other parameters and the errors are those of ``robot_world_hand_eye_effects_factor``.

    Returns
    -------
    list of gtsam.CustomFactor
        One for each part.
    """
    A, B = checked_pairs(A, B)
    check_time_offset(time_offset_key, twists)
    batch = BatchResiduals(A, B, None if twists is None else checked_twists(twists, (len(A), 6)))
    whole = _Whitened(batch, _whitening(sqrt_information, len(A)), target_key, sensor_key, scale_key, time_offset_key)
    check_keys(whole.keys)
    return [_factor_of_part(whole, rows, effects) for rows, effects in parts]
