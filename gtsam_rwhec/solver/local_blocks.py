"""Algebra of the constraints' matrices, as blocks of ten rows and columns, for all n rotations at once.

The matrix of a constraint is zero outside the ten rows and columns [vec R_i, h] of its rotation (design fact 6). A
family of them is an array (n, c, 10, 10), c matrices for each rotation. The Gram matrices tr(A W B V) of interior-point
methods then need 10 x 10 blocks of W and V only: O(n^2) small products instead of O(n^2 c^2) large products.
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array


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
