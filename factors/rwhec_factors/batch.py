"""All measurements of a pair at once: vectorised geodesic residuals and Jacobians, and one factor that holds them.

A call of numpy costs as much for fifty measurements as for five hundred: pairs of few are computed together.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
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
#: Pairs are computed together up to so many measurements: beyond, memory costs more than calls do.
AT_ONCE = 4096


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

    def linearize(self, X: Array, Y: Array, scale: float | Array = 1.0, offset_s: float | Array = 0.0) -> Linearization:
        """Residuals and Jacobians at X, Y (4, 4), a scale and a time offset in seconds; or at N of each."""
        predicted = self._predicted(X, Y, offset_s)
        value = self._compared(predicted, scale)
        # Log(E Expmap(d)) = e + Jr^-1(e) d; S(P Expmap([w, v])) = S(P) Expmap([w, scale v]); dS/dscale is v = R' t.
        inverse_jacobian = se3.right_jacobian_inverse(value)
        target = inverse_jacobian.copy()
        target[:, :, 3:] *= np.reshape(scale, (-1, 1, 1))
        direction = np.einsum("nji,nj->ni", predicted[:, :3, :3], predicted[:, :3, 3])
        # X Expmap(d) moves the prediction P by d, Y Expmap(d) by -Ad(P^-1) d, A Expmap(d) by Ad(X^-1) d.
        carrier = target @ se3.adjoint(se3.inverse(X).reshape(-1, 4, 4))
        return Linearization(
            residual=value,
            target=target,
            sensor=-target @ se3.adjoint(se3.inverse(predicted)),
            scale=np.einsum("nmi,ni->nm", inverse_jacobian[:, :, 3:], direction),
            offset=np.zeros_like(value) if self.twists is None else np.einsum("nmi,ni->nm", carrier, self.twists),
            carrier=carrier,
        )

    def residuals(self, X: Array, Y: Array, scale: float | Array = 1.0, offset_s: float | Array = 0.0) -> Array:
        """Residuals (N, 6) alone."""
        return self._compared(self._predicted(X, Y, offset_s), scale)

    def _predicted(self, X: Array, Y: Array, offset_s: float | Array) -> Array:
        offsets = np.reshape(offset_s, (-1, 1))
        A = self.A if self.twists is None or not offsets.any() else self.A @ se3.expmap(offsets * self.twists)
        return np.asarray(se3.inverse(Y) @ A @ X)

    def _compared(self, predicted: Array, scale: float | Array) -> Array:
        scaled = predicted.copy()
        scaled[:, :3, 3] *= np.reshape(scale, (-1, 1))
        return se3.logmap(se3.inverse(self.B) @ scaled)


@dataclass(frozen=True)
class Placed:
    """One pair's measurements, and where their residuals are computed."""

    batch: BatchResiduals
    #: (4, 4)
    X: Array
    Y: Array
    scale: float = 1.0
    offset_s: float = 0.0


def linearized_together(pairs: Sequence[Placed]) -> list[Linearization]:
    """``BatchResiduals.linearize`` of many pairs, in their order."""
    found: list[Linearization] = []
    for group in _groups(pairs):
        if len(group) == 1:
            one = group[0]
            found.append(one.batch.linearize(one.X, one.Y, one.scale, one.offset_s))
        else:
            batch, at, ends = _joined(group)
            every = batch.linearize(*at)
            parts = (np.split(getattr(every, each.name), ends) for each in fields(every))
            found += [Linearization(*part) for part in zip(*parts, strict=True)]
    return found


def residuals_together(pairs: Sequence[Placed]) -> list[Array]:
    """``BatchResiduals.residuals`` (N, 6) of many pairs, in their order."""
    found: list[Array] = []
    for group in _groups(pairs):
        if len(group) == 1:
            one = group[0]
            found.append(one.batch.residuals(one.X, one.Y, one.scale, one.offset_s))
        else:
            batch, at, ends = _joined(group)
            found += np.split(batch.residuals(*at), ends)
    return found


def _groups(pairs: Sequence[Placed]) -> Iterator[Sequence[Placed]]:
    """Neighbouring pairs that are computed together."""
    ends = np.cumsum([len(one.batch.A) for one in pairs])
    first, before = 0, 0
    while first < len(pairs):
        last = max(int(np.searchsorted(ends, before + AT_ONCE, side="right")), first + 1)
        yield pairs[first:last]
        first, before = last, int(ends[last - 1])


def _joined(group: Sequence[Placed]) -> tuple[BatchResiduals, tuple[Array, Array, Array, Array], np.ndarray]:
    """The measurements of some pairs in one; X, Y, the scale and the offset of each; and where the pairs are cut."""
    batches = [one.batch for one in group]
    counts = [len(batch.A) for batch in batches]
    twists = None
    if any(batch.twists is not None for batch in batches):
        twists = np.concatenate([np.zeros((len(b.A), 6)) if b.twists is None else b.twists for b in batches])
    whole = BatchResiduals(np.concatenate([b.A for b in batches]), np.concatenate([b.B for b in batches]), twists)
    of = np.repeat(np.arange(len(group)), counts)
    X, Y = np.array([one.X for one in group])[of], np.array([one.Y for one in group])[of]
    scale, offset_s = np.array([one.scale for one in group])[of], np.array([one.offset_s for one in group])[of]
    return whole, (X, Y, scale, offset_s), np.cumsum(counts)[:-1]


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
    together: Together | None = None,
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
    together : Together, optional
        One for all factors of a graph: they are then computed in few calls, which is faster where pairs have few
        measurements.

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
        twists=twists, together=together,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Together:
    """Give one of these to several factors: when one of them is asked at new values, all are computed in few calls."""

    members: list[_Whitened] = field(default_factory=list)


@dataclass(eq=False)
class _Whitened:
    """All measurements of a pair, whitened; the last evaluation is kept for the other factors of the same pair."""

    batch: BatchResiduals
    whitening: Array
    target_key: int
    sensor_key: int
    scale_key: int | None
    time_offset_key: int | None
    #: The pairs that are computed when this one is.
    together: Together
    _at: bytes = b""
    _residual: Array = field(default_factory=lambda: np.zeros(0))
    _jacobians: tuple[Array, ...] = ()

    @property
    def keys(self) -> list[int]:
        ends = [self.target_key] if self.target_key == self.sensor_key else [self.target_key, self.sensor_key]
        return ends + [key for key in (self.time_offset_key, self.scale_key) if key is not None]

    def at(self, values: gtsam.Values, *, linearized: bool) -> tuple[Array, tuple[Array, ...]]:
        """Residuals (6 N,) and, if asked for, the Jacobians (6 N, m) by ``keys``."""
        placed = self._placed(values)
        if self._at != _point(placed) or (linearized and not self._jacobians):
            others = [one for one in self.together.members if one is not self and one.is_in(values)]
            pairs, places = [self, *others], [placed, *(one._placed(values) for one in others)]
            if linearized:
                for one, where, found in zip(pairs, places, linearized_together(places), strict=True):
                    one._take(where, found.residual, one._blocks(found))
            else:
                for one, where, residual in zip(pairs, places, residuals_together(places), strict=True):
                    one._take(where, residual, [])
        return self._residual, self._jacobians

    def is_in(self, values: gtsam.Values) -> bool:
        """Whether all variables have a value."""
        return all(values.exists(key) for key in self.keys)

    def _placed(self, values: gtsam.Values) -> Placed:
        X = pose_of(values, self.target_key, "X = T_targetcarrier_target").matrix()
        Y = pose_of(values, self.sensor_key, "Y = T_sensorcarrier_sensor").matrix()
        scale = 1.0 if self.scale_key is None else number_of(values, self.scale_key, "the scale")
        offset = 0.0
        if self.time_offset_key is not None:
            offset = number_of(values, self.time_offset_key, "the time offset in seconds")
        return Placed(self.batch, X, Y, scale, offset)

    def _blocks(self, at: Linearization) -> list[Array]:
        blocks = [at.target + at.sensor] if self.target_key == self.sensor_key else [at.target, at.sensor]
        if self.time_offset_key is not None:
            blocks.append(at.offset[:, :, None])
        if self.scale_key is not None:
            blocks.append(at.scale[:, :, None])
        return blocks

    def _take(self, where: Placed, residual: Array, blocks: list[Array]) -> None:
        self._at = _point(where)
        self._residual = _rows(self.whitening @ residual[:, :, None])[:, 0]
        self._jacobians = tuple(_rows(self.whitening @ block) for block in blocks)


def _point(placed: Placed) -> bytes:
    return placed.X.tobytes() + placed.Y.tobytes() + np.array([placed.scale, placed.offset_s]).tobytes()


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
    if not np.linalg.slogdet(root)[0].all():
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
    together: Together | None = None,
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
        time_offset_key=time_offset_key, twists=twists, together=together,
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
    together: Together | None = None,
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
    together = Together() if together is None else together
    whole = _Whitened(
        batch, _whitening(sqrt_information, len(A)), target_key, sensor_key, scale_key, time_offset_key, together
    )
    check_keys(whole.keys)
    together.members.append(whole)
    return [_factor_of_part(whole, rows, effects) for rows, effects in parts]
