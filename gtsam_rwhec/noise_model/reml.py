"""The components that fit the residuals best, and the curvature of the posterior density there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.noise_model.components import Sizes
from gtsam_rwhec.noise_model.likelihood import Estimate, NoiseModel

#: The step of differences of gradients, in logarithms.
STEP = 0.05
#: The objective is settled when the gradient is below this: one unit of it is a likelihood ratio of 1.6.
SETTLED = 0.02
#: At most this many evaluations are for one fit.
MOST = 60


@dataclass(frozen=True)
class Fitted:
    """Components at their most probable values.

    Attributes
    ----------
    sizes : Sizes
    logs : (k,) array
        Logarithms of the standard deviations.
    objective : float
        -2 log of the posterior density there.
    estimate : Estimate
    """

    sizes: Sizes
    logs: Array
    objective: float
    estimate: Estimate


def value_and_gradient(model: NoiseModel, sizes: Sizes, logs: Array) -> tuple[float, Array]:
    """-2 log of the posterior density of the logarithms, up to a constant, and its gradient."""
    estimate, gradient = model.value_and_gradient(sizes.values(logs), sizes.active)
    return estimate.minus_two_log + sizes.penalty(logs), gradient + sizes.penalty_gradient(logs)


def fitted(model: NoiseModel, sizes: Sizes, start: Array) -> Fitted:
    """The maximum of the posterior density of the components, from a start."""
    bounds = sizes.bounds
    low, high = np.array(bounds).T
    from scipy.optimize import fmin_l_bfgs_b  # here, since its import takes as long as a calibration of few poses

    logs, value, _ = fmin_l_bfgs_b(
        lambda logs: value_and_gradient(model, sizes, logs), np.clip(start, low, high), bounds=bounds,
        maxfun=MOST, factr=1e7, pgtol=SETTLED,
    )  # fmt: skip
    return Fitted(sizes, logs, float(value), model.evaluate(sizes.values(logs)))


def curvature(gradient: Callable[[Array], Array], at: Array, low: Array, high: Array) -> Array:
    """The second derivative (k, k) of a function by central differences of its gradient, one-sided at the bounds."""
    k = len(at)
    H = np.empty((k, k))
    for i in range(k):
        after, before = at.copy(), at.copy()
        after[i], before[i] = min(at[i] + STEP, high[i]), max(at[i] - STEP, low[i])
        H[i] = (gradient(after) - gradient(before)) / (after[i] - before[i])
    symmetric: Array = 0.5 * (H + H.T)
    return symmetric
