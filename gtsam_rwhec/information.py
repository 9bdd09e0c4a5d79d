"""The Fisher information of a part's measurements about poses and scales, and what noise alone would create.

Parameters are what users perturb: for each free frame [omega, v], a right perturbation T Expmap(xi) in GTSAM's order
(rad, m), and the logarithm of each unknown scale. The residuals are linear in the form's variables, so with P their
derivative by the parameters the Gauss-Newton information is 2 P' Q P.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.certify.full_form import FullForm
from gtsam_rwhec.certify.parts import Part
from gtsam_rwhec.certify.rotations import tangent_basis, vec
from gtsam_rwhec.certify.variables import Answer, as_variables
from gtsam_rwhec.poses import Array
from gtsam_rwhec.statistics import ONE

#: Below a nanoradian and a nanometre nothing is noise: exact data.
FLOOR_RAD = 1e-9
FLOOR_M = 1e-9
#: Columns of a frame's parameters: rotation, translation, logarithm of its own scale.
OMEGA, V, OWN = slice(0, 3), slice(3, 6), 6


@dataclass(frozen=True)
class Derivative:
    """How the form's variables move: frames (n, 13, 7) by their own parameters, (n, 13) and tail by log scale."""

    frames: Array
    by_scale: Array
    tail: Array


def derivative(part: Part, answer: Answer) -> Derivative:
    """P, frame by frame, at an answer."""
    n = len(answer.R)
    frames = np.zeros((n, 13, 7))
    by_scale = np.zeros((n, 13))
    leaf, center, _ = as_variables(part, answer)
    numbers = np.concatenate([leaf, center])
    shared = 1.0 if part.scale == "shared" else 0.0
    if part.kind == "direct":  # t = alpha t_X, r = vec R
        alpha = answer.scale if part.scale == "shared" else 1.0
        frames[:, 4:, OMEGA] = tangent_basis(answer.R)
        frames[:, :3, V] = alpha * answer.R
        by_scale[:, :3] = shared * numbers[:, :3]
        tail = np.array([shared * answer.scale, 0.0])
    else:  # (T exp(xi))^-1 = exp(-xi) T^-1: dR' = -omega^ R', dt' = -omega x t' - v; the scale enters as 1/alpha
        for k in range(3):
            E = np.zeros((3, 3))
            E[(k + 2) % 3, (k + 1) % 3], E[(k + 1) % 3, (k + 2) % 3] = 1.0, -1.0
            frames[:, 4:, k] = -vec(E @ answer.R.transpose(0, 2, 1))
            frames[:, :3, k] = -numbers[:, :3] @ E.T
        frames[:, :3, V] = -np.eye(3)
        frames[:, 3, OWN] = -numbers[:, 3]
        tail = np.array([-shared / answer.scale, 0.0])
    return Derivative(frames, by_scale, tail)


@dataclass(frozen=True)
class Information:
    """Arrow-shaped information: leaf (L, 7, 7), coupling (L, 7, 7 P + 1), border (7 P + 1 square).

    Order of the border: the centers' seven, then the logarithm of the shared scale. ``used_leaf`` and ``used_border``
    mark the parameters that exist.
    """

    leaf: Array
    coupling: Array
    border: Array
    used_leaf: np.ndarray
    used_border: np.ndarray


def information(part: Part, full: FullForm, P: Derivative) -> Information:
    """2 P' Q P in blocks."""
    L, C = full.leaves, full.centers
    leaf_P, center_P = P.frames[:L], P.frames[L:]
    leaf_s, center_s = P.by_scale[:L], P.by_scale[L:]
    leaf_Pt, center_Pt = leaf_P.transpose(0, 2, 1), center_P.transpose(0, 2, 1)
    leaf = leaf_Pt @ full.leaf @ leaf_P
    center = center_Pt @ full.center @ center_P
    coupling = np.zeros((L, 7, 7 * C + 1))
    border = np.zeros((7 * C + 1, 7 * C + 1))
    rows = np.matmul(leaf_Pt[:, None], full.leaf_center)  # (L, C, 7, 13)
    coupling[:, :, :-1] = np.matmul(rows, center_P[None]).transpose(0, 2, 1, 3).reshape(L, 7, 7 * C)
    # The shared scale moves every translation and alpha: its column of Q P, frame by frame.
    leaf_column = (
        np.einsum("lij,lj->li", full.leaf, leaf_s)
        + np.einsum("lcij,cj->li", full.leaf_center, center_s)
        + full.leaf_tail @ P.tail
    )
    center_column = (
        np.einsum("cij,cj->ci", full.center, center_s)
        + np.einsum("lcij,li->cj", full.leaf_center, leaf_s)
        + full.center_tail @ P.tail
    )
    tail_column = (
        np.einsum("lit,li->t", full.leaf_tail, leaf_s)
        + np.einsum("cit,ci->t", full.center_tail, center_s)
        + full.tail @ P.tail
    )
    coupling[:, :, -1] = np.einsum("lij,li->lj", leaf_P, leaf_column)
    for c in range(C):
        at = slice(7 * c, 7 * c + 7)
        border[at, at] = center[c]
        border[at, -1] = border[-1, at] = center_P[c].T @ center_column[c]
    border[-1, -1] = (leaf_s * leaf_column).sum() + (center_s * center_column).sum() + P.tail @ tail_column
    owners = set(part.scale_owners)
    used = np.ones((L + C, 7), dtype=bool)
    used[:, OWN] = [name in owners for name in part.free]
    return Information(
        2.0 * leaf,
        2.0 * coupling,
        2.0 * border,
        used[:L],
        np.r_[used[L:].ravel(), part.scale == "shared"],
    )


@dataclass(frozen=True)
class NoiseLevel:
    """Variance factors of the residuals: 1 when the weights are true. ``redundancy`` is equations minus unknowns."""

    translation: float
    rotation: float
    redundancy: int


def noise_level(part: Part, translation_cost: float, rotation_cost: float) -> NoiseLevel:
    """Variance factors from the residuals at the optimum, corrected for the unknowns that were fitted.

    J_t is sum |r|^2 / (2 sigma^2), expected 3 N / 2; J_R is sum kappa |dR|_F^2 / 2 = sum kappa theta^2, expected
    3 N / 2 too, as each axis has variance 1 / (2 kappa).
    """
    N = part.number_of_measurements
    redundancy = 6 * N - part.number_of_unknowns
    correction = 6.0 * N / redundancy if redundancy > 0 else 1.0
    W = sum(float(m.translation[ONE, ONE]) for m in part.moments)
    K = sum(m.kappa for m in part.moments)
    floor_t = W / N * FLOOR_M**2
    floor_R = 2.0 * K / N * FLOOR_RAD**2
    if redundancy <= 0:  # nothing tells the noise but the weights
        return NoiseLevel(1.0, 1.0, redundancy)
    return NoiseLevel(
        max(correction * 2.0 * translation_cost / (3.0 * N), floor_t),
        max(correction * 2.0 * rotation_cost / (3.0 * N), floor_R),
        redundancy,
    )


def noise_information(part: Part, noise: NoiseLevel, scale: float) -> tuple[Array, Array, float]:
    """Information that the noise of A and B alone creates in a direction that the true motions leave free.

    Let the true Jacobian of measurement i vanish along a direction. With noise it is what the noise makes of it:

    - rotation, residual omega_X - R_B' omega_Y: noise eps (variance s^2 an axis) leaves eps x omega, whose square is
      expected at 2 s^2 |omega|^2; times the weight 2 kappa with s^2 = f_R / (2 kappa): 2 f_R |omega|^2;
    - translation, the lever arm R_Y t_B^ omega_Y: 2 f_t |omega_Y|^2; R_A t_X under noise of R_A: 2 s^2 |v|^2 / sigma^2;
    - a scale's, t_B d log alpha: 3 f_t.

    X and Y move together along a free direction, so each end takes half.

    Returns
    -------
    per_edge_ends : (E, 2, 6) array
        Diagonal for [omega, v] of the target's and the sensor's end of each edge.
    per_edge_scale : (E,) array
    """
    ends = np.zeros((len(part.pairs), 2, 6))
    own = np.zeros(len(part.pairs))
    alpha = scale if part.kind == "direct" and part.scale == "shared" else 1.0
    for e, moments in enumerate(part.moments):
        n, W = moments.count, float(moments.translation[ONE, ONE])
        variance = noise.rotation * n / (2.0 * moments.kappa)  # s^2, rad^2
        lever = alpha**2 * W * variance
        ends[e, :, :3] = n * (noise.rotation + noise.translation)
        ends[e, :, 3:] = max(lever, 1e-18 * W)
        own[e] = 3.0 * n * noise.translation
    return ends, own, float(own.sum())
