"""The components that fit the residuals best, and the curvature of the posterior density there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.noise_model.average_information import average_information
from gtsam_rwhec.noise_model.components import Sizes
from gtsam_rwhec.noise_model.gradient import Eliminated
from gtsam_rwhec.noise_model.likelihood import Estimate, NoiseModel

#: The step of differences of gradients, in logarithms.
STEP = 0.05
#: A fit ends where -2 log of the density would fall by less than this.
ENOUGH = 1e-3
#: At most this many evaluations are for one fit; the first of them have the average information as curvature.
MOST, AVERAGED = 60, 6
#: No step of the logarithms is longer than this.
FARTHEST = 4.0
#: A step that lowers the objective by less than this share of what it should makes the next this much shorter; above
#: the other share they may become longer.
POOR, SHORTER, GOOD = 0.25, 0.4, 0.75
#: The curvature counts as this at least: a fifth of what the prior alone has.
FLATTEST = 0.1


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


def fitted(model: NoiseModel, sizes: Sizes, start: Array, *, enough: float = ENOUGH) -> Fitted:
    """The maximum of the posterior density of the components, from a start: Newton's steps in a trusted region.

    The first steps have the average information as curvature. What the density's gradients tell of it afterwards goes
    in as in BFGS: where the noise is not as in the model, the average information may be several times too small.

    Parameters
    ----------
    enough : float
        It ends where another step would lower ``objective`` by less than this.
    """
    low, high = np.array(sizes.bounds).T
    here = _Point.at(model, sizes, np.clip(start, low, high))
    H, radius = here.information, FARTHEST
    for number in range(1, MOST):
        held = ((here.logs <= low) & (here.gradient > 0.0)) | ((here.logs >= high) & (here.gradient < 0.0))
        step, gain = _trusted_step(H, np.where(held, 0.0, here.gradient), ~held, radius)
        if gain < enough:
            break
        there = _Point.at(model, sizes, np.clip(here.logs + step, low, high))
        step = there.logs - here.logs
        expected = -float(here.gradient @ step + 0.5 * step @ H @ step)
        share = (here.value - there.value) / max(expected, 1e-300)
        H = _updated(H, step, there.gradient - here.gradient)
        length = float(np.linalg.norm(step))
        if share < POOR:
            radius = SHORTER * length
        elif share > GOOD and length > 0.8 * radius:
            radius = min(2.0 * radius, FARTHEST)
        if there.value < here.value:
            here = there
            if number < AVERAGED:
                H = here.information
    return Fitted(sizes, here.logs, here.value, here.estimate)


@dataclass(frozen=True)
class _Point:
    """-2 log of the posterior density at some components, its gradient, and what its curvature comes from."""

    sizes: Sizes
    logs: Array
    value: float
    gradient: Array
    estimate: Estimate
    eliminated: Eliminated

    @staticmethod
    def at(model: NoiseModel, sizes: Sizes, logs: Array) -> _Point:
        estimate, eliminated = model.eliminated(sizes.values(logs))
        gradient = eliminated.gradient_by(sizes.active) + sizes.penalty_gradient(logs)
        return _Point(sizes, logs, estimate.minus_two_log + sizes.penalty(logs), gradient, estimate, eliminated)

    @property
    def information(self) -> Array:
        """The average information (k, k), and the prior's."""
        return average_information(self.eliminated, self.sizes.active) + np.diag(2.0 / self.sizes.spread**2)


def _trusted_step(H: Array, gradient: Array, free: np.ndarray, radius: float) -> tuple[Array, float]:
    """Newton's step (k,) along the free components, no longer than a radius; and what a whole one would gain."""
    step = np.zeros(len(H))
    values, Q = np.linalg.eigh(H[np.ix_(free, free)])
    values = np.maximum(values, FLATTEST)
    along = Q.T @ gradient[free]
    found, damped = along / values, 0.05
    while np.linalg.norm(found) > radius:
        found, damped = along / (values + damped), 2.0 * damped
    step[free] = -(Q @ found)
    return step, 0.5 * float(along @ (along / values))


def _updated(H: Array, step: Array, change: Array) -> Array:
    """The curvature after a step and the gradient's change along it (BFGS, damped as by Powell 1978)."""
    moved = H @ step
    before, after = float(step @ moved), float(step @ change)
    if before <= 0.0:  # no step at all
        return H
    if after < 0.2 * before:
        share = 0.8 * before / (before - after)
        change = share * change + (1.0 - share) * moved
        after = float(step @ change)
    found: Array = H - np.outer(moved, moved) / before + np.outer(change, change) / after
    return found


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
