"""The semidefinite relaxation of Problem 6 with all 21 constraints a rotation (eqs. 19, 50, 70-73).

Clarabel solves it where its cone fits, the block method of ``interior_point`` elsewhere. Clarabel also takes the
variant with alpha >= 0 (Section 4.3): h alpha is quadratic in x, so alpha >= 0 is one more linear inequality on X.
"""

from __future__ import annotations

from collections.abc import Callable

import clarabel
import numpy as np
import scipy.sparse

from gtsam_rwhec.certify.interior_point import Relaxation, solve_by_blocks
from gtsam_rwhec.certify.local_blocks import local_indices
from gtsam_rwhec.certify.rotations import CONSTRAINTS, project, unvec
from gtsam_rwhec.poses import Array

#: Clarabel holds a dense block of order N (N + 1) / 2 for an N x N cone: up to this N it fits and is quick.
CLARABEL_SIZE = 46


def solve_relaxation(
    Q: Array,
    tolerance: float,
    max_iterations: int,
    scale_row: Array | None = None,
    progress: Callable[[str], None] | None = None,
) -> Relaxation:
    """Solve the relaxation of Q' (9 n + 1 square).

    Parameters
    ----------
    Q : (9 n + 1, 9 n + 1) array
    tolerance : float
        Relative gap at which to stop.
    max_iterations : int
    scale_row : (9 n,) array, optional
        alpha = scale_row . r; given, alpha >= 0 is a constraint.
    progress : callable, optional
        Told what it does.
    """
    if len(Q) <= CLARABEL_SIZE or scale_row is not None:
        return solve_by_clarabel(Q, tolerance, max_iterations, scale_row)
    return solve_by_blocks(Q, tolerance, max_iterations, progress)


def solve_by_clarabel(Q: Array, tolerance: float, max_iterations: int, scale_row: Array | None = None) -> Relaxation:
    """The dual, max gamma s.t. Z(lambda) >= 0, as Clarabel's problem; its cone's dual variable is X."""
    size = len(Q)
    n = (size - 1) // 9
    scale = float(np.abs(Q).max()) or 1.0
    columns = _constraint_columns(n, size)
    blocks = [columns]
    upper_j, upper_i = np.tril_indices(size)  # Clarabel stacks the upper triangle, column after column
    root = np.where(upper_i == upper_j, 1.0, np.sqrt(2.0))
    if scale_row is not None:
        B = np.zeros((size, size))
        B[:-1, -1] = B[-1, :-1] = 0.5 * scale_row / max(np.abs(scale_row).max(), 1e-300)
        blocks.append(scipy.sparse.csc_matrix((B[upper_i, upper_j] * root)[:, None]))
    A = scipy.sparse.hstack(blocks, format="csc")
    b = (Q / scale)[upper_i, upper_j] * root
    cones = [clarabel.PSDTriangleConeT(size)]
    if scale_row is not None:  # nu >= 0
        A = scipy.sparse.vstack([A, scipy.sparse.csc_matrix(([-1.0], ([0], [A.shape[1] - 1])), (1, A.shape[1]))], "csc")
        b = np.r_[b, 0.0]
        cones.append(clarabel.NonnegativeConeT(1))
    q = np.zeros(A.shape[1])
    q[20 * n] = -1.0
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_iter = max_iterations
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    zero = scipy.sparse.csc_matrix((A.shape[1], A.shape[1]))
    solution = clarabel.DefaultSolver(zero, q, A, b, cones, settings).solve()
    y, z = np.array(solution.x), np.array(solution.z)[: len(upper_i)]
    X = np.zeros((size, size))
    X[upper_i, upper_j] = z / root
    X = X + X.T - np.diag(np.diagonal(X))
    nu = 0.0
    if scale_row is not None:
        nu = scale * float(y[-1]) / max(float(np.abs(scale_row).max()), 1e-300)
    return Relaxation(
        X,
        scale * y[: 20 * n].reshape(n, 20),
        nu,
        float(np.vdot(Q, X)),
        scale * float(y[20 * n]),
        int(solution.iterations),
        "Clarabel",
    )


def _constraint_columns(n: int, size: int) -> scipy.sparse.csc_matrix:
    """svec of each constraint's matrix as a column: 20 a rotation, then e_h e_h'."""
    index = local_indices(n)
    k, p, q = np.nonzero(CONSTRAINTS)
    values = CONSTRAINTS[k, p, q]
    upper = p <= q  # h is the last of the ten and of the whole
    k, p, q, values = k[upper], p[upper], q[upper], values[upper]
    rows = index[:, q] * (index[:, q] + 1) // 2 + index[:, p]
    cols = 20 * np.arange(n)[:, None] + k
    data = np.broadcast_to(np.where(p == q, values, np.sqrt(2.0) * values), rows.shape)
    last = size * (size + 1) // 2
    return scipy.sparse.csc_matrix(
        (np.r_[data.ravel(), 1.0], (np.r_[rows.ravel(), last - 1], np.r_[cols.ravel(), 20 * n])), (last, 20 * n + 1)
    )


def round_to_rotations(relaxation: Relaxation) -> list[Array]:
    """Rotations (n, 3, 3) from X: its h column, which is x itself where X has rank one, and its leading eigenvector."""
    X = relaxation.X
    starts = [project(unvec(X[:-1, -1] / X[-1, -1]))]
    leading = np.linalg.eigh(X)[1][:, -1]
    starts.append(project(unvec(leading[:-1] * np.sign(leading[-1]))))
    return starts
