"""The full quadratic form Q (RWHEC paper eq. 42), kept in blocks.

Every free frame has 13 numbers, [t (3), s (1), vec R (9)], s its own scale where it has one. Two numbers belong to
all: alpha, the shared scale, and h, the homogenising entry (1 at every answer). What a problem does not use stays
zero and is left out by the reduction. x' Q x is the cost J, its 1/2 included.

In the "direct" kind t is alpha times the translation; in the "inverse" kind frames are inverted (X^-1, Y^-1) and the
scale variable is 1/alpha.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.moments import SWAPPED, edge_forms
from gtsam_rwhec.solver.parts import Part

#: Positions among an edge's 28 numbers: leaf (13), center (13), alpha, h.
ALPHA, H = 26, 27


@dataclass(frozen=True)
class FullForm:
    """Blocks of Q, and of its rotation residuals alone.

    leaf (L, 13, 13); leaf_center (L, P, 13, 13); leaf_tail (L, 13, 2); center (P, 13, 13); center_tail (P, 13, 2);
    tail (2, 2): alpha and h.
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
class EdgeSlots:
    """Where the edges of a part go: indices of leaf and center (one past the end: none), and 25 -> 28 substitution."""

    leaf: np.ndarray
    center: np.ndarray
    substitution: Array


def edge_slots(part: Part) -> EdgeSlots:
    """The substitution of each edge's [t_X, t_Y, alpha, r_X, r_Y] by leaf, center, alpha and h.

    A fixed frame becomes constants times h (its translation times alpha, where t is alpha times the translation);
    a known scale becomes h; both ends of a motion are one frame.
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
                T = _as_variable(part.fixed[name], part)
                S[e, t : t + 3, t_of_fixed] = T[:3, 3]
                S[e, r : r + 9, H] = T[:3, :3].T.ravel()
        if part.scale == "shared":
            S[e, 6, ALPHA] = 1.0
        elif target in owners:
            S[e, 6, 13 * place[target][0] + 3] = 1.0
        else:
            S[e, 6, H] = 1.0 / part.fixed_scales.get(target, 1.0)
    return EdgeSlots(leaf, center, S)


def _as_variable(T: Array, part: Part) -> Array:
    """A pose as the form's variables see it: itself, or its inverse."""
    if part.kind == "direct":
        return T
    inverse = np.eye(4)
    inverse[:3, :3] = T[:3, :3].T
    inverse[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return inverse


def forms_of_edges(part: Part) -> tuple[Array, Array]:
    """Translation and rotation forms (E, 25, 25) of all edges of a part."""
    translation, rotation = part.moments.translation, part.moments.rotation
    if part.kind == "inverse":
        translation = translation[:, SWAPPED[:, None], SWAPPED]
        rotation = rotation.transpose(0, 2, 1)
    return edge_forms(translation, rotation, part.moments.kappa)


def assemble(part: Part, slots: EdgeSlots, edge_form: Array) -> FullForm:
    """Add up the edges' forms (E, 25, 25) into the blocks of Q."""
    L, P = len(part.leaves), len(part.centers)
    Q = slots.substitution.transpose(0, 2, 1) @ edge_form @ slots.substitution
    one, two, tail = slice(0, 13), slice(13, 26), slice(26, 28)
    # One row more than there are frames: where an edge has no leaf or no center, its zeros go there.
    leaf, leaf_tail = np.zeros((L + 1, 13, 13)), np.zeros((L + 1, 13, 2))
    center, center_tail = np.zeros((P + 1, 13, 13)), np.zeros((P + 1, 13, 2))
    leaf_center = np.zeros((L + 1, P + 1, 13, 13))
    np.add.at(leaf, slots.leaf, Q[:, one, one])
    np.add.at(leaf_tail, slots.leaf, Q[:, one, tail])
    np.add.at(center, slots.center, Q[:, two, two])
    np.add.at(center_tail, slots.center, Q[:, two, tail])
    leaf_center[slots.leaf, slots.center] = Q[:, one, two]  # each pair of frames has one edge
    return FullForm(leaf[:L], leaf_center[:L, :P], leaf_tail[:L], center[:P], center_tail[:P], Q[:, tail, tail].sum(0))


def add_priors(form: FullForm, part: Part) -> None:
    """Add kappa |R - R_0|_F^2 / 2 and |t - t_0|^2 / (2 sigma^2), quadratic once multiplied by h (DESIGN fact 11)."""
    place = {name: (form.leaf, form.leaf_tail, i) for i, name in enumerate(part.leaves)}
    place |= {name: (form.center, form.center_tail, i) for i, name in enumerate(part.centers)}
    for name, priors in part.priors.items():
        if name not in place:
            continue
        block, tail, index = place[name]
        for prior in priors:
            quadratic = prior_form(prior.transform, prior.sigma, prior.kappa, part)
            block[index] += quadratic[:13, :13]
            tail[index, :, 1] += quadratic[:13, 13]
            form.tail[1, 1] += quadratic[13, 13]


def prior_form(T: Array, sigma: float | None, kappa: float | None, part: Part) -> Array:
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
        residual[:, 13] = -_as_variable(T, part)[:3, :3].T.ravel()  # r - r_0 h
        rows.append(residual * np.sqrt(kappa))
    stacked = np.concatenate(rows)
    return 0.5 * stacked.T @ stacked
