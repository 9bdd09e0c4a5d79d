"""Least z'Qz over unit dual quaternions: Shor's relaxation, rounding, polishing on the manifold, multipliers.

z = [p_1, p_1', p_2, p_2', ...], |p_i| = 1, <p_i, p_i'> = 0. The relaxation's dual is max sum lambda_i subject to
Z = Q - blkdiag([[lambda_i I, mu_i I], [mu_i I, 0]]) >= 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import clarabel
import numpy as np
import scipy.sparse

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import LEFT, dual_parts, left, of_vectors, right

#: Frames up to which the relaxation is solved; a cone of 8 n takes a dense block of order 4 n (8 n + 1) squared.
MOST_FRAMES = 10
TOLERANCE = 1e-10


@dataclass(frozen=True)
class Relaxed:
    """What the relaxation gives: a start, p (n, 4) and t (n, 3), the solver's bound and its steps."""

    q: Array
    t: Array
    lower_bound: float
    iterations: int


def relaxed(Q: Array, frames: int) -> Relaxed:
    """Solve the relaxation of Q (8 n, 8 n) and round it.

    Beyond ``MOST_FRAMES`` the smallest eigenvector stands in for it, with its eigenvalue's bound, 0.
    """
    if frames > MOST_FRAMES:
        return Relaxed(*rounded(_smallest_eigenvector(Q), frames), 0.0, 0)
    size = 8 * frames
    scale = float(np.abs(Q).max()) or 1.0
    j, i = np.tril_indices(size)  # Clarabel stacks the upper triangle, column after column
    root = np.where(i == j, 1.0, np.sqrt(2.0))
    frame, entry = np.repeat(np.arange(frames), 4), np.tile(np.arange(4), frames)
    primal, dual = 8 * frame + entry, 8 * frame + entry + 4
    rows = np.concatenate([primal * (primal + 1) // 2 + primal, dual * (dual + 1) // 2 + primal])
    columns = np.concatenate([2 * frame, 2 * frame + 1])
    values = np.concatenate([np.ones(4 * frames), np.full(4 * frames, np.sqrt(2.0))])
    A = scipy.sparse.csc_matrix((values, (rows, columns)), (len(i), 2 * frames))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = TOLERANCE
    zero = scipy.sparse.csc_matrix((2 * frames, 2 * frames))
    objective = np.tile([-1.0, 0.0], frames)
    cones = [clarabel.PSDTriangleConeT(size)]
    solution = clarabel.DefaultSolver(zero, objective, A, Q[i, j] / scale * root, cones, settings).solve()
    Z = np.zeros((size, size))
    Z[i, j] = np.array(solution.z) / root
    Z = Z + Z.T - np.diag(np.diagonal(Z))
    q, t = rounded(np.linalg.eigh(Z)[1][:, -1], frames)
    return Relaxed(q, t, scale * float(np.array(solution.x)[::2].sum()), int(solution.iterations))


def _smallest_eigenvector(Q: Array) -> Array:
    """Of Q with its dual parts eliminated, since they have no length of their own; then those."""
    blocks = Q.reshape(-1, 2, 4, len(Q) // 8, 2, 4)
    half = len(Q) // 2
    pp, pd, dd = (blocks[:, a, :, :, b, :].reshape(half, half) for a, b in ((0, 0), (0, 1), (1, 1)))
    to_dual = -np.linalg.lstsq(dd, pd.T, rcond=1e-12)[0]
    p = np.linalg.eigh(pp + pd @ to_dual)[1][:, 0]
    z: Array = np.stack([p.reshape(-1, 4), (to_dual @ p).reshape(-1, 4)], axis=1).ravel()
    return z


def rounded(z: Array, frames: int) -> tuple[Array, Array]:
    """Unit p (n, 4) and t (n, 3) nearest to z: each frame over its length, the dual part made orthogonal."""
    parts = z.reshape(frames, 2, 4)
    lengths = np.linalg.norm(parts[:, 0], axis=1)[:, None]
    q, dual = parts[:, 0] / lengths, parts[:, 1] / lengths
    t: Array = 2.0 * np.einsum("nij,ni->nj", right(q), dual)[:, :3]  # t p = 2 p'
    return q, t


def vector_of(q: Array, t: Array) -> Array:
    """z (8 n,) of unit quaternions and translations."""
    z: Array = np.stack([q, dual_parts(q, t)], axis=1).ravel()
    return z


def polished(Q: Array, q: Array, t: Array) -> tuple[Array, Array, float]:
    """Go down from p (n, 4), t (n, 3) on the manifold, by Newton's method with damping: p, t, z'Qz."""
    n = len(q)
    z = vector_of(q, t)
    gradient_z = Q @ z
    cost, damping = float(z @ gradient_z), 0.0
    floor = 1e-12 * float(np.trace(Q))
    for _ in range(100):
        basis = _tangents(q, t)
        H = basis.T @ Q @ basis + _curvature(q, t, gradient_z)
        g = basis.T @ gradient_z
        while True:
            values = np.linalg.eigvalsh(H)
            shift = max(damping, 0.0 if values[0] > floor else floor - values[0])
            step = -np.linalg.solve(H + shift * np.eye(6 * n), g)
            q_new, t_new = _moved(q, t, step)
            z = vector_of(q_new, t_new)
            cost_new = float(z @ (Q @ z))
            if cost_new <= cost + 1e-15 * abs(cost) or damping > 1e6 * floor * 1e12:
                break
            damping = max(4.0 * damping, 1e-9 * float(np.trace(Q)))
        if cost_new > cost:
            break
        decrease, cost = cost - cost_new, cost_new
        q, t, damping = q_new, t_new, damping / 8.0
        gradient_z = Q @ z
        if decrease <= 1e-15 * cost and float(np.abs(step).max()) < 1e-9:
            break
    return q, t, cost


def _tangents(q: Array, t: Array) -> Array:
    """dz (8 n, 6 n) of steps [w, v] a frame: p (w / 2, 1), t + v."""
    n = len(q)
    turned = 0.5 * left(q)[:, :, :3]  # (n, 4, 3)
    basis = np.zeros((n, 8, n, 6))
    at = np.arange(n)
    basis[at, :4, at, :3] = turned
    basis[at, 4:, at, :3] = 0.5 * left(of_vectors(t)) @ turned
    basis[at, 4:, at, 3:] = 0.5 * right(q)[:, :, :3]
    return basis.reshape(8 * n, 6 * n)


def _curvature(q: Array, t: Array, gradient_z: Array) -> Array:
    """<Qz, second derivatives of z> (6 n, 6 n): along the geodesic, p turns back by |w|^2 / 4."""
    n = len(q)
    g = gradient_z.reshape(n, 2, 4)
    z = vector_of(q, t).reshape(n, 2, 4)
    result = np.zeros((n, 6, n, 6))
    at = np.arange(n)
    back = -0.25 * np.einsum("nij,nij->n", g, z)
    result[at, :3, at, :3] = back[:, None, None] * np.eye(3)
    # p' = t p / 2: v (p w / 2) / 2, from the right: R(p w / 2) v / 2
    turned = 0.5 * left(q)[:, :, :3]  # columns p e_k / 2
    mixed = 0.5 * np.einsum("ni,lij,njk->nkl", g[:, 1], LEFT[:3], turned)  # [w_k, v_l] = <g', e_l (p e_k / 2)> / 2
    result[at, :3, at, 3:] = mixed
    result[at, 3:, at, :3] = mixed.transpose(0, 2, 1)
    return result.reshape(6 * n, 6 * n)


def _moved(q: Array, t: Array, step: Array) -> tuple[Array, Array]:
    steps = step.reshape(-1, 6)
    turn = np.concatenate([0.5 * steps[:, :3], np.ones((len(q), 1))], axis=1)
    moved = np.einsum("nij,nj->ni", left(q), turn)
    return moved / np.linalg.norm(moved, axis=1)[:, None], t + steps[:, 3:]


def multipliers_of(Q: Array, q: Array, t: Array) -> tuple[float, float]:
    """sum lambda_i at a critical point, and the smallest eigenvalue of Z: where that is not negative, a bound.

    From Q z = blkdiag z: lambda_i p + mu_i p' = (Qz)_p and mu_i p = (Qz)_p'.
    """
    n = len(q)
    z = vector_of(q, t)
    g = (Q @ z).reshape(n, 2, 4)
    dual = z.reshape(n, 2, 4)[:, 1]
    mu = np.einsum("ni,ni->n", g[:, 1], q)
    lam = np.einsum("ni,ni->n", g[:, 0] - mu[:, None] * dual, q)
    Z = Q.copy().reshape(n, 2, 4, n, 2, 4)
    for i in range(n):
        Z[i, 0, :, i, 0, :] -= lam[i] * np.eye(4)
        Z[i, 0, :, i, 1, :] -= mu[i] * np.eye(4)
        Z[i, 1, :, i, 0, :] -= mu[i] * np.eye(4)
    return float(lam.sum()), float(np.linalg.eigvalsh(Z.reshape(8 * n, 8 * n))[0])
