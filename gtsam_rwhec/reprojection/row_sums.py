"""Rows of all images of a pair, summed: squares, products with other columns, and few rows that have the same sums.

A corner's place moves its own two residuals alone. So the 3n columns of n free corners are never made: their blocks
B (V, n, 2, 3) are summed by corner. Columns are in the order [J, corners, r]: of the other unknowns, of all corners,
and the residual.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of V images with n corners: J (V, 2n, m), B (V, n, 2, 3) where corners are free, r (V, 2n)."""

    J: Array
    B: Array | None
    r: Array

    def squares(self) -> Array:
        """The sum over all images of [J, corners, r]' [J, corners, r]."""
        others = np.concatenate([self.J, self.r[..., None]], axis=2)
        flat = others.reshape(-1, others.shape[2])
        if self.B is None:
            return np.asarray(flat.T @ flat)
        n, m = self.B.shape[1], self.J.shape[2]
        Bt = _by_corner(self.B, n).transpose(0, 2, 1)
        own = np.zeros((n, 3, n, 3))
        own[np.arange(n), :, np.arange(n)] = Bt @ _by_corner(self.B, n)
        mixed = (Bt @ _by_corner(others, n)).reshape(3 * n, m + 1)
        both, of_others = mixed[:, :m], flat.T @ flat
        return np.block([
            [of_others[:m, :m], both.T, of_others[:m, m:]],
            [both, own.reshape(3 * n, 3 * n), mixed[:, m:]],
            [of_others[m:, :m], mixed[:, m:].T, of_others[m:, m:]],
        ])  # fmt: skip

    def times(self, Q: Array) -> Array:
        """Q' [J, corners, r] of each image (V, q, columns), with Q (V, 2n, q)."""
        Qt = Q.transpose(0, 2, 1)
        parts = [Qt @ self.J, Qt @ self.r[..., None]]
        if self.B is not None:
            V, n = self.B.shape[:2]
            of_corner = Q.reshape(V, n, 2, -1).transpose(0, 1, 3, 2) @ self.B  # (V, n, q, 3)
            parts.insert(1, of_corner.transpose(0, 2, 1, 3).reshape(V, -1, 3 * n))
        return np.concatenate(parts, axis=2)


def few_rows(rows: Rows, J_A: Array | None) -> tuple[Array, Array, Array]:
    """Rows with the same squares and products as those of all images, A's columns J_A (V, 2n, 6) among them.

    With J_A = Q R of each image, Q'[J_A, J, corners, r] are all rows in which A is. What the other rows add to the sums
    has no A: one triangle for all images together. Returned are Q'[J, corners, r] (V, 6, columns), R (V, 6, 6), both
    with V = 0 where A is none of the unknowns, and the triangle (columns, columns).
    """
    total = rows.squares()
    columns = len(total)
    Q, R = (np.zeros((0, 6, columns)), np.zeros((0, 6, 6))) if J_A is None else np.linalg.qr(J_A)
    of_A = rows.times(Q) if J_A is not None else Q
    flat = of_A.reshape(-1, columns)
    # a column of zeros stays one
    size = np.sqrt(np.maximum(np.diagonal(total), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh((total - flat.T @ flat) / size[:, None] / size)
    together: Array = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T * size
    return of_A, R, together


def _by_corner(rows: Array, n: int) -> Array:
    """Rows (V, 2n, columns), or (V, n, 2, columns), as (n, 2V, columns)."""
    V = len(rows)
    result: Array = rows.reshape(V, n, 2, -1).transpose(1, 0, 2, 3).reshape(n, 2 * V, -1)
    return result
