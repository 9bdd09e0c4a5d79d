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

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.rounding import gamma
from gtsam_rwhec.problem.moments import ONE, R_A, SWAPPED, T_A, T_B, edge_forms
from gtsam_rwhec.solver.parts import Part

#: Positions among an edge's 28 numbers: leaf (13), center (13), alpha, h.
ALPHA, H = 26, 27


@dataclass(frozen=True)
class FullForm:
    """Blocks of Q over L leaves, P centers and the tail, [alpha, h].

    leaf (L, 13, 13); leaf_center (L, P, 13, 13); leaf_tail (L, 13, 2); center (P, 13, 13); center_tail (P, 13, 2);
    tail (2, 2).
    """

    leaf: Array
    leaf_center: Array
    leaf_tail: Array
    center: Array
    center_tail: Array
    tail: Array

    @property
    def leaves(self) -> int:
        """Number of leaves."""
        return len(self.leaf)

    @property
    def centers(self) -> int:
        """Number of centers."""
        return len(self.center)

    def value(self, leaf: Array, center: Array, tail: Array) -> float:
        """x' Q x for leaf (L, 13), center (P, 13), tail (2,); in extended precision, as large terms cancel."""
        leaf, center, tail = (x.astype(np.longdouble) for x in (leaf, center, tail))
        of_leaf = np.einsum("lpij,pj->li", self.leaf_center, center) + self.leaf_tail @ tail
        of_center = self.center_tail @ tail
        own = (leaf * np.einsum("lij,lj->li", self.leaf, leaf)).sum()
        own += (center * np.einsum("pij,pj->pi", self.center, center)).sum()
        coupled = (leaf * of_leaf).sum() + (center * of_center).sum()
        return float(own + 2.0 * coupled + tail @ self.tail @ tail)


@dataclass(frozen=True)
class Slots:
    """What the variables of each pair are in the form.

    ``leaf`` and ``center`` (E,) are indices, one past the last where there is none. ``of_pair`` (E, 25, 28): the 25
    variables of a pair from the numbers of its leaf (13) and center (13), alpha and h.
    """

    leaf: np.ndarray
    center: np.ndarray
    of_pair: Array


def full_forms(part: Part, slots: Slots) -> tuple[FullForm, FullForm]:
    """Q of a part, and the form of its rotation residuals alone; both with the priors."""
    translation, rotation = part.moments.translation, part.moments.rotation
    if part.kind == "inverse":
        translation = translation[:, SWAPPED[:, None], SWAPPED]
        rotation = rotation.transpose(0, 2, 1)
    of_translations, of_rotations = edge_forms(translation, rotation, part.moments.kappa)
    full, alone = (_assembled(part, slots, of_edges) for of_edges in (of_translations + of_rotations, of_rotations))
    for form in (full, alone):
        _add_priors(form, part)
    return full, alone


def slots_of(part: Part) -> Slots:
    """The slots of a part's pairs.

    [t_X, t_Y, alpha, r_X, r_Y] become numbers of leaf, center, alpha and h. A fixed frame becomes constants times h
    (its translation times alpha, where t is alpha times the translation); a known scale becomes h; both ends of a
    motion are one frame.
    """
    place = {name: (0, i) for i, name in enumerate(part.leaves)}
    place |= {name: (1, i) for i, name in enumerate(part.centers)}
    edges = len(part.pairs)
    leaf = np.full(edges, len(part.leaves))
    center = np.full(edges, len(part.centers))
    S = np.zeros((edges, 25, 28))
    t_of_fixed = ALPHA if part.kind == "direct" and part.scale == "shared" else H
    owners = frozenset(part.scale_owners)
    for e, (target, sensor) in enumerate(part.pairs):
        for name, t, r in ((target, 0, 7), (sensor, 3, 16)):
            if name in place:
                side, index = place[name]
                (center if side else leaf)[e] = index
                first = 13 * side
                S[e, [t, t + 1, t + 2], [first, first + 1, first + 2]] = 1.0
                S[e, range(r, r + 9), range(first + 4, first + 13)] = 1.0
            else:
                T = as_variable(part.fixed[name], part)
                S[e, t : t + 3, t_of_fixed] = T[:3, 3]
                S[e, r : r + 9, H] = T[:3, :3].T.ravel()
        if part.scale == "shared":
            S[e, 6, ALPHA] = 1.0
        elif target in owners:
            S[e, 6, 13 * place[target][0] + 3] = 1.0
        else:
            S[e, 6, H] = 1.0 / part.fixed_scales.get(target, 1.0)
    return Slots(leaf, center, S)


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


def _rounding_of_pairs(part: Part) -> Array:
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
    # Sums over the pairs come on top of the sums over their measurements.
    operations = moments.operations + len(part.pairs) + 20
    unit = np.array([gamma(int(count)) for count in operations])
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
    of_slots = np.einsum("ep,epq->eq", _rounding_of_pairs(part), slots.of_pair**2)
    L, P = len(part.leaves), len(part.centers)
    leaves, centers = np.zeros((L + 1, 13)), np.zeros((P + 1, 13))
    np.add.at(leaves, slots.leaf, of_slots[:, :13])
    np.add.at(centers, slots.center, of_slots[:, 13:26])
    result: Array = np.r_[leaves[:L].ravel(), centers[:P].ravel(), of_slots[:, ALPHA].sum()]
    return result


def as_variable(T: Array, part: Part) -> Array:
    """A pose as the form's variables see it: itself, or its inverse."""
    if part.kind == "direct":
        return T
    inverse = np.eye(4)
    inverse[:3, :3] = T[:3, :3].T
    inverse[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return inverse


def _assembled(part: Part, slots: Slots, of_edges: Array) -> FullForm:
    """The blocks of Q: the sum of the edges' forms (E, 25, 25)."""
    L, P = len(part.leaves), len(part.centers)
    leaf_of, center_of, S = slots.leaf, slots.center, slots.of_pair
    Q = S.transpose(0, 2, 1) @ of_edges @ S
    one, two, tail = slice(0, 13), slice(13, 26), slice(26, 28)
    # One row more than there are frames: where an edge has no leaf or no center, its zeros go there.
    leaf, leaf_tail = np.zeros((L + 1, 13, 13)), np.zeros((L + 1, 13, 2))
    center, center_tail = np.zeros((P + 1, 13, 13)), np.zeros((P + 1, 13, 2))
    leaf_center = np.zeros((L + 1, P + 1, 13, 13))
    np.add.at(leaf, leaf_of, Q[:, one, one])
    np.add.at(leaf_tail, leaf_of, Q[:, one, tail])
    np.add.at(center, center_of, Q[:, two, two])
    np.add.at(center_tail, center_of, Q[:, two, tail])
    leaf_center[leaf_of, center_of] = Q[:, one, two]  # each pair of frames has one edge
    return FullForm(leaf[:L], leaf_center[:L, :P], leaf_tail[:L], center[:P], center_tail[:P], Q[:, tail, tail].sum(0))


def _add_priors(form: FullForm, part: Part) -> None:
    """Add kappa |R - R_0|_F^2 / 2 and |t - t_0|^2 / (2 sigma^2), quadratic once multiplied by h (design fact 11)."""
    place = {name: (form.leaf, form.leaf_tail, i) for i, name in enumerate(part.leaves)}
    place |= {name: (form.center, form.center_tail, i) for i, name in enumerate(part.centers)}
    for name, priors in part.priors.items():
        if name not in place:
            continue
        block, tail, index = place[name]
        for prior in priors:
            quadratic = _prior_form(prior.transform, prior.sigma, prior.kappa, part)
            block[index] += quadratic[:13, :13]
            tail[index, :, 1] += quadratic[:13, 13]
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
