"""DQOpt (Section 3.2.1, Algorithm 1): the exact minimum of the DQ paper's cost, with its proof; and alpha.

With a prior's linear form a |1 - dq|^2 (eq. 25) the term is 2 a - 2 a q_0 . q, and the 4 x 4 eigenproblem becomes
one of 8 x 8: lambda is the smallest real eigenvalue of [[Z, -1], [-a^2 q_0 q_0', Z]] (Gander, Golub and von Matt
1989, eq. 9).
"""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import brentq

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods.dq_saddle import (
    HIDDEN,
    SINGULAR,
    Minimum,
    Z_pseudo,
    best_dual,
    bracket,
    is_singular,
    minimum,
    proven_bound,
)
from gtsam_rwhec.methods.dual_quaternion_cost import DualQuaternionCost, motion_moments, times_vectors, to_transform
from gtsam_rwhec.methods.hand_eye_request import DualQuaternionPrior, Request, free_directions
from gtsam_rwhec.methods.method import Outcome
from gtsam_rwhec.methods.motions import Motions, squared_residuals

#: This many Newton steps refine the multiplier of |q| = 1.
POLISHING = 4


def solve_with_linear_prior(request: Request, prior: DualQuaternionPrior) -> Outcome[Array]:
    """DQOpt with eq. 25: ``request.cost`` has the prior's translation part, and its rotation part is added here."""
    cost = request.cost
    pull = prior.a * prior.dual_quaternion[0]
    if is_singular(cost):
        mu = 0.0
        Z = Z_pseudo(cost)
        candidates = [on_sphere(Z, pull)]
    else:
        mu = _multiplier(cost, pull)
        Z = cost.Z(mu)
        # Where the sphere has two equal minima at mu, each side of mu has one of them.
        near = 1e-9 * (abs(mu) + float(np.sqrt(cost.spectrum[0][0])))
        candidates = [on_sphere(cost.Z(m), pull) for m in (mu, mu - near, mu + near)]
    poses = [(q, best_dual(cost, q)) for q, _ in candidates]
    q, q_dual = min(poses, key=lambda pose: cost.value(*pose) - 2.0 * float(pull @ pose[0]))
    # The curvature along the sphere is that of Z - lambda. The noise is Z's smallest eigenvalue, as for DQOpt.
    V = times_vectors(q)
    curvatures, turns = np.linalg.eigh(V.T @ (Z - candidates[0][1] * np.eye(4)) @ V)
    noise = max(float(np.linalg.eigvalsh(Z)[0]), 0.0)
    values, vectors = np.append(noise, noise + curvatures), np.column_stack([q, V @ turns])
    return Outcome(
        X=to_transform(q, q_dual),
        lower_bound=_bound_at(cost, pull, prior.a, mu, candidates[0]),
        free_directions=free_directions(request, q, values, vectors),
    )


def on_sphere(Z: Array, pull: Array) -> tuple[Array, float]:
    """The minimum of q'Z q - 2 pull . q over |q| = 1: q (4,) and the multiplier lambda of (Z - lambda) q = pull."""
    length = float(np.sqrt(pull @ pull))
    values, vectors = np.linalg.eigh(Z)
    if length == 0.0:
        return vectors[:, 0], float(values[0])
    p = vectors.T @ pull
    block = np.block([[Z, -np.eye(4)], [-np.outer(pull, pull), Z]])
    roots = np.linalg.eigvals(block)
    real = roots.real[np.abs(roots.imag) <= 1e-7 * (np.abs(values).max() + length)]
    # lambda lies between values[0] - |pull| and values[0] - |p_0|.
    highest, lowest = float(values[0]) - abs(float(p[0])), float(values[0]) - length
    lam = min(max(float(real.min()) if real.size else lowest, lowest), highest)
    for _ in range(POLISHING):  # Newton on 1 / |q(lambda)| = 1, nearly linear in lambda (Conn et al. 2000, 7.3.1)
        gaps = values - lam
        if gaps[0] <= 1e-15 * (abs(values[0]) + length):
            break
        q = p / gaps
        norm = math.sqrt(float(q @ q))
        lam = min(max(lam - (norm - 1.0) * norm**2 / float((q * q / gaps).sum()), lowest), highest)
    gaps = values - lam
    if gaps[0] > 1e-12 * (abs(values[0]) + length):
        q = p / gaps
        return vectors @ (q / math.sqrt(float(q @ q))), lam
    # The pull has no component along the smallest eigenvector: q takes that component with either sign.
    q = np.concatenate([[0.0], p[1:] / np.maximum(gaps[1:], 1e-300)])
    q[0] = math.copysign(math.sqrt(max(1.0 - float(q @ q), 0.0)), p[0])
    return vectors @ (q / math.sqrt(float(q @ q))), float(values[0])


def _multiplier(cost: DualQuaternionCost, pull: Array) -> float:
    """mu*, where q . q' = 0 (eq. 11)."""
    Z1, Z2 = cost.Z1, cost.Z2
    low, high = bracket(Z1, Z2)  # Appendix C holds for every q

    def f(mu: float) -> float:  # q . q', which rises with mu
        q, _ = on_sphere(cost.Z(mu), pull)
        return float(mu * (q @ Z2 @ q) - 0.5 * (q @ Z1 @ q))

    if f(low) >= 0.0:
        return low
    if f(high) <= 0.0:
        return high
    return float(brentq(f, low, high, xtol=1e-15 * (high - low), rtol=1e-14))


def _bound_at(cost: DualQuaternionCost, pull: Array, a: float, mu: float, minimum: tuple[Array, float]) -> float:
    """The largest proven lower bound of the cost with the prior's rotation part.

    Where [[S - lambda, W - mu, -pull], [., M, 0], [., 0, tau]] is positive semidefinite, it is lambda - tau + 2 a.
    """
    q, lam = minimum
    tau = float(pull @ q)
    value = lam - tau + 2.0 * a
    W, zero = cost.W - mu * np.eye(4), np.zeros((4, 1))

    def form(lower: float) -> Array:
        step = 0.5 * (value - lower)  # half of it to lambda, half of it to tau
        S, column = cost.S - (lam - step) * np.eye(4), -pull[:, None]
        return np.block([[S, W, column], [W.T, cost.M, zero], [column.T, zero.T, np.array([[tau + step]])]])

    return proven_bound(form, value, 2e-14 * (float(np.trace(cost.S)) + a))


def dqopt(request: Request) -> Outcome[Array]:
    """DQOpt finds the pose with the smallest cost (8); lambda* proves it."""
    if request.prior is not None and request.prior.form == "distance":
        return solve_with_linear_prior(request, request.prior)
    found = minimum(request.cost)
    return Outcome(
        X=to_transform(found.q, found.q_dual),
        lower_bound=bound_at(request.cost, found),
        free_directions=free_directions(request, found.q, found.values, found.vectors),
    )


def bound_at(cost: DualQuaternionCost, found: Minimum) -> float:
    """The largest proven lower bound of the cost over all poses. It is a little below lambda*.

    Where [[S - lambda, W - mu], [W' - mu, M]] is positive semidefinite, lambda is a lower bound: the Lagrangian (eq. 9)
    is that form plus lambda. S, M and W are taken as they are in double precision. Every mu proves a bound; mu* proves
    the largest.
    """
    W, M = cost.W - found.mu * np.eye(4), cost.M
    if is_singular(cost):  # the null space of M couples to nothing but mu, which is 0 (``Z_pseudo``)
        values, vectors = cost.spectrum
        used = values > SINGULAR * max(float(values[3]), 0.0)
        W, M = cost.W @ vectors[:, used], np.diag(values[used])
    weighed = cost.S.diagonal() @ (found.q * found.q) + cost.M.diagonal() @ (found.q_dual * found.q_dual)
    return proven_bound(
        lambda lower: np.block([[cost.S - lower * np.eye(4), W], [W.T, M]]),
        cost.value(found.q, found.q_dual),
        1.1 * HIDDEN * float(weighed),
    )


#: Alpha changes at most this many times, with one solution for each alpha.
ITERATIONS = 50
#: Alpha has converged when it changes by less than this part. Residuals give alpha to a few per cent at best.
STILL = 1e-6
#: Residuals below this share of the motions' own size are only rounding error.
ROUNDING = 1e-24
#: Alpha stays within this factor of its starting value.
RANGE = 1e6


def estimate_alpha(motions: Motions, weights: Array | None = None, prior: DualQuaternionPrior | None = None) -> float:
    """Alpha (1/m) that gives both kinds of residual the same size: rms |A q| / rms |B q + A q'| at the optimum.

    Each step lowers N log(sum |A q|^2) + N log(sum |B q + A q'|^2): the likelihood of normal residuals whose two
    sigmas are unknown. For given poses alpha is that ratio, and for given alpha the poses are DQOpt's. Alpha starts as
    the ratio of the motions' own sizes. Where the residuals are rounding error, it stays as it is. The
    meaning of a prior's a and b does not depend on alpha.
    """
    moments = motion_moments(motions.rows, weights)
    turned, moved = float(np.trace(moments.AA)), float(np.trace(moments.BB))
    if not (turned > 0.0 and moved > 0.0):
        return 1.0
    first = alpha = math.sqrt(turned / moved)
    for _ in range(ITERATIONS):
        cost = moments.cost(alpha)
        found = minimum(cost if prior is None else prior.added_to(cost))
        rotation, translation = squared_residuals(motions, found.q, found.q_dual, weights)
        if rotation <= ROUNDING * turned or translation <= ROUNDING * moved:
            break
        before, alpha = alpha, min(max(math.sqrt(rotation / translation), first / RANGE), first * RANGE)
        if abs(alpha - before) <= STILL * before:
            break
    return alpha
