"""SO(3) for certificates: 21 quadratic constraints for each rotation, tangents, projection, retraction.

A stack of rotations is (n, 3, 3); in x = [vec R_1, ..., vec R_n, 1], vec R has the columns of R one after the other.
A constraint is about the ten numbers [vec R, h], with h the homogenising entry.
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.rounding import Doubled, product


def _constraints() -> Array:
    """The 21 homogeneous constraints of eq. 50, y' A y = 0, with integer entries."""
    entry = np.arange(9).reshape(3, 3).T  # entry[i, j]: where R[i, j] is in vec R
    matrices = []

    def add(*terms: tuple[int, int, int]) -> None:
        """Append the matrix A of y' A y = sum of value * (2 if p != q else 1) * y_p y_q."""
        A = np.zeros((10, 10))
        for p, q, value in terms:
            A[p, q] += value
            if p != q:
                A[q, p] += value
        matrices.append(A)

    h = 9
    pairs = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
    for a, b in pairs:  # eq. 50b: R'R = h^2 I (columns)
        add(*[(entry[i, a], entry[i, b], 1) for i in range(3)], *([(h, h, -1)] if a == b else []))
    rows = [(0, 1), (0, 2), (1, 2), (0, 0), (1, 1)]
    # R'R and R R' have the same trace: one diagonal entry of R R' depends on the others and comes last.
    for a, b in rows:  # eq. 50a: R R' = h^2 I (rows)
        add(*[(entry[a, j], entry[b, j], 1) for j in range(3)], *([(h, h, -1)] if a == b else []))
    for a, b, c in [(0, 1, 2), (1, 2, 0), (2, 0, 1)]:  # eq. 50c: R_a x R_b = h R_c
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            add((entry[j, a], entry[k, b], 1), (entry[k, a], entry[j, b], -1), (entry[i, c], h, -1))
    add(*[(entry[2, j], entry[2, j], 1) for j in range(3)], (h, h, -1))
    return np.array(matrices)


#: All 21 constraints (21, 10, 10); the first 6 are R'R = I, the last depends on the others.
ALL_CONSTRAINTS = _constraints()
#: The 20 independent constraints.
CONSTRAINTS = ALL_CONSTRAINTS[:20]
#: The same as rows (20, 100).
CONSTRAINTS_FLAT = CONSTRAINTS.reshape(20, 100)


def _terms() -> tuple[np.ndarray, np.ndarray, Array]:
    """For each constraint the entries p, q (20, 4) of its products and their factors, zero where there are fewer."""
    p, q, factor = np.zeros((20, 4), dtype=int), np.zeros((20, 4), dtype=int), np.zeros((20, 4))
    for k, A in enumerate(CONSTRAINTS):
        for i, (row, column) in enumerate(zip(*np.nonzero(np.triu(A)), strict=True)):
            p[k, i], q[k, i] = row, column
            factor[k, i] = A[row, column] * (1 if row == column else 2)
    return p, q, factor


_TERMS = _terms()
#: The constraints with a diagonal entry of R'R or R R', whose constant part is -h^2.
WITH_CONSTANT = CONSTRAINTS[:, 9, 9] != 0.0


def constraint_values(R: Array) -> Array:
    """y'A y of the 20 constraints at stored rotations (n, 20): rounding errors of R, right to their last digit."""
    y = np.concatenate([vec(R), np.ones((len(R), 1))], axis=1)
    p, q, factor = _TERMS
    exact = product(y[:, p], y[:, q])
    return Doubled(exact.hi * factor, exact.lo * factor).summed(axis=2).value


#: e_k^, the cross product with each axis (3, 3, 3): the opposite of the Levi-Civita symbol.
HATS = -np.cross(np.eye(3)[:, None], np.eye(3)[None])


def vec(R: Array) -> Array:
    """(n, 3, 3) to (n, 9), column after column."""
    return R.transpose(0, 2, 1).reshape(-1, 9)


def unvec(r: Array) -> Array:
    """(n, 9) or (9 n,) to (n, 3, 3)."""
    return r.reshape(-1, 3, 3).transpose(0, 2, 1)


def tangent_basis(R: Array) -> Array:
    """(n, 9, 3): vec(R w^) = basis w, for right perturbations R exp(w^)."""
    basis: Array = np.einsum("nij,kjb->nbik", R, HATS)  # column b of R e_k^
    return basis.reshape(-1, 9, 3)


def tangent_curvature(R: Array, q: Array) -> Array:
    """The second term of the Hessian on SO(3), beside basis' Q' basis, for q = Q' x: sym(M) - tr(M) I with M = G'R."""
    M = unvec(q[:-1]).transpose(0, 2, 1) @ R
    result: Array = 0.5 * (M + M.transpose(0, 2, 1)) - np.einsum("nii->n", M)[:, None, None] * np.eye(3)
    return result


def retract(R: Array, w: Array) -> Array:
    """R exp(w^); one Newton-Schulz step brings it back to SO(3), so that rounding does not add up."""
    half = np.maximum(0.5 * np.sqrt((w * w).sum(axis=1)), 1e-100)[:, None, None]
    W = np.einsum("nk,kij->nij", w, HATS)
    first, second = 0.5 * np.sin(2.0 * half) / half, 0.5 * (np.sin(half) / half) ** 2
    S = R @ (np.eye(3) + first * W + second * (W @ W))
    result: Array = 1.5 * S - 0.5 * S @ (S.transpose(0, 2, 1) @ S)
    return result


def random_rotations(count: int, generator: np.random.Generator) -> Array:
    """(count, 3, 3) rotations, uniform on SO(3)."""
    q = generator.standard_normal((count, 4))
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=-1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=-1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1),
        ],
        axis=1,
    )


def multiplier_blocks(multipliers: Array) -> tuple[Array, Array]:
    """Lambda = sum lambda_k A_k for multipliers (n, 20), over [vec R, h] (n, 10, 10), and the sizes of its terms."""
    n = len(multipliers)
    blocks, sizes = multipliers @ CONSTRAINTS_FLAT, np.abs(multipliers) @ np.abs(CONSTRAINTS_FLAT)
    return blocks.reshape(n, 10, 10), sizes.reshape(n, 10, 10)


def kkt_multipliers(R: Array, gradient: Array) -> Array:
    """(n, 20) multipliers of the constraints at a critical point: S_i = sym(R_i' G_i) on R'R = I (design fact 3).

    gradient is (n, 9), the rotations' part of Q'x.
    """
    S = R.transpose(0, 2, 1) @ unvec(gradient)
    S = 0.5 * (S + S.transpose(0, 2, 1))
    multipliers = np.zeros((len(R), 20))
    multipliers[:, :6] = S[:, [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return multipliers
