"""Dan (Daniilidis 1999), and nonlinear least squares: DQNLOpt and DQNLOptRnd on the cost (8), ChVecOpt and QuatVecOpt
on the costs (30).

Each cost is a quadratic form y'F y, where the few numbers y are computed from the pose. The unknowns are a
quaternion p of any length (q = p / |p|) and a translation in units of 1/alpha, so every start can reach every
rotation.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.linalg import block_diag

from gtsam_rwhec.errors import OptionError, UnderdeterminedError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import ROTATION, left, right
from gtsam_rwhec.methods.dq_saddle import Minimum, minimum
from gtsam_rwhec.methods.dual_quaternion_cost import (
    E,
    blocks,
    by_parts,
    from_transforms,
    gram,
    times_vectors,
    to_transform,
)
from gtsam_rwhec.methods.hand_eye_request import Request, free_directions, free_of_rotations_alone
from gtsam_rwhec.methods.levenberg_marquardt import descend_on_chart, unit_quaternions
from gtsam_rwhec.methods.method import Outcome
from gtsam_rwhec.methods.motions import Motions, squared_residuals

#: A descent takes at most this many steps.
STEPS = 1000
#: vec R (rows) of a unit quaternion is quadratic in it: entry k is q' _QUADRATIC[k] q.
_QUADRATIC = ROTATION.transpose(2, 3, 0, 1).reshape(9, 4, 4)
#: The numbers y (n,) of a pose's q (4,) and t (3,), with their derivatives (n, 4) by q and (n, 3) by t.
Lift = Callable[[Array, Array], tuple[Array, Array, Array]]


def dqnlopt(request: Request) -> Outcome[Array]:
    """DQNLOpt minimises the cost (8) from DQOpt's answer, and should stay there (Section 4.4)."""
    found = minimum(request.cost)
    return _outcome(request, found, _descend_dual_quaternion(request, to_transform(found.q, found.q_dual)))


def dqnlopt_random(request: Request) -> Outcome[Array]:
    """DQNLOptRnd minimises the cost (8) from a random pose. Some runs end in local minima (Table 1).

    The start's rotation is uniform. Its translation is normal, with the root mean square of the motions' translations.
    """
    try:
        rng = np.random.default_rng(request.rng)
    except (TypeError, ValueError) as error:
        raise OptionError(
            f"rng={request.rng!r} is not a source of random numbers ({error}); give a numpy.random.Generator or a seed "
            "that is not negative"
        ) from error
    q, t = rng.normal(size=4), rng.normal(size=3) * _length(request)
    X = _descend_dual_quaternion(request, to_transform(q, 0.5 * times_vectors(q) @ t))
    return _outcome(request, minimum(request.cost), X)


def chvecopt(request: Request) -> Outcome[Array]:
    """ChVecOpt: |R_C R - R R_H|^2 + alpha^2 |(R_C - 1) T - R T_H + T_C|^2 (eq. 30, first), from DQOpt's answer.

    The paper names no start. The method ``certified`` minimises the same cost and proves the minimum.
    """
    rotation, translation = chordal_moments(request.motions, request.weights)

    def lift(q: Array, t: Array) -> tuple[Array, Array, Array]:
        by_q = rotation_slopes(q)
        y, y_by_q, by_t = _vector_lift(by_q, q, t)
        return np.concatenate([y[:9], y]), np.concatenate([by_q, y_by_q]), np.concatenate([np.zeros((9, 3)), by_t])

    found = minimum(request.cost)
    X = _descend_vector(request, found, rotation, translation, lift)
    of_R, of_T = chordal_residuals(request.motions, X, request.weights)
    return _outcome(request, found, X, of_R + request.alpha**2 * of_T, "eq. 30, chordal")


def quatvecopt(request: Request) -> Outcome[Array]:
    """QuatVecOpt: |q_C q - q q_H|^2 + alpha^2 |(R_C - 1) T - R T_H + T_C|^2 (eq. 30, second), from DQOpt's answer."""
    _, translation = chordal_moments(request.motions, request.weights)

    def lift(q: Array, t: Array) -> tuple[Array, Array, Array]:
        y, y_by_q, by_t = _vector_lift(rotation_slopes(q), q, t)
        return np.concatenate([q, y]), np.concatenate([np.eye(4), y_by_q]), np.concatenate([np.zeros((4, 3)), by_t])

    AA = request.cost.M / request.alpha**2  # the sum of A'A
    found = minimum(request.cost)
    X = _descend_vector(request, found, AA, translation, lift)
    (q,), (q_dual,) = from_transforms(X[None])
    of_q, _ = squared_residuals(request.motions, q, q_dual, request.weights)
    _, of_T = chordal_residuals(request.motions, X, request.weights)
    return _outcome(request, found, X, of_q + request.alpha**2 * of_T, "eq. 30, quaternion")


def chordal_moments(motions: Motions, weights: Array | None = None) -> tuple[Array, Array]:
    """The two forms of eq. 30, summed over the motions in one pass.

    Rotation (9, 9): |R_C R - R R_H|^2 as a form of vec R. Here vec takes rows: R_C (x) I - I (x) R_H'. Translation
    (13, 13): |(R_C - 1) T - R T_H + T_C|^2 as a form of (vec R, T, 1).
    """
    rotation, translation = np.zeros((9, 9)), np.zeros((13, 13))
    for block in blocks(len(motions)):
        C, H = motions.C[block], motions.H[block]
        w = np.ones(len(C)) if weights is None else weights[block]
        # (R_C (x) I - I (x) R_H')'(...) = 2 I - R_C' (x) R_H' - R_C (x) R_H. Entry (i, j), (k, l) of R_C (x) R_H is
        # R_C[i, k] R_H[j, l].
        K = np.einsum("n,nik,njl->ijkl", w, C[:, :3, :3], H[:, :3, :3], optimize=True).reshape(9, 9)
        rotation += 2.0 * w.sum() * np.eye(9) - K - K.T
        # Row r of the residual is -t_H . R[r] + (R_C - 1)[r] . T + t_C[r]: seven numbers f_r times the unknowns.
        f = np.empty((len(C), 3, 7))
        f[:, :, :3] = -H[:, None, :3, 3]
        f[:, :, 3:] = C[:, :3] - np.eye(3, 4)
        for r in range(3):
            used = [3 * r, 3 * r + 1, 3 * r + 2, 9, 10, 11, 12]
            translation[np.ix_(used, used)] += (f[:, r] * w[:, None]).T @ f[:, r]
    return rotation, translation


def chordal_residuals(motions: Motions, X: Array, weights: Array | None = None) -> tuple[float, float]:
    """The sums of |R_C R - R R_H|^2 and |(R_C - 1) T - R T_H + T_C|^2 of a pose (4, 4), from the motions' residuals."""
    by_column = np.zeros(4)  # three of the rotation, one of the translation
    for block in blocks(len(motions)):
        E = motions.C[block] @ X - X @ motions.H[block]
        squares = (E[:, :3] ** 2).sum(axis=1)
        by_column += squares.sum(axis=0) if weights is None else weights[block] @ squares
    return float(by_column[:3].sum()), float(by_column[3])


def _vector_lift(slopes: Array, q: Array, t: Array) -> tuple[Array, Array, Array]:
    """(vec R, t, 1) (13,), with vec R quadratic in q."""
    by_q, by_t = np.zeros((13, 4)), np.zeros((13, 3))
    by_q[:9], by_t[9:12] = slopes, np.eye(3)
    return np.concatenate([0.5 * slopes @ q, t, [1.0]]), by_q, by_t


def _descend_vector(request: Request, found: Minimum, rotation: Array, translation: Array, lift: Lift) -> Array:
    """Minimise a cost of eq. 30 from DQOpt's answer; the pose (4, 4) where the descent ends."""
    form = block_diag(rotation, request.alpha**2 * translation)
    return _descend(form, lift, to_transform(found.q, found.q_dual), 1.0 / request.alpha)


def _descend_dual_quaternion(request: Request, start: Array) -> Array:
    """Minimise the cost (8), prior included; the pose (4, 4) where the descent ends."""
    cost = request.cost

    def lift(q: Array, t: Array) -> tuple[Array, Array, Array]:  # y = (q, q')
        pure = left(np.append(0.5 * t, 0.0))
        by_t = np.concatenate([np.zeros((4, 3)), 0.5 * right(q)[:, :3]])
        return np.concatenate([q, pure @ q]), np.concatenate([np.eye(4), pure]), by_t

    unit = 1.0 / request.alpha if request.covariances is None else _length(request)
    return _descend(np.block([[cost.S, cost.W], [cost.W.T, cost.M]]), lift, start, unit)


def _descend(form: Array, lift: Lift, start: Array, unit: float) -> Array:
    """Minimise y' form y over poses from a start (4, 4), translations in units of ``unit`` metres."""

    def chart(x: Array) -> tuple[Array, Array]:
        (q,), (slope,) = unit_quaternions(x[None, :4])
        y, by_q, by_t = lift(q, unit * x[4:])
        return y, np.hstack([by_q @ slope, unit * by_t])

    (q,), _ = from_transforms(start[None])
    x = descend_on_chart(form, chart, np.concatenate([q, start[:3, 3] / unit]), STEPS)
    q = x[:4] / np.linalg.norm(x[:4])
    return to_transform(q, 0.5 * unit * times_vectors(q) @ x[4:])


def rotation_slopes(q: Array) -> Array:
    """Derivatives (9, 4) of vec R (rows) by a unit quaternion xyzw. vec R is half the derivatives times q."""
    slopes: Array = 2.0 * _QUADRATIC @ q
    return slopes


def _outcome(
    request: Request, found: Minimum, X: Array, cost: float | None = None, cost_name: str = ""
) -> Outcome[Array]:
    """The answer X (4, 4), with the free directions of the cost (8) at DQOpt's answer."""
    free = free_directions(request, found.q, found.values, found.vectors)
    return Outcome(X, cost=cost, cost_name=cost_name, free_directions=free)


def _length(request: Request) -> float:
    """Root mean square of the motions' translations, metres; 1 where nothing moves."""
    t = np.concatenate([request.motions.C[:, :3, 3], request.motions.H[:, :3, 3]])
    return float(np.sqrt((t * t).mean())) or 1.0


#: Squares of singular values below this part of the largest are rounding error.
NULL = 1e-13
#: These rows of ``Motions.rows`` hold vector parts.
_VECTORS = [0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 12]
#: Row 6 k + l is vec(P_k' P_l): P is linear in the six numbers (v_C + v_H, v_C - v_H).
_PRODUCTS = np.einsum("kji,ljm->klim", E[:6, :3], E[:6, :3]).reshape(36, 16)


def daniilidis(request: Request) -> Outcome[Array]:
    """Dan, with translations multiplied by alpha as in Section 4.3.

    Each motion gives six rows [[P, 0], [P', P]] in (q, q'), P = [Skew(v_C + v_H), v_C - v_H] (3 x 4, scalar last) and
    P' the same of the dual parts: eq. 7 without the scalar parts. Nothing is minimised.

    Raises UnderdeterminedError when all axes are parallel, or no motion rotates: the null space then has more than two
    dimensions.
    """
    moments = gram(request.motions.rows, request.weights)[np.ix_(_VECTORS, _VECTORS)]
    moments[6:] *= request.alpha
    moments[:, 6:] *= request.alpha
    values, vectors = np.linalg.eigh(squared(moments))
    if values[2] <= NULL * values[7]:
        raise UnderdeterminedError(
            "Daniilidis' equations have more than the two null vectors of a solvable problem: no motion rotates, or "
            "all motions rotate about parallel axes; add motions about another axis, or use method='dqopt', which "
            "solves what can be solved and names the free directions"
        )
    q, q_dual = unit_combination(vectors[:4, :2], vectors[4:, :2])
    free = free_of_rotations_alone(request)
    return Outcome(to_transform(q, q_dual / request.alpha), free_directions=free)


def squared(moments: Array) -> Array:
    """T'T (8, 8) from moments (12, 12) of (v_C + v_H, v_C - v_H) of the primal parts, then of the dual parts."""
    (PP, _), (DP, DD) = by_parts(moments, _PRODUCTS)
    return np.block([[PP + DD, DP], [DP.T, PP]])


def unit_combination(u: Array, v: Array) -> tuple[Array, Array]:
    """The unit dual quaternion among the combinations of two vectors: the columns of u (4, 2) over those of v (4, 2).

    Two combinations have q . q' = 0. The combination with the longer q is taken: without noise the other q vanishes.
    (The paper solves for the ratio s of the coefficients and must avoid a vector whose coefficient is 0. An angle
    avoids no vector.) Raises UnderdeterminedError when no combination has a rotation.
    """
    (a, b), (c, d) = (u.T @ v).tolist()
    # (x, y) = (cos phi, sin phi):  a x^2 + (b + c) x y + d y^2 = (a + d + (a - d) cos 2 phi + (b + c) sin 2 phi) / 2
    amplitude, middle = math.hypot(a - d, b + c), math.atan2(b + c, a - d)
    spread = math.acos(max(-1.0, min(1.0, -(a + d) / amplitude))) if amplitude > 0.0 else 0.0
    phi = 0.5 * np.array([middle + spread, middle - spread])
    candidates = np.stack([np.cos(phi), np.sin(phi)])
    lengths = np.linalg.norm(u @ candidates, axis=0)
    best = int(lengths.argmax())
    if lengths[best] <= 1e-12:
        raise UnderdeterminedError(
            "the null vectors of Daniilidis' equations hold no rotation; add motions about two different axes"
        )
    x = candidates[:, best] / lengths[best]
    return u @ x, v @ x
