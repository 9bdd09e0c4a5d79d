"""The rotations along which a Lagrangian curves down most: an estimate, for a better start."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver import arrow
from gtsam_rwhec.solver.descent import SearchForm
from gtsam_rwhec.solver.graph_form import GraphForm
from gtsam_rwhec.solver.graph_start import graph_smallest_eigenpair
from gtsam_rwhec.solver.rotations import CONSTRAINTS_FLAT

#: Above this size Lanczos finds the eigenvalue; below it, a dense decomposition does.
DENSE_EIGEN_SIZE = 700


def smallest_eigenpair(form: SearchForm, multipliers: Array) -> tuple[float, Array]:
    """The smallest eigenvalue of Q' - Lambda without h, and its vector (9 n,)."""
    L, n = form.leaves, form.rotations
    if n == 0:  # every frame is fixed
        return 0.0, np.zeros(0)
    Lambda = (multipliers @ CONSTRAINTS_FLAT).reshape(n, 10, 10)[:, :9, :9]
    if isinstance(form, GraphForm):
        return graph_smallest_eigenpair(form, Lambda)
    D, C, E, G = form.D - Lambda[:L], form.C[:, :, :-1], form.E[:-1, :-1].copy(), form.G[:, :-1]
    for p in range(n - L):
        block = slice(9 * p, 9 * p + 9)
        E[block, block] -= Lambda[L + p]
    if 9 * n <= DENSE_EIGEN_SIZE:
        matrix = arrow.dense(D, C, E) - G.T @ G
        values, vectors = scipy.linalg.eigh(matrix, subset_by_index=[0, 0], check_finite=False)
        return float(values[0]), vectors[:, 0]
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh  # slow to import, few problems need it

    split = 9 * L
    wide = arrow.flat(C)

    def apply(v: Array) -> Array:
        v = v.ravel()
        leaf = np.matmul(D, v[:split].reshape(-1, 9, 1)).ravel() + wide @ v[split:]
        result: Array = np.r_[leaf, wide.T @ v[:split] + E @ v[split:]] - G.T @ (G @ v)
        return result

    operator = LinearOperator((9 * n, 9 * n), matvec=apply, dtype=np.float64)
    start = np.random.default_rng(0).standard_normal(9 * n)
    try:
        values, vectors = eigsh(operator, k=1, which="SA", v0=start, tol=1e-6, maxiter=2000)
        return float(values[0]), vectors[:, 0]
    except ArpackNoConvergence as stopped:
        if len(stopped.eigenvalues):
            return float(stopped.eigenvalues[0]), np.real(stopped.eigenvectors[:, 0])
        return -form.magnitude, start / np.linalg.norm(start)
