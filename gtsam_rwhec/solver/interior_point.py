"""The semidefinite relaxation, solved by a primal-dual interior-point method that uses the constraints' blocks.

::

    primal   min <Q', X>   s.t. <A_ik, X> = 0 (20 a rotation),  X_hh = 1,  X >= 0        (eqs. 50-52)
    dual     max gamma     s.t. Z = Q' - sum lambda_ik A_ik - gamma e_h e_h' >= 0

It takes the HKM direction with Mehrotra's predictor and corrector (Helmberg, Rendl, Vanderbei, Wolkowicz 1996; Todd
2001). It starts from strictly feasible points of both sides, known in closed form (design fact 6). The Schur complement
needs only 10 x 10 blocks of X and Z^-1 (``local_blocks.gram``), where a general solver would treat every pair of
constraints as dense. The real dataset, 481 constraints on a 217 x 217 matrix, takes a fraction of a second.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg

from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.cause import Start
from gtsam_rwhec.solver.local_blocks import gram, scatter, traces
from gtsam_rwhec.solver.rotations import CONSTRAINTS


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
        point = _Point(
            point.X + a_primal * step.X,
            point.multipliers + a_dual * step.multipliers,
            point.gamma + a_dual * step.gamma,
            point.Z + a_dual * step.Z,
        )
    X = point.X / point.X[-1, -1]
    return Relaxation(
        X,
        scale * point.multipliers,
        0.0,
        scale * float(np.vdot(C, X)),
        scale * point.gamma,
        iteration,
        Start.INTERIOR_POINT,
    )


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
        # X tends to rank one and M to a singular matrix. The smallest addition that makes M positive definite replaces
        # what rounding took from its diagonal. The next step corrects the infeasibility that this causes.
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
    result: Array = 0.5 * (M + M.T)
    return result


def _step_length(S: Array, dS: Array, fraction: float) -> float:
    """The longest step, up to 1, that keeps S + a dS positive definite, shortened by ``fraction``."""
    lower = np.linalg.cholesky(S + 1e-16 * np.trace(S) * np.eye(len(S)))
    half = scipy.linalg.solve_triangular(lower, dS, lower=True, check_finite=False)
    inner = scipy.linalg.solve_triangular(lower, half.T, lower=True, check_finite=False)
    smallest = float(
        scipy.linalg.eigvalsh(_symmetric(inner), subset_by_index=[0, 0], check_finite=False, driver="evr")[0]
    )
    return 1.0 if smallest >= -fraction else fraction / -smallest
