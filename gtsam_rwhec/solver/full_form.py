"""The full quadratic form Q (RWHEC paper eq. 42), kept in blocks.

Every free frame has 13 numbers, [t (3), s (1), vec R (9)]; s is its own scale where it has one. All frames share two
numbers: alpha, the shared scale, and h, the homogenising entry (1 at every answer). A number that a problem does not
use stays zero, and the reduction leaves it out. x' Q x is the cost J, its 1/2 included.

In the "direct" kind t is alpha times the translation; in the "inverse" kind frames are inverted (X^-1, Y^-1) and the
scale variable is 1/alpha.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rwhec_factors.se3 import pose

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.rounding import gamma, gammas
from gtsam_rwhec.problem.moments import ONE, R_A, SWAPPED, T_A, T_B
from gtsam_rwhec.solver.block_matrix import BlockMatrix, sum_into
from gtsam_rwhec.solver.elimination import Elimination
from gtsam_rwhec.solver.parts import Part

#: Positions among a pair's 28 numbers: target (13), sensor (13), alpha, h.
SIDES, ALPHA, H = (slice(0, 13), slice(13, 26)), 26, 27
#: The forms of this many pairs are computed at once: a few megabytes.
PAIRS_AT_ONCE = 256
_I3, _I9 = np.eye(3), np.eye(9)
_UPPER = np.triu_indices(25, 1)


@dataclass(frozen=True)
class Slots:
    """Where the variables of each pair are in the form.

    ``frames`` (E, 2) are the free frames of target and sensor, by their places, one past the last where there is none;
    a motion has its sensor alone. Each of a pair's 25 variables is one of the 28 numbers of these frames (13 each),
    alpha and h, at ``place`` (E, 25), times ``factor`` (E, 25).
    """

    frames: np.ndarray
    place: np.ndarray
    factor: Array

    def variables(self, numbers: Array, at: slice) -> Array:
        """The variables (k, 25, D) of the pairs' numbers (k, 28, D)."""
        place = self.place[at].astype(int)[:, :, None]
        return np.take_along_axis(numbers, place, axis=1) * self.factor[at][:, :, None]

    def summed(self, values: Array, at: slice) -> Array:
        """Values of the pairs' variables (k, 25), summed by numbers (k, 28)."""
        k = len(values)
        index = self.place[at] + 28 * np.arange(k)[:, None]
        return np.asarray(np.bincount(index.ravel(), values.ravel(), 28 * k), dtype=np.float64).reshape(k, 28)

    def forms(self, at: slice, *several: Array) -> list[Array]:
        """Forms over the pairs' variables (k, 25, 25) as forms over their numbers (k, 28, 28)."""
        place, factor = self.place[at].astype(int), self.factor[at]
        k = len(place)
        index = (28 * place[:, :, None] + place[:, None, :] + 784 * np.arange(k)[:, None, None]).ravel()
        factors = factor[:, :, None] * factor[:, None, :]
        sums = (np.bincount(index, (own * factors).ravel(), 784 * k) for own in several)
        return [np.asarray(each, dtype=np.float64).reshape(k, 28, 28) for each in sums]


def full_forms(part: Part, slots: Slots) -> tuple[BlockMatrix, BlockMatrix]:
    """Q of a part, and the form of its rotation residuals over [vec R] alone; both with the priors.

    A block has 13 numbers for each frame, and 9 in the second form; the tail is [alpha, h].
    """
    n, E = len(part.free), len(part.pairs)
    coupled = np.asarray((slots.frames < n).all(axis=1))
    where = np.cumsum(coupled) - 1
    order = Elimination.of(n, *slots.frames[coupled].T)
    couplings = np.zeros((int(coupled.sum()), 13, 13))
    # Translation residuals have no rotation of the front pose: only rotation residuals couple the rotations.
    forms = [
        BlockMatrix(order, np.zeros((n, m, m)), couplings[:, -m:, -m:], np.zeros((n, m, 2)), np.zeros((2, 2)))
        for m in (13, 9)
    ]
    for begin in range(0, E, PAIRS_AT_ONCE):
        at = slice(begin, begin + PAIRS_AT_ONCE)
        translation, rotation = part.moments.translations(at), part.moments.rotations(at)
        if part.kind == "inverse":
            translation = translation[:, SWAPPED[:, None], SWAPPED]
            rotation = rotation.transpose(0, 2, 1)
        of_translations, of_rotations = edge_forms(translation, rotation, part.moments.kappa[at])
        for k, directed in part.directed_at(at):
            of_translations[k], of_rotations[k], _ = directed.forms(*part.centres(directed.e), 0.0)
        has_both, frames = coupled[at], slots.frames[at].T
        of_both = of_translations + of_rotations
        for form, numbers in zip(forms, slots.forms(at, of_both, of_rotations), strict=True):
            m = form.frames.shape[1]
            one, two, tail = slice(13 - m, 13), slice(26 - m, 26), slice(26, 28)
            for index, side in zip(frames, (one, two), strict=True):
                has = index < n
                sum_into(form.frames, index[has], numbers[has, side, side])
                sum_into(form.tails, index[has], numbers[has, side, tail])
            if m == 13:
                couplings[where[at][has_both]] = numbers[has_both, one, two]
            form.tail[...] += numbers[:, tail, tail].sum(axis=0)
    for form in forms:
        _add_priors(form, part)
        _make_symmetric(form.frames)
    return forms[0], forms[1]


def slots_of(part: Part) -> Slots:
    """The slots of a part's pairs.

    [t_X, t_Y, alpha, r_X, r_Y] become numbers of leaf, center, alpha and h. A fixed frame becomes constants times h
    (its translation times alpha, where t is alpha times the translation); a known scale becomes h; both ends of a
    motion are one frame.
    """
    n, E, motion = len(part.free), len(part.pairs), part.moments.motion[:, None]
    is_free = part.ends < n
    frames = np.where(is_free & ~(motion & [True, False]), part.ends, n)
    begin = np.where(motion, 13, [0, 13])
    constants = np.ones((n + len(part.fixed), 12))  # [t, vec R] of fixed frames, as the form's variables
    for i, T in enumerate(part.fixed.values(), start=n):
        variable = as_variable(T, part)
        constants[i] = np.r_[variable[:3, 3], variable[:3, :3].T.ravel()]
    place, factor = np.full((E, 25), H, dtype=np.int8), np.ones((E, 25))
    for side, (t, r) in enumerate(((slice(0, 3), slice(7, 16)), (slice(3, 6), slice(16, 25)))):
        free, first = is_free[:, side, None], begin[:, side, None]
        place[:, t] = np.where(free, first + np.arange(3), ALPHA if part.is_scaled else H)
        place[:, r] = np.where(free, first + np.arange(4, 13), H)
        factor[:, t], factor[:, r] = np.split(constants[part.ends[:, side]], [3], axis=1)
    if part.scale == "shared":
        place[:, 6] = ALPHA
    else:
        place[part.owns_scale, 6] = begin[part.owns_scale, 0] + 3
        factor[:, 6] = 1.0 / part.known_scales
    return Slots(frames, place, factor)


def as_variable(T: Array, part: Part) -> Array:
    """A pose as variables of the form: itself, or its inverse in the inverse form."""
    if part.kind == "direct":
        return T
    return pose(T[:3, :3].T, -T[:3, :3].T @ T[:3, 3])


def _make_symmetric(blocks: Array) -> None:
    """Remove the asymmetry that rounding caused in symmetric blocks (n, m, m)."""
    for begin in range(0, len(blocks), PAIRS_AT_ONCE):
        some = blocks[begin : begin + PAIRS_AT_ONCE]
        some[...] = 0.5 * (some + some.transpose(0, 2, 1))


def _add_priors(form: BlockMatrix, part: Part) -> None:
    """Add kappa |R - R_0|_F^2 / 2 and |t - t_0|^2 / (2 sigma^2), quadratic once multiplied by h (design fact 11)."""
    place = {name: i for i, name in enumerate(part.free)}
    used = slice(13 - form.frames.shape[1], 13)
    for name, priors in part.priors.items():
        if name not in place:
            continue
        for prior in priors:
            quadratic = _prior_form(prior.transform, prior.sigma, prior.kappa, part)
            form.frames[place[name]] += quadratic[used, used]
            form.tails[place[name], :, 1] += quadratic[used, 13]
            form.tail[1, 1] += quadratic[13, 13]


def _prior_form(T: Array, sigma: float | None, kappa: float | None, part: Part) -> Array:
    """The form (14, 14) of one prior over [t, s, vec R, h]."""
    rows = []
    if sigma is not None:
        residual = np.zeros((3, 14))
        residual[:, :3] = np.eye(3)
        if part.kind == "direct":
            residual[:, 13] = -T[:3, 3]  # t - t_0 h
        else:
            # X = T'^-1: |t_X - t_0| = |t' + R' t_0|, linear in the inverse's t' and R'.
            residual[:, 4:13] = np.kron(T[:3, 3], np.eye(3))
        rows.append(residual / sigma)
    if kappa is not None:
        residual = np.zeros((9, 14))
        residual[:, 4:13] = np.eye(9)
        residual[:, 13] = -as_variable(T, part)[:3, :3].T.ravel()  # r - r_0 h
        rows.append(residual * np.sqrt(kappa))
    stacked = np.concatenate(rows)
    return 0.5 * stacked.T @ stacked


def rounding_of_fixed(part: Part) -> Array:
    """Bound on the rounding of a fixed frame's translation about the gauge, where alpha multiplies it, (E, 2, 3)."""
    of_frames = np.zeros((len(part.free) + len(part.fixed), 3))
    if part.is_scaled:
        for i, (name, T) in enumerate(part.fixed.items(), start=len(part.free)):
            of_frames[i] = 2.0 * gamma(1) * (np.abs(T[:3, 3]) + 2.0 * np.abs(part.frame_shift(name)))
    result: Array = of_frames[part.ends]
    return result


def _rounding_of_pairs(part: Part, slots: Slots) -> Array:
    """The rounding error of each pair's form, as diagonals (E, 25) that dominate it.

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
        # The larger length is used: where A does not move, its own column is undetermined and must not spoil the
        # others.
        length = np.maximum(magnitude[:, T_A].max(axis=1), magnitude[:, T_B].max(axis=1))
        worst = np.nan_to_num(error[:, T_A].max(axis=1) / length, nan=1.0, posinf=1.0)
    if part.kind == "inverse":
        magnitude, error = magnitude[:, SWAPPED], error[:, SWAPPED]
    # Sums over the pairs of a frame come on top of the sums over their measurements; a shared scale has all pairs.
    meeting = np.full(len(part.pairs), len(part.pairs))
    if part.scale != "shared":
        meeting = np.bincount(slots.frames.ravel())[slots.frames].sum(axis=1)
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
    reach = rounding_of_fixed(part).sum(axis=(1, 2)) / gamma(1)
    for e, directed in part.directed_at(slice(0, len(v))):
        v[e] = directed.forms(*part.centres(e), float(reach[e]))[2] * (1.0 + 2.0 * meeting[e] / directed.count)
    return v


def rounding_of(part: Part, slots: Slots) -> Array:
    """The rounding error of Q, as a diagonal (13 n + 1,) over [frames, alpha] that dominates it."""
    n = len(part.free)
    result, of_pairs = np.zeros((n, 13)), _rounding_of_pairs(part, slots)
    of_alpha = 0.0
    for begin in range(0, len(of_pairs), PAIRS_AT_ONCE):
        at = slice(begin, begin + PAIRS_AT_ONCE)
        of_slots = slots.summed(of_pairs[at] * slots.factor[at] ** 2, at)
        for index, side in zip(slots.frames[at].T, SIDES, strict=True):
            sum_into(result, index[index < n], of_slots[index < n, side])
        of_alpha += float(of_slots[:, ALPHA].sum())
    return np.append(result.ravel(), of_alpha)


def edge_forms(translation: Array, rotation: Array, kappa: Array) -> tuple[Array, Array]:
    """Quadratic forms of E pairs over x = [t_X, t_Y, alpha, vec R_X, vec R_Y] (design fact 1; eqs. 24-33).

    The moments are as in `MomentStack`; for the inverse equation ``translation`` is permuted by ``SWAPPED`` and
    ``rotation`` transposed. x' form x is the pair's J_t and J_R (eq. 18), with the factor 1/2; each form (E, 25, 25).
    """
    G = translation
    edges = len(G)
    tX, tY, al, rX, rY = slice(0, 3), slice(3, 6), 6, slice(7, 16), slice(16, 25)
    weight = G[:, ONE, ONE, None, None]
    Rt = G[:, R_A, ONE].reshape(edges, 3, 3)  # sum w R_A'
    Q = np.zeros((edges, 25, 25))
    # M_t = [R_A, -I, t_A, 0, -t_B' (x) I] (eq. 30); the upper triangle of sum w M_t' M_t:
    Q[:, tX, tX] = weight * _I3
    Q[:, tX, tY] = -Rt
    Q[:, tX, al] = np.einsum("eikk->ei", G[:, R_A, T_A].reshape(edges, 3, 3, 3))
    # -R_A' (t_B' (x) I): entry (i, 3 j + k) is -R_A[k, i] t_B[j]
    Q[:, tX, rY] = -G[:, R_A, T_B].reshape(edges, 3, 3, 3).transpose(0, 1, 3, 2).reshape(edges, 3, 9)
    Q[:, tY, tY] = weight * _I3
    Q[:, tY, al] = -G[:, T_A, ONE]
    Q[:, tY, rY] = np.einsum("ej,ik->eijk", G[:, T_B, ONE], _I3).reshape(edges, 3, 9)
    Q[:, al, al] = np.einsum("ekk->e", G[:, T_A, T_A])
    Q[:, al, rY] = -G[:, T_B, T_A].reshape(edges, 9)
    Q[:, rY, rY] = np.einsum("ejl,ik->ejilk", G[:, T_B, T_B], _I3).reshape(edges, 9, 9)
    P = np.zeros((edges, 25, 25))
    # M_R = [I (x) R_A, -R_B' (x) I] (eq. 25); M_R' M_R has diagonal blocks kappa I, and -R_B' (x) R_A' off the
    # diagonal.
    P[:, rX, rX] = kappa[:, None, None] * _I9
    P[:, rY, rY] = kappa[:, None, None] * _I9
    cross = rotation.reshape(edges, 3, 3, 3, 3)  # [i, k, p, q] = sum kappa R_A[k, i] R_B[q, p]
    P[:, rX, rY] = -cross.transpose(0, 3, 1, 4, 2).reshape(edges, 9, 9)
    for form in (Q, P):
        form[:, _UPPER[1], _UPPER[0]] = form[:, _UPPER[0], _UPPER[1]]
        form *= 0.5
    return Q, P
