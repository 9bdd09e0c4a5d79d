"""The semidefinite relaxation by a primal-dual interior-point method that uses the constraints' blocks.

::

    primal   min <Q', X>   s.t. <A_ik, X> = 0 (20 a rotation),  X_hh = 1,  X >= 0        (eqs. 50-52)
    dual     max gamma     s.t. Z = Q' - sum lambda_ik A_ik - gamma e_h e_h' >= 0

The HKM direction with Mehrotra's predictor and corrector (Helmberg, Rendl, Vanderbei, Wolkowicz 1996; Todd 2001),
from strictly feasible points of both sides, known in closed form (DESIGN fact 6). The Schur complement needs only
10 x 10 blocks of X and Z^-1 (``local_blocks.gram``), where a general solver would treat every pair of constraints as
dense: 481 constraints on a 217 x 217 matrix, the real dataset, take a fraction of a second.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from gtsam_rwhec.certify.local_blocks import gram, scatter, traces
from gtsam_rwhec.certify.rotations import CONSTRAINTS
from gtsam_rwhec.poses import Array


@dataclass(frozen=True)
class Relaxation:
    """A solution of the relaxation, up to the solver's accuracy.

    Attributes
    ----------
    X : (9 n + 1, 9 n + 1) array
        Of the primal; rank one where the relaxation is tight.
    multipliers : (n, 20) array
    scale_multiplier : float
        Of alpha >= 0, where that was asked for.
    primal, dual : float
        <Q', X> and gamma.
    iterations : int
    solver : str
        "interior point (blocks)" or "Clarabel".
    """

    X: Array
    multipliers: Array
    scale_multiplier: float
    primal: float
    dual: float
    iterations: int
    solver: str


def solve_by_blocks(
    Q: Array, tolerance: float, max_iterations: int, progress: Callable[[str], None] | None = None
) -> Relaxation:
    """Solve the relaxation of Q' (9 n + 1 square, symmetric) to a relative gap of ``tolerance``."""
    size = len(Q)
    n = (size - 1) // 9
    scale = float(np.abs(Q).max()) or 1.0
    C = Q / scale
    family = np.broadcast_to(CONSTRAINTS, (n, 20, 10, 10))
    eye = np.eye(size)

    # Strictly feasible: the mean of SO(3) with a spread, and S = -c I with gamma low enough.
    X = np.diag(np.r_[np.full(9 * n, 1.0 / 3.0), 1.0])
    c = float(np.abs(C).sum(axis=1).max())
    multipliers = np.zeros((n, 20))
    multipliers[:, :3] = -c
    gamma = float(C[-1, -1]) - 3.0 * n * c - c

    def slack(multipliers: Array, gamma: float) -> Array:
        Z = C - scatter(np.einsum("nk,kpq->npq", multipliers, CONSTRAINTS))
        Z[-1, -1] -= gamma
        return Z

    Z = slack(multipliers, gamma)
    iteration = 0
    for iteration in range(1, max_iterations + 1):
        primal, gap = float(np.vdot(C, X)), float(np.vdot(X, Z))
        if progress is not None and iteration % 5 == 1:
            progress(f"semidefinite relaxation, iteration {iteration}, gap {gap / (1e-12 + abs(primal)):.1e}")
        if gap <= tolerance * max(abs(primal), 1e-9 * c) and _infeasibility(family, X) < 1e-9:
            break
        factor = scipy.linalg.cho_factor(Z, lower=True, check_finite=False)
        W = scipy.linalg.cho_solve(factor, eye, check_finite=False)
        W = 0.5 * (W + W.T)
        M = _schur(family, X, W)
        try:
            M_factor = scipy.linalg.cho_factor(M, lower=True, check_finite=False)
        except np.linalg.LinAlgError:
            break  # the end of what double precision gives
        mu = gap / size

        def direction(
            target: float, correction: Array | None, X: Array = X, Z: Array = Z, W: Array = W, M_factor: Array = M_factor
        ) -> tuple[Array, float, Array, Array]:
            """Solve for (dlambda, dgamma, dX, dZ) of X Z = target I."""
            base = target * W if correction is None else target * W - _symmetric(correction @ W)
            right = -np.r_[traces(family, base).ravel(), base[-1, -1] - 1.0]
            step = scipy.linalg.cho_solve(M_factor, right, check_finite=False)
            d_multipliers, d_gamma = step[:-1].reshape(n, 20), float(step[-1])
            dZ = -scatter(np.einsum("nk,kpq->npq", d_multipliers, CONSTRAINTS))
            dZ[-1, -1] -= d_gamma
            dX = base - X - _symmetric(X @ dZ @ W)
            return d_multipliers, d_gamma, dX, dZ

        _, _, dX, dZ = direction(0.0, None)
        a_primal, a_dual = _step_length(X, dX, 1.0), _step_length(Z, dZ, 1.0)
        after = float(np.vdot(X + a_primal * dX, Z + a_dual * dZ)) / gap
        sigma = min(1.0, max(1e-6, after) ** 3)
        d_multipliers, d_gamma, dX, dZ = direction(sigma * mu, dX @ dZ)
        a_primal, a_dual = _step_length(X, dX, 0.98), _step_length(Z, dZ, 0.98)
        if max(a_primal, a_dual) < 1e-6:
            break
        X = X + a_primal * dX
        multipliers = multipliers + a_dual * d_multipliers
        gamma += a_dual * d_gamma
        Z = slack(multipliers, gamma)
    X = X / X[-1, -1]
    return Relaxation(
        X, scale * multipliers, 0.0, scale * float(np.vdot(C, X)), scale * gamma, iteration, "interior point (blocks)"
    )


def _schur(family: Array, X: Array, W: Array) -> Array:
    """tr(A_p X A_q W) over all constraints, the last one X_hh = 1."""
    n, c = family.shape[:2]
    M = np.empty((n * c + 1, n * c + 1))
    M[:-1, :-1] = gram(family, X, W)
    # A = e_h e_h': tr(A_ik X e_h e_h' W) = W_h' A_ik X_h, symmetrised as the rest is.
    outer = np.outer(X[:, -1], W[-1])
    M[:-1, -1] = M[-1, :-1] = traces(family, 0.5 * (outer + outer.T)).ravel()
    M[-1, -1] = X[-1, -1] * W[-1, -1]
    return M


def _symmetric(M: Array) -> Array:
    result: Array = 0.5 * (M + M.T)
    return result


def _infeasibility(family: Array, X: Array) -> float:
    return float(np.abs(traces(family, X)).max(initial=0.0))


def _step_length(S: Array, dS: Array, fraction: float) -> float:
    """The longest step, up to 1, that keeps S + a dS positive definite, shortened by ``fraction``."""
    lower = np.linalg.cholesky(S + 1e-16 * np.trace(S) * np.eye(len(S)))
    half = scipy.linalg.solve_triangular(lower, dS, lower=True, check_finite=False)
    inner = scipy.linalg.solve_triangular(lower, half.T, lower=True, check_finite=False)
    smallest = float(
        scipy.linalg.eigvalsh(_symmetric(inner), subset_by_index=[0, 0], check_finite=False, driver="evr")[0]
    )
    return 1.0 if smallest >= -fraction else fraction / -smallest
