"""The weight alpha between translations and rotations (DQ paper, Sections 3.1 and 4.3), from the residuals."""

from __future__ import annotations

import math

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.handeye.cost import motion_moments
from gtsam_rwhec.handeye.motion_costs import squared_residuals
from gtsam_rwhec.handeye.motions import Motions
from gtsam_rwhec.handeye.prior import DualQuaternionPrior
from gtsam_rwhec.handeye.saddle import minimum

#: Alpha changes at most this many times, with one solution for each alpha.
ITERATIONS = 50
#: Alpha has converged when it changes by less than this part. Residuals give alpha to a few per cent at best.
STILL = 1e-6
#: Residuals below this part of the motions' own size are rounding error and tell nothing.
ROUNDING = 1e-24
#: Alpha stays within this factor of its starting value.
RANGE = 1e6


def estimate_alpha(motions: Motions, weights: Array | None = None, prior: DualQuaternionPrior | None = None) -> float:
    """Alpha (1/m) that gives both kinds of residual the same size: rms |A q| / rms |B q + A q'| at the optimum.

    Each step lowers N log(sum |A q|^2) + N log(sum |B q + A q'|^2): the likelihood of normal residuals whose two
    sigmas are unknown. For given poses alpha is that ratio, and for given alpha the poses are DQOpt's. Alpha starts as
    the ratio of the motions' own sizes. Where the residuals are rounding error, it stays as it is. A prior's a and b
    keep their meaning while alpha changes.
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
