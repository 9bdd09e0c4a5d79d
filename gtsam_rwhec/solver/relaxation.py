"""The semidefinite relaxation of Problem 6 with all 21 constraints for each rotation (eqs. 19, 50, 70-73).

Clarabel solves small relaxations, the block method of ``interior_point`` solves large ones. Clarabel also solves the
variant with alpha >= 0 (Section 4.3): alpha becomes a variable, and the entry h alpha of X must be nonnegative.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import clarabel
import numpy as np
import scipy.linalg
import scipy.sparse
from rwhec_factors.se3 import so3_nearest

from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.certificate import Start
from gtsam_rwhec.solver.rotations import CONSTRAINTS, unvec
from gtsam_rwhec.solver.small_dual import gram, local_indices, scatter, traces


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


@dataclass(frozen=True)
class Relaxation:
    """A solution of the relaxation, up to the solver's accuracy."""

    X: Array  #: (9 n + 1, 9 n + 1): the primal variable; it has rank one where the relaxation is tight
    multipliers: Array  #: (n, 20)
    scale_multiplier: float  #: the multiplier of alpha >= 0; zero without this constraint
    primal: float  #: <Q', X>
    dual: float  #: gamma
    iterations: int
    solver: Start  #: which method solved it


@one_blas_thread()
def solve_by_blocks(Q: Array, tolerance: float, max_iterations: int, progress: Progress | None = None) -> Relaxation:
    """Solve the relaxation of Q' (9 n + 1 square, symmetric) to a relative gap of ``tolerance``.

    The method stops earlier where double precision ends: see the gap between ``primal`` and ``dual``.
    """
    size = len(Q)
    scale = float(np.abs(Q).max()) or 1.0
    C = Q / scale
    point = _strictly_feasible(C)
    iteration = 0
    for iteration in range(1, max_iterations + 1):
        primal, gap = float(np.vdot(C, point.X)), float(np.vdot(point.X, point.Z))
        if progress is not None and iteration % 5 == 1:
            progress(f"semidefinite relaxation, iteration {iteration}, gap {gap / (1e-12 + abs(primal)):.1e}")
        if gap <= tolerance * max(abs(primal), 1e-12):
            break
        try:
            system = _Newton.at(point)
            # Mehrotra: the length of the pure Newton step decides how much centring the real step gets.
            affine = system.direction(0.0, None)
            a_primal, a_dual = _step_length(point.X, affine.X, 1.0), _step_length(point.Z, affine.Z, 1.0)
            after = float(np.vdot(point.X + a_primal * affine.X, point.Z + a_dual * affine.Z)) / gap
            sigma = min(1.0, max(1e-4, after**2 if after < 0.3 else after))
            step = system.direction(sigma * gap / size, affine.X @ affine.Z)
            a_primal, a_dual = _step_length(point.X, step.X, 0.95), _step_length(point.Z, step.Z, 0.95)
        except np.linalg.LinAlgError:
            break  # double precision ends here
        if max(a_primal, a_dual) < 1e-6:
            break
        multipliers, gamma = point.multipliers + a_dual * step.multipliers, point.gamma + a_dual * step.gamma
        point = _Point(point.X + a_primal * step.X, multipliers, gamma, point.Z + a_dual * step.Z)
    X = point.X / point.X[-1, -1]
    primal, dual = scale * float(np.vdot(C, X)), scale * point.gamma
    return Relaxation(X, scale * point.multipliers, 0.0, primal, dual, iteration, Start.INTERIOR_POINT)


@dataclass(frozen=True)
class _Point:
    """An iterate, or a step from an iterate: X, lambda (n, 20), gamma, Z."""

    X: Array
    multipliers: Array
    gamma: float
    Z: Array


def _strictly_feasible(C: Array) -> _Point:
    """X of the uniform distribution on SO(3), and lambda on R'R = I so negative that Z is diagonally dominant."""
    n = (len(C) - 1) // 9
    c = 1.1 * float(np.abs(C).sum(axis=1).max())
    multipliers = np.zeros((n, 20))
    multipliers[:, :3] = -c
    gamma = float(C[-1, -1]) - 3.0 * n * c - c
    Z = C - scatter(np.einsum("nk,kpq->npq", multipliers, CONSTRAINTS))
    Z[-1, -1] -= gamma
    return _Point(np.diag(np.r_[np.full(9 * n, 1.0 / 3.0), 1.0]), multipliers, gamma, Z)


@dataclass(frozen=True)
class _Newton:
    """The linear system of X Z = target I at a point, factored once for predictor and corrector."""

    point: _Point
    W: Array
    family: Array
    factor: Any

    @staticmethod
    def at(point: _Point) -> _Newton:
        n = len(point.multipliers)
        family = np.broadcast_to(CONSTRAINTS, (n, 20, 10, 10))
        lower = scipy.linalg.cho_factor(point.Z, lower=True, check_finite=False)
        W = _symmetric(scipy.linalg.cho_solve(lower, np.eye(len(point.Z)), check_finite=False))
        M = _schur(family, point.X, W)
        # X tends to rank one and M to a singular matrix. The smallest addition that makes M positive definite
        # compensates the rounding of its diagonal. The next step corrects the infeasibility that this causes.
        diagonal = np.diagonal(M).copy()
        for relative in (0.0, 1e-14, 1e-12, 1e-10):
            M[np.diag_indices_from(M)] = diagonal * (1.0 + relative)
            try:
                return _Newton(point, W, family, scipy.linalg.cho_factor(M, lower=True, check_finite=False))
            except np.linalg.LinAlgError:
                continue
        raise np.linalg.LinAlgError("the Schur complement is numerically singular")

    def direction(self, target: float, correction: Array | None) -> _Point:
        """The HKM direction: dX = target W - X - sym(X dZ W) - sym(correction W), with X's constraints kept."""
        n = len(self.point.multipliers)
        base = target * self.W
        if correction is not None:
            base = base - _symmetric(correction @ self.W)
        right = -np.r_[traces(self.family, base).ravel(), base[-1, -1] - 1.0]
        solved = scipy.linalg.cho_solve(self.factor, right, check_finite=False)
        multipliers, gamma = solved[:-1].reshape(n, 20), float(solved[-1])
        dZ = -scatter(np.einsum("nk,kpq->npq", multipliers, CONSTRAINTS))
        dZ[-1, -1] -= gamma
        return _Point(base - self.point.X - _symmetric(self.point.X @ dZ @ self.W), multipliers, gamma, dZ)


def _schur(family: Array, X: Array, W: Array) -> Array:
    """tr(A_p X A_q W) over all constraints, the last one X_hh = 1."""
    n, c = family.shape[:2]
    M = np.empty((n * c + 1, n * c + 1))
    M[:-1, :-1] = gram(family, X, W)
    # A = e_h e_h': tr(A_ik X e_h e_h' W) = W_h' A_ik X_h, symmetrised like the rest.
    outer = np.outer(X[:, -1], W[-1])
    M[:-1, -1] = M[-1, :-1] = traces(family, 0.5 * (outer + outer.T)).ravel()
    M[-1, -1] = X[-1, -1] * W[-1, -1]
    return M


def _symmetric(M: Array) -> Array:
    return 0.5 * (M + M.T)


def _step_length(S: Array, dS: Array, fraction: float) -> float:
    """``fraction`` times the longest step a that keeps S + a dS positive definite; at most 1."""
    lower = np.linalg.cholesky(S + 1e-16 * np.trace(S) * np.eye(len(S)))
    half = scipy.linalg.solve_triangular(lower, dS, lower=True, check_finite=False)
    inner = scipy.linalg.solve_triangular(lower, half.T, lower=True, check_finite=False)
    smallest = scipy.linalg.eigvalsh(_symmetric(inner), subset_by_index=[0, 0], check_finite=False, driver="evr").item()
    return 1.0 if smallest >= -fraction else fraction / -smallest


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
    multipliers, primal, dual = scale * y[: 20 * n].reshape(n, 20), float(np.vdot(Q, X)), scale * float(y[20 * n])
    return Relaxation(X, multipliers, nu, primal, dual, iterations, Start.CLARABEL)


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
    starts = [so3_nearest(unvec(X[:-1, -1] / X[-1, -1]))]
    leading = np.linalg.eigh(X)[1][:, -1]
    starts.append(so3_nearest(unvec(leading[:-1] * np.sign(leading[-1]))))
    return starts
