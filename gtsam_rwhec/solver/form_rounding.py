"""What rounding did to the full quadratic form (`full_form`), as diagonal matrices that dominate it."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.rounding import gamma, gammas
from gtsam_rwhec.problem.moments import ONE, R_A, SWAPPED, T_A, T_B
from gtsam_rwhec.solver.block_matrix import sum_into
from gtsam_rwhec.solver.full_form import ALPHA, PAIRS_AT_ONCE, Slots
from gtsam_rwhec.solver.parts import Part


def rounding_of_fixed(part: Part) -> Array:
    """What rounding may take from a fixed frame's translation about the gauge where alpha multiplies it, (E, 2, 3)."""
    result = np.zeros((len(part.pairs), 2, 3))
    if part.kind == "direct" and part.scale == "shared" and part.fixed:
        for e, pair in enumerate(part.pairs):
            for side, name in enumerate(pair):
                if name in part.fixed:
                    shift = np.abs(part.frame_shift(name))
                    result[e, side] = 2.0 * gamma(1) * (np.abs(part.fixed[name][:3, 3]) + 2.0 * shift)
    return result


def _rounding_of_pairs(part: Part, slots: Slots) -> Array:
    """What rounding did to each pair's form, as diagonals (E, 25) that dominate it.

    The form of the measurements in exact arithmetic differs from the form as stored for two reasons: the rounding of
    the moments (`Moments`), and that R'R is the identity only up to rounding. If every entry of a pair's form is off by
    at most v_p v_q, then the pair's form is off by at most (sum v_p |x_p|)^2 <= 16 sum v_p^2 x_p^2, as 16 of its
    variables carry translations.
    """
    moments = part.moments
    # An error of a fixed frame's translation about the gauge acts like one of the measured translation.
    of_fixed = rounding_of_fixed(part).sum(axis=(1, 2)) * np.sqrt(moments.weight)
    magnitude, error = moments.magnitude, moments.feature_error.copy()
    error[:, T_A] += of_fixed[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        # Of the larger length: where A does not move, its own undetermined column must not spoil the others.
        length = np.maximum(magnitude[:, T_A].max(axis=1), magnitude[:, T_B].max(axis=1))
        worst = np.nan_to_num(error[:, T_A].max(axis=1) / length, nan=1.0, posinf=1.0)
    if part.kind == "inverse":
        magnitude, error = magnitude[:, SWAPPED], error[:, SWAPPED]
    # Sums over the pairs of a frame come on top of the sums over their measurements; a shared scale has all pairs.
    meeting = np.full(len(part.pairs), len(part.pairs))
    if part.scale != "shared":
        frames = np.stack([slots.leaf, len(part.leaves) + slots.center])
        meeting = np.bincount(frames.ravel())[frames].sum(axis=0)
    operations = moments.operations + 2 * meeting + 20
    unit = gammas(operations)
    # g m m' + m e' + e m' + e e' <= g m m' + (c m + e / c)(c m + e / c)' for any c up to 1.
    c = np.sqrt(np.clip(worst, 1e-30, 1.0))[:, None]
    square = unit[:, None] * magnitude**2 + (c * magnitude + error / c) ** 2  # of the errors of features
    off = 4.0 * moments.deviation  # of R'R from the identity, as a matrix norm
    v = np.zeros((len(part.pairs), 25))
    v[:, 0:3] = 0.5 * (square[:, R_A].sum(axis=1) + off * moments.weight)[:, None]
    v[:, 3:6] = 0.5 * square[:, ONE, None]
    v[:, 6] = 0.5 * square[:, T_A].sum(axis=1)
    v[:, 16:25] = 0.5 * np.repeat(square[:, T_B], 3, axis=1)
    v *= 16.0
    v[:, 7:] += (moments.kappa * (1.5 * unit + off))[:, None]
    return v


def rounding_of(part: Part, slots: Slots) -> Array:
    """What rounding did to Q, as a diagonal (13 n + 1,) over [leaves, centers, alpha] that dominates it."""
    L, n = len(part.leaves), len(part.free)
    result, of_pairs = np.zeros((n, 13)), _rounding_of_pairs(part, slots)
    of_alpha = 0.0
    for begin in range(0, len(of_pairs), PAIRS_AT_ONCE):
        at = slice(begin, begin + PAIRS_AT_ONCE)
        of_slots = np.einsum("ep,epq->eq", of_pairs[at], slots.matrices(at) ** 2)
        leaf, center = slots.leaf[at], L + slots.center[at]
        for index, has, side in ((leaf, leaf < L, slice(0, 13)), (center, center < n, slice(13, 26))):
            sum_into(result, index[has], of_slots[has, side])
        of_alpha += float(of_slots[:, ALPHA].sum())
    return np.append(result.ravel(), of_alpha)
