"""The small dual (design fact 4a): better multipliers of all constraints at the same point.

At a critical point x the multipliers of R'R = I are unique, but the multipliers of all 20 independent constraints are
not: for each rotation, 14 combinations N of the constraints have N x = 0. Adding them changes Z = Q' - Lambda, leaves Z
x = 0, and may make Z positive semidefinite. The small dual maximises t subject to z'Z(y) z >= t z'P z for all z with
z'P x = 0, by log-barrier Newton on (y, t). It stops as soon as t is safely positive, since any such y proves the same.

P sets the measure: Q' with a little added to its diagonal. Weights of translations and rotations differ by powers of
ten, and the directions that matter are those in which Q' is smallest. With the identity in place of P, t would not
show them.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.descent import homogeneous
from gtsam_rwhec.solver.rotations import CONSTRAINTS, vec


def local_indices(n: int) -> np.ndarray:
    """(n, 10): rows [9 i, ..., 9 i + 8, 9 n] of each rotation."""
    return np.concatenate([np.arange(9 * n).reshape(n, 9), np.full((n, 1), 9 * n)], axis=1)


def scatter(blocks: Array) -> Array:
    """The sum of local matrices (n, 10, 10), as one (9 n + 1, 9 n + 1) matrix."""
    n = len(blocks)
    full = np.zeros((9 * n + 1, 9 * n + 1))
    np.einsum("iaib->iab", full[:-1, :-1].reshape(n, 9, n, 9))[...] = blocks[:, :9, :9]
    full[:-1, -1] = full[-1, :-1] = blocks[:, :9, 9].ravel()
    full[-1, -1] = blocks[:, 9, 9].sum()
    return full


def gather(W: Array) -> Array:
    """The local blocks (n, 10, 10) of one matrix."""
    index = local_indices((len(W) - 1) // 9)
    blocks: Array = W[index[:, :, None], index[:, None, :]]
    return blocks


def traces(family: Array, W: Array) -> Array:
    """(n, c): tr(A_ik W)."""
    blocks = gather(W)
    n, c = family.shape[:2]
    result: Array = np.matmul(family.reshape(n, c, 100), blocks.transpose(0, 2, 1).reshape(n, 100, 1))[:, :, 0]
    return result


def gram(family: Array, W: Array, V: Array) -> Array:
    """(n c, n c): tr(A_ik W A_jl V) for symmetric W and V; symmetric in (ik), (jl), as tr(M) = tr(M')."""
    n, c = family.shape[:2]
    index = local_indices(n)
    flat = family.reshape(n, c, 100)
    result = np.empty((n, c, n, c))
    for i in range(n):
        later = slice(i, n)
        rows = index[i]
        W_i = W[rows[None, :, None], index[later, None, :]]  # [j, b, c]
        V_i = V[index[later, :, None], rows[None, None, :]]  # [j, d, a]
        AW = np.matmul(family[i].reshape(1, c * 10, 10), W_i).reshape(-1, c, 10, 10)  # [j, k, a, c]
        VAW = np.matmul(V_i[:, None], AW)  # [j, k, d, c]
        # A_jl is symmetric: [c, d] and [d, c] give the same contraction.
        block = np.matmul(VAW.reshape(-1, c, 100), flat[later].transpose(0, 2, 1))  # [j, k, l]
        result[i, :, later] = block.transpose(1, 0, 2)
        result[later, :, i] = block.transpose(0, 2, 1)
    return result.reshape(n * c, n * c)


#: Where Z is above this much of P, the verified test succeeds despite rounding: then no more steps are made.
ENOUGH, MOST_STEPS = 1e-2, 60


def null_multipliers(R: Array) -> Array:
    """(n, 14, 20): orthonormal combinations of the constraints whose matrix N has N x = 0 at x = [vec R, 1]."""
    # The rank of the normals is 6, the dimension of the normal space of SO(3) (Theorem 6).
    _, _, Vt = np.linalg.svd(_normals(R))
    return Vt[:, 6:, :]


def _normals(R: Array) -> Array:
    """(n, 9, 20): A_k x without the row of h, which follows from x'A_k x = 0."""
    columns: Array = np.einsum("kpq,nq->npk", CONSTRAINTS, np.c_[vec(R), np.ones(len(R))])[:, :9]
    return columns


def stationary_multipliers(gradient: Array, R: Array, multipliers: Array) -> Array:
    """The multipliers (n, 20) nearest to the given ones with Z x = 0 at x = [vec R, 1], a critical point.

    ``gradient`` (n, 9) is half that of the cost by the entries of the rotations.
    """
    normals = _normals(R)
    residual = gradient - np.einsum("npk,nk->np", normals, multipliers)
    correction = np.matmul(np.linalg.pinv(normals, rcond=1e-9), residual[:, :, None])[:, :, 0]
    result: Array = multipliers + correction
    return result


def improve(Q: Array, R: Array, multipliers: Array) -> tuple[Array, float]:
    """Maximise t with z'Z z >= t z'P z for all z with z'P x = 0, over the multipliers that keep Z x = 0.

    R (n, 3, 3) is a critical point. Z x is zero at the given multipliers (n, 20) and at the returned ones. A positive t
    proves x optimal: z'(Z - t P) z > 0 for all such z but 0. Where rounding errors have given Q' a negative eigenvalue,
    t is minus infinity and the multipliers are the given ones.
    """
    x = homogeneous(R)
    Z = Q - scatter(np.einsum("nk,kpq->npq", multipliers, CONSTRAINTS))
    Z = 0.5 * (Z + Z.T)
    Z[-1, -1] -= float(x @ Z @ x)  # the multiplier of h^2 = 1: then Z x = 0 in h's row too
    return maximise(Z, Q, R, multipliers)


def maximise(Z: Array, Q: Array, R: Array, multipliers: Array) -> tuple[Array, float]:
    """The same for any Z with Z x = 0, over x = [vec R, 1], which is Z at the given multipliers; P is made of Q."""
    n = len(R)
    null = null_multipliers(R)
    family = np.einsum("nmk,kpq->nmpq", null, CONSTRAINTS)
    x = homogeneous(R)
    scale = float(np.abs(np.diagonal(Z)).max()) or 1.0
    Z0 = Z / scale
    P = Q / scale
    P[np.diag_indices_from(P)] += 1e-9 * np.abs(np.diagonal(P)) + 1e-12
    try:
        np.linalg.cholesky(P)
    except np.linalg.LinAlgError:  # rounding errors of the reduction made P indefinite
        return multipliers, -np.inf
    # A term along P x excludes x from the test. It changes nothing for z with z'P x = 0.
    along_x = P @ x / np.sqrt(float(x @ P @ x))
    try:
        t = float(scipy.linalg.eigh(Z0, P, eigvals_only=True, subset_by_index=[0, 0], check_finite=False)[0])
    except np.linalg.LinAlgError:  # P is singular: Q' is zero, or its entries differ by all of double precision
        return multipliers, -np.inf
    t -= 0.1 * max(abs(t), 1e-3)
    Z0 += 10.0 * max(abs(t), 1.0) * np.outer(along_x, along_x)
    y = np.zeros(14 * n)
    weight = 0.0  # of the barrier
    best = (multipliers, -np.inf)
    for _ in range(MOST_STEPS):
        Z = Z0 + scatter(np.einsum("nm,nmpq->npq", y.reshape(n, 14), family))
        try:
            factor = scipy.linalg.cho_factor(Z - t * P, lower=True, check_finite=False)
        except np.linalg.LinAlgError:
            break
        W = scipy.linalg.cho_solve(factor, np.eye(len(Z)), check_finite=False)
        W = 0.5 * (W + W.T)
        if t > best[1]:
            added = np.einsum("nm,nmk->nk", y.reshape(n, 14), null)
            best = (multipliers - scale * added, t)
        if t > ENOUGH:
            break
        # Newton on -t - weight log det(Z(y) - t P).
        WP = W @ P
        weight = weight or 1.0 / float(np.trace(WP))  # so that at first the barrier holds t where it is
        W2 = WP @ W
        M = gram(family, W, W)
        along = traces(family, W2).ravel()
        gradient = np.r_[-weight * traces(family, W).ravel(), -1.0 + weight * np.trace(WP)]
        H = np.empty((14 * n + 1, 14 * n + 1))
        H[:-1, :-1] = M
        H[:-1, -1] = H[-1, :-1] = -along
        H[-1, -1] = float(np.vdot(WP, WP.T))
        H *= weight
        H[np.diag_indices_from(H)] *= 1.0 + 1e-12
        try:
            step = -scipy.linalg.cho_solve(scipy.linalg.cho_factor(H, check_finite=False), gradient, check_finite=False)
        except np.linalg.LinAlgError:
            break
        decrement = float(np.sqrt(max(-(gradient @ step), 0.0) / weight))
        direction = scatter(np.einsum("nm,nmpq->npq", step[:-1].reshape(n, 14), family)) - step[-1] * P
        # The damped step is safe and short; a step four times as long mostly stays inside too. No step is longer than
        # Newton's: longer ones oscillate about the centre without end.
        length = _stay_inside(Z - t * P, direction, min(1.0, 4.0 / (1.0 + decrement)))
        y = y + length * step[:-1]
        t += length * step[-1]
        if decrement < 0.5:
            if weight * len(Z0) < 1e-9:
                break
            weight *= 0.2
    return best


def _stay_inside(S: Array, direction: Array, length: float) -> float:
    """The first of length, length / 2, ... that keeps S + length * direction positive definite, a little shorter."""
    while True:
        try:
            np.linalg.cholesky(S + length * direction)
        except np.linalg.LinAlgError:
            length *= 0.5
            if length < 1e-12:
                return 0.0
        else:
            return length if length == 1.0 else 0.9 * length
