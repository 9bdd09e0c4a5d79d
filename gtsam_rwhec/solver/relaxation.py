"""The semidefinite relaxation of Problem 6 with all 21 constraints for each rotation (eqs. 19, 50, 70-73).

Clarabel solves small relaxations, the block method of ``interior_point`` solves large ones. Clarabel also solves the
variant with alpha >= 0 (Section 4.3): alpha becomes a variable, and the entry h alpha of X must be nonnegative.
"""

from __future__ import annotations

import clarabel
import numpy as np
import scipy.sparse

from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.cause import Start
from gtsam_rwhec.solver.conic_solver import solve_conic, stacked, unstacked
from gtsam_rwhec.solver.interior_point import Relaxation, solve_by_blocks
from gtsam_rwhec.solver.local_blocks import local_indices
from gtsam_rwhec.solver.rotations import CONSTRAINTS, project, unvec

#: Clarabel holds a dense block of order N (N + 1) / 2 for an N x N cone: up to this N it is quick.
CLARABEL_SIZE = 46


def solve_relaxation(Q: Array, tolerance: float, max_iterations: int, progress: Progress | None = None) -> Relaxation:
    """Solve the relaxation of Q' (9 n + 1 square) to a relative gap of ``tolerance``."""
    if len(Q) <= CLARABEL_SIZE:
        return solve_by_clarabel(Q, tolerance, max_iterations)
    return solve_by_blocks(Q, tolerance, max_iterations, progress)


def solve_by_clarabel(Q: Array, tolerance: float, max_iterations: int) -> Relaxation:
    """Solve the dual, max gamma s.t. Z(lambda) >= 0, by Clarabel; X is the dual variable of its cone."""
    scale = float(np.abs(Q).max()) or 1.0
    X, y, iterations = _clarabel(Q / scale, (len(Q) - 1) // 9, tolerance, max_iterations)
    return _relaxation(Q, X, y, scale, 0.0, iterations)


def solve_with_scale(Q: Array, row: Array, spread: float, tolerance: float, max_iterations: int) -> Relaxation:
    """Solve the relaxation with alpha >= 0 of x'Q'x + (alpha - row . r)^2 / spread, the cost with the scale kept.

    ``row`` (9 n,): the best scale of rotations r is row . r (eq. 47). ``spread``: see ``nonnegative.scale_spread``.
    """
    size = len(Q)
    scale = float(np.abs(Q).max()) or 1.0
    unit = np.sqrt(spread * scale)  # of alpha, so that its entries compare with the others
    apart = np.r_[-row / unit, 0.0, 1.0]
    lifted = np.outer(apart, apart)
    lifted[:size, :size] += Q / scale
    X, y, iterations = _clarabel(lifted, (size - 1) // 9, tolerance, max_iterations)
    return _relaxation(Q, X[:size, :size], y, scale, scale * float(y[-1]) / unit, iterations)


def _relaxation(Q: Array, X: Array, y: Array, scale: float, nu: float, iterations: int) -> Relaxation:
    n = (len(Q) - 1) // 9
    return Relaxation(
        X,
        scale * y[: 20 * n].reshape(n, 20),
        nu,
        float(np.vdot(Q, X)),
        scale * float(y[20 * n]),
        iterations,
        Start.CLARABEL,
    )


def _clarabel(C: Array, n: int, tolerance: float, max_iterations: int) -> tuple[Array, Array, int]:
    """X, multipliers and iterations, for C over [r, h] or over [r, h, alpha] with the entry h alpha nonnegative."""
    A, b = _constraint_columns(n, len(C)), stacked(C)
    cones = [clarabel.PSDTriangleConeT(len(C))]
    if len(C) == 9 * n + 2:  # nu >= 0, the multiplier of h alpha
        entry = np.zeros_like(C)
        entry[9 * n, 9 * n + 1] = 0.5
        A = scipy.sparse.hstack([A, scipy.sparse.csc_matrix(stacked(entry)[:, None])], format="csc")
        A = scipy.sparse.vstack([A, scipy.sparse.csc_matrix(([-1.0], ([0], [A.shape[1] - 1])), (1, A.shape[1]))], "csc")
        b = np.r_[b, 0.0]
        cones.append(clarabel.NonnegativeConeT(1))
    cost = np.zeros(A.shape[1])
    cost[20 * n] = -1.0
    multipliers, z, iterations = solve_conic(cost, A, b, cones, tolerance, max_iterations)
    return unstacked(z, len(C)), multipliers, iterations


def _constraint_columns(n: int, size: int) -> scipy.sparse.csc_matrix:
    """svec of each constraint's matrix as a column: 20 for each rotation, then e_h e_h'."""
    index = local_indices(n)
    k, p, q = np.nonzero(CONSTRAINTS)
    values = CONSTRAINTS[k, p, q]
    upper = p <= q  # h is the last of the ten and of the whole
    k, p, q, values = k[upper], p[upper], q[upper], values[upper]
    rows = index[:, q] * (index[:, q] + 1) // 2 + index[:, p]
    cols = 20 * np.arange(n)[:, None] + k
    data = np.broadcast_to(np.where(p == q, values, np.sqrt(2.0) * values), rows.shape)
    of_h = 9 * n * (9 * n + 1) // 2 + 9 * n
    return scipy.sparse.csc_matrix(
        (np.r_[data.ravel(), 1.0], (np.r_[rows.ravel(), of_h], np.r_[cols.ravel(), 20 * n])),
        (size * (size + 1) // 2, 20 * n + 1),
    )


def round_to_rotations(relaxation: Relaxation) -> list[Array]:
    """Rotations (n, 3, 3) from X: from its h column, which is x where X has rank one, and its leading eigenvector."""
    X = relaxation.X
    starts = [project(unvec(X[:-1, -1] / X[-1, -1]))]
    leading = np.linalg.eigh(X)[1][:, -1]
    starts.append(project(unvec(leading[:-1] * np.sign(leading[-1]))))
    return starts
