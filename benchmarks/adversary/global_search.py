"""Minima of a stated cost from many starts at once, in doubles: rotations by Newton, all that is linear eliminated.

It has its own algebra: a QR factorisation of the stacked residuals, no moments. Its answers are starts for
``pair_descent``, which has the digits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from stated_cost import Poses, StatedCost

Array = np.ndarray
#: Directions of translations and scales that are weaker than this, relatively, stay where the answer has them.
WEAK = 1e-12
#: Generators of rotations, by axis.
TURN = np.zeros((3, 3, 3))
for _a, _b, _c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    TURN[_a, _c, _b], TURN[_a, _b, _c] = 1.0, -1.0


@dataclass(frozen=True)
class Columns:
    """Where a stated cost's unknowns are in z."""

    rotations: Array  #: (F, 9)
    shifts: Array  #: (F, 3)
    scales: Array  #: (s,)

    @staticmethod
    def of(cost: StatedCost) -> Columns:
        free = np.array(cost.rows.free, dtype=int)
        owners = list(cost.rows.owners)
        scales = [cost.scale_at[owners.index(name)] for name in cost.rows.free_scales]
        return Columns(
            12 * free[:, None] + np.arange(9), 12 * free[:, None] + 9 + np.arange(3), np.array(scales, dtype=int)
        )

    @property
    def linear(self) -> Array:
        return np.concatenate([self.shifts.ravel(), self.scales])


def weighted_matrix(cost: StatedCost, dtype: type) -> Array:
    """Residuals over z, times roots of the weights; priors of translations are last."""
    m, size = len(cost.coefficients), cost.size
    M = np.zeros((m, size), dtype=dtype)
    at = np.arange(m)[:, None]
    np.add.at(M, (np.broadcast_to(at, cost.index.shape), cost.index), cost.coefficients.astype(dtype))
    M *= np.sqrt(cost.weight.hi.astype(dtype))[:, None]
    blocks = [M]
    for name, T, sigma, _ in cost.rows.priors:
        if sigma is not None:
            f = cost.rows.frames.index(name)
            block = np.zeros((3, size), dtype=dtype)
            block[range(3), range(12 * f + 9, 12 * f + 12)] = 1.0
            apart = cost.origins[f].astype(dtype) - T[:3, 3]
            if cost.is_inverse:  # R'(t - t_0)
                for i in range(3):
                    block[i, 12 * f + 3 * np.arange(3) + i] = apart
            else:
                block[:, cost.one] += apart
            blocks.append(block / dtype(sigma))
    return np.concatenate(blocks)


def minima(cost: StatedCost, M: Array, returned: Poses, starts: int, rng: np.random.Generator) -> list[Poses]:
    """Local minima, the best first, as poses with positive scales, each once."""
    columns = Columns.of(cost)
    z = cost.z_of(returned)[0].hi[0]
    constant = np.ones(cost.size, dtype=bool)
    constant[columns.linear] = constant[columns.rotations.ravel()] = False
    fixed = M[:, constant] @ z[constant]
    linear = M[:, columns.linear]
    scaling = np.linalg.norm(linear, axis=0)
    scaling[scaling == 0.0] = 1.0
    stacked = np.concatenate([linear / scaling, M[:, columns.rotations.ravel()], fixed[:, None]], axis=1)
    upper = np.linalg.qr(stacked, mode="r")
    k = len(columns.linear)
    U, s, Vt = np.linalg.svd(upper[:k, :k])
    strong = s > WEAK * s.max(initial=0.0)
    kept = U.T @ upper[:k, k:]
    here = z[columns.linear] * scaling
    # Weak directions stay at the returned answer's numbers.
    held = (s * (Vt @ here))[~strong, None]
    L = np.concatenate([kept[~strong], upper[k:, k:]])
    L[: len(held), -1] += held[:, 0]
    R, value = _descend(L, _starts(returned, cost.rows.free, starts, rng))
    order = np.argsort(value)
    found: list[Poses] = []
    seen: list[Array] = []
    for index in order[:12]:
        if any(np.abs(R[index] - other).max(initial=0.0) < 1e-4 for other in seen):
            continue
        seen.append(R[index])
        x = np.concatenate([R[index].ravel(), [1.0]])
        u = -(kept[strong] @ x) / s[strong]
        answer = Vt[strong].T @ u + Vt[~strong].T @ (Vt[~strong] @ here)
        poses = _poses(cost, columns, R[index], answer / scaling, returned)
        if poses is not None:
            found.append(poses)
        if len(found) == 4:
            break
    return found


def _starts(returned: Poses, free: list[int], count: int, rng: np.random.Generator) -> Array:
    """The returned rotations, their mirror images through half turns, and random ones, (K, F, 3, 3)."""
    here = returned.R[free]
    q = rng.standard_normal((count, len(free), 4))
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    w, x, y, z = np.moveaxis(q, -1, 0)
    random = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )
    half_turns = np.array([np.diag(d) for d in ((1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0))])
    mirrored = [here @ h for h in half_turns] + [h @ here for h in half_turns]
    return np.concatenate([here[None], np.array(mirrored), random])


def _descend(L: Array, R: Array, steps: int = 25) -> tuple[Array, Array]:
    """Damped Newton steps of all starts R (K, F, 3, 3) for |L [R; 1]|^2 / 2."""
    K, n = R.shape[:2]
    if n == 0:
        return R, np.full(K, 0.5 * (L[:, -1] ** 2).sum())
    damping = np.full(K, 1e-3)
    residual = R.reshape(K, -1) @ L[:, :-1].T + L[:, -1]
    value = 0.5 * (residual**2).sum(axis=1)
    blocks = L[:, :-1].reshape(len(L), n, 9)
    diagonal = np.arange(3 * n)
    alive = np.arange(K)
    for _ in range(steps):
        at = R[alive]
        A = len(alive)
        tangents = tangents_of(at).reshape(A, n, 9, 3)
        J = np.concatenate([blocks[:, f] @ tangents[:, f] for f in range(n)], axis=2)
        gradient = (J.transpose(0, 2, 1) @ residual[alive, :, None])[..., 0]
        H = J.transpose(0, 2, 1) @ J
        bend = bending(at, (residual[alive] @ L[:, :-1]).reshape(A, n, 3, 3))
        size = H[:, diagonal, diagonal].max(axis=1) + 1e-300
        for f in range(n):
            H[:, 3 * f : 3 * f + 3, 3 * f : 3 * f + 3] += bend[:, f]
        H[:, diagonal, diagonal] += (damping[alive] * size)[:, None]
        try:
            step = -np.linalg.solve(H, gradient[..., None])[..., 0].reshape(A, n, 3)
        except np.linalg.LinAlgError:  # nothing moves the cost
            step = -(np.linalg.pinv(H, hermitian=True) @ gradient[..., None])[..., 0].reshape(A, n, 3)
        length = np.linalg.norm(step, axis=(1, 2))
        step *= np.minimum(1.0, 2.0 / np.maximum(length, 1e-300))[:, None, None]
        tried = at @ _exponential(step)
        r = tried.reshape(A, -1) @ L[:, :-1].T + L[:, -1]
        v = 0.5 * (r**2).sum(axis=1)
        better = v < value[alive]
        won = alive[better]
        R[won], residual[won], value[won] = tried[better], r[better], v[better]
        damping[alive] = np.where(better, damping[alive] * 0.1, np.maximum(damping[alive], 1e-9) * 8.0)
        alive = alive[(damping[alive] < 1e6) & (length > 1e-9)]
        if not len(alive):
            break
    return R, value


def tangents_of(R: Array) -> Array:
    """Derivatives (..., 3, 3, 3) of R Expmap(omega) by omega, last, for R (..., 3, 3)."""
    result = np.zeros((*R.shape, 3), dtype=R.dtype)
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        result[..., b, a], result[..., c, a] = R[..., c], -R[..., b]
    return result


def bending(R: Array, G: Array) -> Array:
    """What the curvature of rotations adds to a Hessian (..., 3, 3), for gradients G over the entries of R."""
    N = np.swapaxes(R, -1, -2) @ G
    return 0.5 * (N + np.swapaxes(N, -1, -2)) - np.trace(N, axis1=-2, axis2=-1)[..., None, None] * np.eye(3)


def _exponential(w: Array) -> Array:
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    K = (w @ TURN.reshape(3, 9)).reshape(*w.shape[:-1], 3, 3)
    return np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * (K @ K)


def _poses(cost: StatedCost, columns: Columns, R: Array, linear: Array, returned: Poses) -> Poses | None:
    """The answer of rotations and linear unknowns; None where a scale is not positive."""
    rows = cost.rows
    all_R, all_t = returned.R.copy(), returned.t.copy()
    alpha = dict(returned.alpha)
    shifts, scales = linear[: columns.shifts.size].reshape(-1, 3), linear[columns.shifts.size :]
    if not (scales > 0.0).all() or not np.isfinite(linear).all():
        return None
    for name, value in zip(rows.free_scales, scales.tolist(), strict=True):
        value = 1.0 / value if cost.is_inverse else value
        for owner in rows.owners if rows.shares_scale else (name,):
            alpha[owner] = value
    for index, matrix, shift in zip(rows.free, R, shifts, strict=True):
        all_R[index] = matrix
        moved = matrix @ shift if cost.is_inverse else shift / (alpha[rows.owners[0]] if rows.shares_scale else 1.0)
        all_t[index] = cost.origins[index] + moved
    if not all(np.isfinite(value) and value > 0.0 for value in alpha.values()):
        return None
    return Poses(all_R, all_t, alpha)
