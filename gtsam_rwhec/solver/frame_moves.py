"""Better rotations of single frames: a start that leaves the local minima of frames with few measurements.

In a large graph a local minimum is mostly that of one frame: a few measurements, of which some are wrong, allow it two
rotations. Starts at random for all frames hardly ever find another rotation of one. Here every frame looks for itself,
with all others held: the cost is r'M r + 2 l'r of its rotation r, once its own translation and scale are eliminated.
All frames and all their starts descend at once.
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.own_forms import own_forms
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.point import Evaluation
from gtsam_rwhec.solver.rotations import random_rotations, retract, tangent_basis, unvec, vec

#: Newton steps of each descent; most end after six.
STEPS = 30
#: The cost of a better rotation is lower by at least this part of the frame's own diagonal, and of the whole cost.
OF_DIAGONAL, OF_COST = 1e-9, 1e-9
_I3 = np.eye(3)


def better_frames(whole: PartForm, evaluation: Evaluation, starts: int, generator: np.random.Generator) -> Array:
    """The rotations (n, 3, 3) of the evaluated point, with a better one for each frame that has one by itself.

    Each frame descends from ``starts`` random rotations. Neighbours that move at the same time may make the cost
    higher: the caller descends from here, and compares.
    """
    R = evaluation.point.rotations
    M, linear = own_forms(whole, evaluation)
    n = len(R)
    found = R.copy()
    before = _cost(M, linear, R)
    lowest = before - OF_DIAGONAL * np.einsum("nii->n", M) - OF_COST * abs(evaluation.cost)
    if n == 0 or starts == 0:
        return found
    ends = _descend(np.tile(M, (starts, 1, 1)), np.tile(linear, (starts, 1)), random_rotations(starts * n, generator))
    costs = _cost(np.tile(M, (starts, 1, 1)), np.tile(linear, (starts, 1)), ends).reshape(starts, n)
    best = costs.argmin(axis=0)
    at = np.arange(n)
    better = costs[best, at] < lowest
    found[better] = ends.reshape(starts, n, 3, 3)[best, at][better]
    return found


def _cost(M: Array, linear: Array, R: Array) -> Array:
    r = vec(R)
    result: Array = np.einsum("ni,nij,nj->n", r, M, r) + 2.0 * (linear * r).sum(axis=1)
    return result


def _descend(M: Array, linear: Array, R: Array) -> Array:
    """Newton's method on SO(3), damped until each Hessian is positive definite, for all at once."""
    size = np.einsum("nii->n", M) / 9.0 + 1e-290
    damping = np.full(len(R), 0.1)
    cost = _cost(M, linear, R)
    for _ in range(STEPS):
        basis = tangent_basis(R)
        q = np.einsum("nij,nj->ni", M, vec(R)) + linear
        gradient = np.einsum("nik,ni->nk", basis, q)
        S = unvec(q).transpose(0, 2, 1) @ R
        H = basis.transpose(0, 2, 1) @ M @ basis + 0.5 * (S + S.transpose(0, 2, 1))
        H -= np.einsum("nii->n", S)[:, None, None] * _I3
        values, vectors = np.linalg.eigh(H)
        values = np.abs(values) + (damping * size)[:, None]
        step = -np.einsum("nij,nj->ni", vectors, np.einsum("nij,ni->nj", vectors, gradient) / values)
        length = np.linalg.norm(step, axis=1, keepdims=True)
        candidate = retract(R, step * np.minimum(1.0, 1.0 / np.maximum(length, 1e-290)))
        after = _cost(M, linear, candidate)
        lower = after < cost
        R = np.where(lower[:, None, None], candidate, R)
        cost = np.where(lower, after, cost)
        damping = np.where(lower, 0.2 * damping, 4.0 * damping + 1e-9)
    return R
