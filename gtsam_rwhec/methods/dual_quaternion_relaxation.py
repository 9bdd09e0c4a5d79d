"""The smallest z'Qz over unit dual quaternions, by Shor's relaxation, rounding, descent on a chart and multipliers.

z = [p_1, p_1', p_2, p_2', ...], |p_i| = 1, <p_i, p_i'> = 0. The relaxation's dual is max sum lambda_i subject to
Z = Q - blkdiag([[lambda_i I, mu_i I], [mu_i I, 0]]) >= 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import clarabel
import numpy as np
import scipy.sparse
from scipy.linalg import block_diag

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import dual_parts, left, of_vectors, right
from gtsam_rwhec.methods.levenberg_marquardt import descend_on_chart
from gtsam_rwhec.solver.relaxation import solve_conic, stacked, unstacked

#: The relaxation is solved for at most this many frames. A cone of 8 n takes a dense block of order 4 n (8 n + 1)
#: squared.
MOST_FRAMES = 10
#: The interior-point solver stops at this relative gap and infeasibility.
TOLERANCE = 1e-10
#: The interior-point solver and the descent stop after these numbers of steps in any case.
STEPS, DESCENT_STEPS = 200, 1000


@dataclass(frozen=True)
class Relaxed:
    """The relaxation's answer: the nearest p (n, 4) and t (n, 3), metres, and the solver's lower bound."""

    q: Array
    t: Array
    lower_bound: float


def relaxed(Q: Array, frames: int) -> Relaxed:
    """Solve the relaxation of Q (8 n, 8 n) and round its answer.

    Beyond ``MOST_FRAMES`` the smallest eigenvector replaces the answer, and the lower bound is 0.
    """
    if frames > MOST_FRAMES:
        return Relaxed(*rounded(_smallest_eigenvector(Q), frames), 0.0)
    size = 8 * frames
    scale = float(np.abs(Q).max()) or 1.0
    frame, entry = np.repeat(np.arange(frames), 4), np.tile(np.arange(4), frames)
    primal, dual = 8 * frame + entry, 8 * frame + entry + 4
    rows = np.concatenate([primal * (primal + 1) // 2 + primal, dual * (dual + 1) // 2 + primal])
    columns = np.concatenate([2 * frame, 2 * frame + 1])
    values = np.concatenate([np.ones(4 * frames), np.full(4 * frames, np.sqrt(2.0))])
    A = scipy.sparse.csc_matrix((values, (rows, columns)), (size * (size + 1) // 2, 2 * frames))
    cost, cones = np.tile([-1.0, 0.0], frames), [clarabel.PSDTriangleConeT(size)]
    multipliers, z, _ = solve_conic(cost, A, stacked(Q / scale), cones, TOLERANCE, STEPS)
    q, t = rounded(np.linalg.eigh(unstacked(z, size))[1][:, -1], frames)
    return Relaxed(q, t, scale * float(multipliers[::2].sum()))


def _smallest_eigenvector(Q: Array) -> Array:
    """The smallest eigenvector of Q without its dual parts, which have no length of their own, then the dual parts."""
    blocks = Q.reshape(-1, 2, 4, len(Q) // 8, 2, 4)
    half = len(Q) // 2
    pp, pd, dd = (blocks[:, a, :, :, b, :].reshape(half, half) for a, b in ((0, 0), (0, 1), (1, 1)))
    to_dual = -np.linalg.lstsq(dd, pd.T, rcond=1e-12)[0]
    p = np.linalg.eigh(pp + pd @ to_dual)[1][:, 0]
    return np.stack([p.reshape(-1, 4), (to_dual @ p).reshape(-1, 4)], axis=1).ravel()


def rounded(z: Array, frames: int) -> tuple[Array, Array]:
    """The unit p (n, 4) and t (n, 3) nearest to z: frames are divided by their lengths, dual parts made orthogonal."""
    parts = z.reshape(frames, 2, 4)
    lengths = np.linalg.norm(parts[:, 0], axis=1)[:, None]
    q, dual = parts[:, 0] / lengths, parts[:, 1] / lengths
    t: Array = 2.0 * np.einsum("nij,ni->nj", right(q), dual)[:, :3]  # t p = 2 p'
    return q, t


def vector_of(q: Array, t: Array) -> Array:
    """z (8 n,) of unit quaternions and translations."""
    return np.stack([q, dual_parts(q, t)], axis=1).ravel()


def polished(Q: Array, q: Array, t: Array) -> tuple[Array, Array, float]:
    """The local minimum of z'Qz near p (n, 4) and t (n, 3): p, t and the cost."""
    start = np.concatenate([q, t], axis=1).ravel()
    found = descend_on_chart(Q, pose_chart, start, DESCENT_STEPS).reshape(-1, 7)
    q, t = found[:, :4] / np.linalg.norm(found[:, :4], axis=1, keepdims=True), found[:, 4:]
    z = vector_of(q, t)
    return q, t, float(z @ Q @ z)


def pose_chart(p: Array) -> tuple[Array, Array]:
    """z (8 n,) of 7 numbers a frame, a quaternion of any length and t in metres, and its derivatives (8 n, 7 n)."""
    frames = p.reshape(-1, 7)
    length = np.linalg.norm(frames[:, :4], axis=1, keepdims=True)
    q, t = frames[:, :4] / length, frames[:, 4:]
    by_quaternion = (np.eye(4) - q[:, :, None] * q[:, None, :]) / length[:, :, None]
    n, at = len(frames), np.arange(len(frames))
    derivatives = np.zeros((n, 8, n, 7))
    derivatives[at, :4, at, :4] = by_quaternion
    derivatives[at, 4:, at, :4] = 0.5 * left(of_vectors(t)) @ by_quaternion  # p' = t p / 2
    derivatives[at, 4:, at, 4:] = 0.5 * right(q)[:, :, :3]
    return vector_of(q, t), derivatives.reshape(8 * n, 7 * n)


def multipliers_of(Q: Array, q: Array, t: Array) -> tuple[float, float]:
    """The sum of lambda_i at a critical point, and Z's smallest eigenvalue; the sum is a bound where Z >= 0.

    From Q z = blkdiag z: lambda_i p + mu_i p' = (Qz)_p and mu_i p = (Qz)_p'.
    """
    n = len(q)
    z = vector_of(q, t)
    g = (Q @ z).reshape(n, 2, 4)
    dual = z.reshape(n, 2, 4)[:, 1]
    mu = np.einsum("ni,ni->n", g[:, 1], q)
    lam = np.einsum("ni,ni->n", g[:, 0] - mu[:, None] * dual, q)
    blocks = [np.kron([[own, mixed], [mixed, 0.0]], np.eye(4)) for own, mixed in zip(lam, mu, strict=True)]
    return float(lam.sum()), float(np.linalg.eigvalsh(Q - block_diag(*blocks))[0])
