"""Clarabel's conic problems: the triangle in which Clarabel stacks a symmetric matrix, and the call that solves."""

from __future__ import annotations

from typing import Any

import clarabel
import numpy as np
import scipy.sparse

from gtsam_rwhec.geometry.poses import Array


def triangle(size: int) -> tuple[np.ndarray, np.ndarray, Array]:
    """Rows, columns and weights of the upper triangle, column after column; off the diagonal the weight is sqrt 2."""
    j, i = np.tril_indices(size)
    return i, j, np.where(i == j, 1.0, np.sqrt(2.0))


def stacked(M: Array) -> Array:
    """The stacked entries (size (size + 1) / 2,) of a symmetric matrix; the inverse of ``unstacked``."""
    i, j, weight = triangle(len(M))
    entries: Array = M[i, j] * weight
    return entries


def unstacked(entries: Array, size: int) -> Array:
    """The symmetric matrix (size, size) of stacked entries; entries after them are not read."""
    i, j, weight = triangle(size)
    M = np.zeros((size, size))
    M[i, j] = M[j, i] = entries[: len(i)] / weight
    return M


def solve_conic(
    cost: Array, A: scipy.sparse.csc_matrix, b: Array, cones: list[Any], tolerance: float, max_iterations: int
) -> tuple[Array, Array, int]:
    """Minimise cost'x subject to b - A x in the cones: x, the multipliers z, and the number of iterations."""
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_iter = max_iterations
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    quadratic = scipy.sparse.csc_matrix((len(cost), len(cost)))
    solution = clarabel.DefaultSolver(quadratic, cost, A, b, cones, settings).solve()
    return np.array(solution.x), np.array(solution.z), int(solution.iterations)
