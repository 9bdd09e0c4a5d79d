"""DQItr (Section 3.2.5, Algorithm 5): the multiplier of q . q' = 0 as a fixed point."""

from __future__ import annotations

import warnings

import numpy as np

from gtsam_rwhec.errors import NotConvergedWarning
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.handeye.approximate import answer_of, relaxation
from gtsam_rwhec.handeye.request import Request
from gtsam_rwhec.handeye.saddle import bracket, is_singular
from gtsam_rwhec.methods.estimate import Outcome

#: mu stands still when it changes by less than this part of the range that Appendix C gives it.
STILL = 1e-13
ITERATIONS = 200


def dqitr(request: Request) -> Outcome[Array]:
    """DQItr: mu <- q(mu)'Z1 q(mu) / (2 q(mu)'Z2 q(mu)) (eq. 24) until it stands still.

    With M singular (no noise), where the paper finds the iteration unstable, mu is 0 and nothing is iterated.

    Warns
    -----
    NotConvergedWarning
        When mu still moves after 200 iterations: the fixed point need not attract. ``dqopt`` always arrives.
    """
    cost = request.cost
    if is_singular(cost):
        return answer_of(request, relaxation(cost).vectors[:, 0])
    Z0, Z1, Z2 = cost.Z0, cost.Z1, cost.Z2
    low, high = bracket(Z1, Z2)
    mu = 0.0
    for _ in range(ITERATIONS):
        q = np.linalg.eigh(Z0 + mu * (Z1 - mu * Z2))[1][:, 0]
        before, mu = mu, float(0.5 * (q @ Z1 @ q) / (q @ Z2 @ q))
        if abs(mu - before) <= STILL * (high - low):
            break
    else:
        warnings.warn(
            f"'dqitr' still moves after {ITERATIONS} iterations (mu from {before:.6g} to {mu:.6g}); "
            "its answer may be off: use method='dqopt'",
            NotConvergedWarning,
            stacklevel=4,
        )
    return answer_of(request, q)
