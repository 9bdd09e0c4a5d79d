"""Measurements of one pair whose errors have parts in common: drift, an arm's systematic errors, noise of a carrier."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import gtsam
from numpy.typing import ArrayLike

from rwhec_factors.batch import Part, factors_of_parts
from rwhec_factors.se3 import Array


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
    (factor,) = factors_of_parts(
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
    return factors_of_parts(
        target_key, sensor_key, A, B, sqrt_information, parts, scale_key=scale_key, time_offset_key=time_offset_key,
        twists=twists,
    )  # fmt: skip
