"""DQOpt (Section 3.2.1, Algorithm 1): the exact minimum of the DQ paper's cost, with its proof."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.handeye.cost import DualQuaternionCost
from gtsam_rwhec.handeye.degenerate import free_directions
from gtsam_rwhec.handeye.dual_quaternions import to_transform
from gtsam_rwhec.handeye.linear_prior import solve_with_linear_prior
from gtsam_rwhec.handeye.proof import HIDDEN, proven
from gtsam_rwhec.handeye.request import Request
from gtsam_rwhec.handeye.saddle import SINGULAR, Minimum, is_singular, minimum
from gtsam_rwhec.methods.estimate import Outcome


def dqopt(request: Request) -> Outcome[Array]:
    """DQOpt: the least of all costs (8), and lambda* as the proof."""
    cost = request.cost
    if request.prior is not None and request.prior.form == "distance":
        return solve_with_linear_prior(request, request.prior)
    found = minimum(cost)
    return Outcome(
        X=to_transform(found.q, found.q_dual),
        lower_bound=proven_bound(cost, found),
        free_directions=free_directions(request, found.q, found.values, found.vectors),
    )


def proven_bound(cost: DualQuaternionCost, found: Minimum, floor: float = 0.0) -> float:
    """The largest proven lower bound of the cost over all poses, a little below lambda*.

    Where [[S - lambda, W - mu], [W' - mu, M]] is positive semidefinite, lambda is a lower bound (eq. 9: the
    Lagrangian is that form plus lambda), and a Cholesky factorisation that succeeds with the rounding it can hide
    taken off the diagonal proves it. S, M and W are taken as they are in double precision.

    Parameters
    ----------
    cost : DualQuaternionCost
    found : Minimum
        Any mu proves something; the best of all proves most.
    floor : float
        A bound known beforehand: a sum of squares is not negative.
    """
    W, M = cost.W - found.mu * np.eye(4), cost.M
    if is_singular(cost):  # the null space of M couples to nothing but mu, which is 0 (``Z_pseudo``)
        values, vectors = cost.spectrum
        used = values > SINGULAR * max(float(values[3]), 0.0)
        W, M = cost.W @ vectors[:, used], np.diag(values[used])
    n = 4 + len(M)
    K = np.empty((n, n))
    K[:4, :4], K[:4, 4:], K[4:, :4], K[4:, 4:] = cost.S, W, W.T, M
    diagonal = cost.S.diagonal()
    value = cost.value(found.q, found.q_dual)
    step = 1.1 * HIDDEN * float(diagonal @ (found.q * found.q) + cost.M.diagonal() @ (found.q_dual**2))
    lower = value - step
    while lower > floor:
        K[range(4), range(4)] = diagonal - lower
        K[range(4, n), range(4, n)] = M.diagonal()
        if proven(K):
            return lower
        step *= 4.0
        lower = value - step
    return floor
