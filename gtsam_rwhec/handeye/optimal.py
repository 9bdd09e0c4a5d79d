"""DQOpt (Section 3.2.1, Algorithm 1): the exact minimum of the DQ paper's cost, with its proof."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.handeye.cost import DualQuaternionCost
from gtsam_rwhec.handeye.degenerate import free_directions
from gtsam_rwhec.handeye.dual_quaternions import to_transform
from gtsam_rwhec.handeye.linear_prior import solve_with_linear_prior
from gtsam_rwhec.handeye.proof import HIDDEN, proven_bound
from gtsam_rwhec.handeye.request import Request
from gtsam_rwhec.handeye.saddle import SINGULAR, Minimum, is_singular, minimum
from gtsam_rwhec.methods.estimate import Outcome


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
