"""The components that fit the residuals best, and the curvature of the posterior density there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, fdtri, fdtridfd, ndtri

from gtsam_rwhec.fitting.fit_options import SYSTEMATIC, Component
from gtsam_rwhec.fitting.noise_likelihood import Eliminated, Estimate, NoiseModel, average_information
from gtsam_rwhec.geometry.poses import Array

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
    """Components at their most probable values."""

    sizes: Sizes
    #: (k,): Logarithms of the standard deviations.
    logs: Array
    #: -2 log of the posterior density there.
    objective: float
    estimate: Estimate


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
    here = Point.at(model, sizes, np.clip(start, low, high))
    H, radius = here.information, FARTHEST
    for number in range(1, MOST):
        held = ((here.logs <= low) & (here.gradient > 0.0)) | ((here.logs >= high) & (here.gradient < 0.0))
        step, gain = _trusted_step(H, np.where(held, 0.0, here.gradient), ~held, radius)
        if gain < enough:
            break
        there = Point.at(model, sizes, np.clip(here.logs + step, low, high))
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
    return Fitted(sizes, here.logs, here.value, here.eliminated.estimate)


@dataclass(frozen=True)
class Point:
    """-2 log of the posterior density of the logarithms, up to a constant, and its gradient."""

    sizes: Sizes
    logs: Array
    value: float
    gradient: Array
    eliminated: Eliminated

    @staticmethod
    def at(model: NoiseModel, sizes: Sizes, logs: Array) -> Point:
        """At logarithms (k,) of the active components."""
        eliminated = model.eliminated(sizes.values(logs))
        value = eliminated.estimate.minus_two_log + sizes.penalty(logs)
        gradient = eliminated.gradient_by(sizes.active) + sizes.penalty_gradient(logs)
        return Point(sizes, logs, value, gradient, eliminated)

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


def curvature(model: NoiseModel, sizes: Sizes, at: Array) -> Array:
    """The second derivative (k, k) of `Point.value` by central differences of its gradient, one-sided at the bounds."""
    low, high = np.array(sizes.bounds).T
    rows = []
    for step in STEP * np.eye(len(at)):
        after, before = np.minimum(at + step, high), np.maximum(at - step, low)
        change = Point.at(model, sizes, after).gradient - Point.at(model, sizes, before).gradient
        rows.append(change / (after - before).sum())
    H = np.array(rows)
    symmetric: Array = 0.5 * (H + H.T)
    return symmetric


#: Samples of the components: so many over the number of measurements, from the second to the third. Few measurements
#: leave components open; of 6 to 12 poses, 32 samples made the radius 20 % wrong in one of ten cells.
SAMPLES, FEWEST_SAMPLES, MOST_SAMPLES = 3000, 24, 128
#: Those of a dense log, which knows its components well.
OF_DENSE = 16
#: Samples of the unknowns.
DRAWS = 4096
#: The density's reach along an axis is found at so many deviations.
FAR = 4.0
#: No sample counts more than this many times the mean.
HEAVIEST = 8.0
#: The confidence at which the ellipsoid's size is fitted, and the fewest degrees of freedom that it may have.
CONFIDENCE, FEWEST = 0.95, 3.0
#: A share is found by so many bisections.
BISECTIONS = 12
#: A root is found by so many steps, each of which halves its error at least.
ROOT_STEPS = 60


@dataclass(frozen=True)
class Mixture:
    """The unknowns under all probable components."""

    #: (p,)
    step: Array
    #: (p, p)
    covariance: Array
    #: (n, k) and (n,): The samples of the components' logarithms, and their weights.
    logs: Array
    weights: Array
    #: For each sample.
    estimates: tuple[Estimate, ...]

    def quantiles(self, probabilities: tuple[float, ...]) -> Array:
        """Quantiles (m, k) of the components' standard deviations."""
        order = np.argsort(self.logs, axis=0)
        result = np.empty((len(probabilities), self.logs.shape[1]))
        for j in range(self.logs.shape[1]):
            cumulative = np.cumsum(self.weights[order[:, j]])
            result[:, j] = np.exp(np.interp(probabilities, cumulative, self.logs[order[:, j], j]))
        return result

    def draws(self, rows: Array, added: Array | None = None) -> tuple[Array, Array]:
        """Samples (n, m) of some functions (m, p) of the unknowns, about their mean, and the samples' weights.

        ``added`` (samples, m, m) are roots of covariances of something independent that comes on top.
        """
        chance = np.random.default_rng(0)
        drawn, number = [], DRAWS // len(self.estimates)
        used = np.flatnonzero(rows.any(axis=0))  # few of many unknowns
        of_used = rows[:, used]
        for i, estimate in enumerate(self.estimates):
            root = np.linalg.cholesky(of_used @ estimate.covariance[used[:, None], used] @ of_used.T)
            sample = rows @ (estimate.step - self.step) + chance.normal(size=(number, len(rows))) @ root.T
            if added is not None:
                sample = sample + chance.normal(size=(number, added.shape[2])) @ added[i].T
            drawn.append(sample)
        return np.concatenate(drawn), np.repeat(self.weights, number) / number

    def degrees_of_freedom(self, rows: Array) -> float:
        """Those of an F quantile that fits the ellipsoid of functions (m, p) of the unknowns; inf for chi-square."""
        m = len(rows)
        found = _quantile(*self.draws(rows), rows @ self.covariance @ rows.T)
        if found <= chdtri(m, 1.0 - CONFIDENCE) * 1.01:
            return float(np.inf)
        if found >= m * fdtri(m, FEWEST, CONFIDENCE):
            return FEWEST
        return float(fdtridfd(m, CONFIDENCE, found / m))

    def share_of(self, rows: Array, added: Array, probability: float = 1.0, least: float = 0.0) -> float:
        """The share of the mean of ``added`` with which the ellipsoid holds as much of the samples as it says.

        The posterior of a standard deviation that the data hardly show has a long tail. Its mean square would make the
        ellipsoid far too large, its mode too small. ``probability`` is that of ``added`` being there at all. A share
        that is less than ``least`` is not looked for.
        """
        samples, weights = self.draws(rows, added)
        if probability < 1.0:
            without, as_often = self.draws(rows)
            samples = np.concatenate([samples, without])
            weights = np.concatenate([probability * weights, (1.0 - probability) * as_often])
        plain = rows @ self.covariance @ rows.T
        mean = np.einsum("n,nij,nkj->ik", self.weights, added, added)
        wanted = chdtri(len(rows), 1.0 - CONFIDENCE)

        def is_small(share: float) -> bool:
            return bool(_quantile(samples, weights, plain + share * mean) > wanted)

        if least and not is_small(least):
            return least
        low, high = 0.0, 1.0
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if is_small(middle) else (low, middle)
        return high


def _quantile(samples: Array, weights: Array, covariance: Array) -> float:
    """The quantile of x' covariance^-1 x at ``CONFIDENCE``."""
    whitened = samples @ np.linalg.inv(np.linalg.cholesky(covariance)).T
    squares = (whitened**2).sum(axis=1)
    order = np.argsort(squares)
    return float(np.interp(CONFIDENCE, np.cumsum(weights[order]), squares[order]))


def normal_points(count: int, dimension: int) -> Array:
    """Points (n, k) that are spread as a normal distribution is, the first at its mean: an additive recurrence.

    (Its step is the powers of 1 / g, g^(k + 1) = g + 1: Roberts 2018, the R_d sequence.)
    """
    g = 1.5
    for _ in range(ROOT_STEPS):
        g = (1.0 + g) ** (1.0 / (dimension + 1.0))
    step = g ** -np.arange(1.0, dimension + 1.0)
    points: Array = ndtri((0.5 + np.arange(count)[:, None] * step) % 1.0)
    return points


def mixture_of(model: NoiseModel, fit: Fitted, whole: NoiseModel) -> Mixture:
    """The mixture about the most probable components; the unknowns are those of the ``whole`` model.

    Samples are of a split normal distribution (Geweke, Econometrica 57, 1989), which reaches on either side of an axis
    as far as the density does: a curvature alone does not see that a component may also be nothing.
    """
    k, few = len(fit.logs), min(max(SAMPLES // len(model.rows.residual), FEWEST_SAMPLES), MOST_SAMPLES)
    low, high = np.array(fit.sizes.bounds).T
    H = 0.5 * curvature(model, fit.sizes, fit.logs)
    values, vectors = np.linalg.eigh(H)
    axes = (vectors / np.sqrt(np.maximum(values, 0.5 / PRIOR**2))).T

    def evaluated(logs: Array) -> tuple[list[Estimate], Array]:
        estimates = [model.evaluate(fit.sizes.values(at)) for at in logs]
        return estimates, np.array([e.minus_two_log for e in estimates]) + [fit.sizes.penalty(at) for at in logs]

    _, far = evaluated(np.clip(fit.logs + FAR * np.concatenate([-axes, axes]), low, high))
    reach = FAR / np.sqrt(np.clip(far - fit.objective, 1.0, FAR**2)).reshape(2, k)
    drawn = normal_points(few if whole is model else OF_DENSE, k)
    reached = np.where(drawn < 0.0, *reach)
    logs = np.clip(fit.logs + (drawn * reached) @ axes, low, high)
    estimates, heights = evaluated(logs)
    if whole is not model:
        estimates = [whole.evaluate(fit.sizes.values(at)) for at in logs]
    weights = np.exp(-0.5 * (heights - fit.objective) + 0.5 * (drawn**2).sum(axis=1)) * reached.prod(axis=1)
    weights = np.minimum(weights / weights.mean(), HEAVIEST)
    weights /= weights.sum()
    steps = np.array([e.step for e in estimates])
    mean = weights @ steps
    away = steps - mean
    covariance = np.einsum("n,nij->ij", weights, np.array([e.covariance for e in estimates]))
    covariance += (weights[:, None] * away).T @ away
    return Mixture(mean, covariance, logs, weights, tuple(estimates))


#: A component is at least and at most this many times the typical size of what residuals show of it.
SMALLEST, LARGEST = 1e-3, 30.0
#: The logarithm of a standard deviation is known before the data with this standard deviation.
PRIOR = 2.0
#: That of a component that the user states.
STATED = 0.02
#: A component is expected at this share of the residuals.
EXPECTED = 0.3
#: Errors that vary with the configuration are expected at this share: an arm in order shows less of them than noise.
EXPECTED_SYSTEMATIC = 0.15


@dataclass(frozen=True)
class Sizes:
    """What is known of each component before the data."""

    #: The components in the model.
    active: tuple[Component, ...]
    #: (k,): Each one's size if it alone made the residuals; it is between ``SMALLEST`` and ``LARGEST`` times that.
    typical: Array
    #: (k,): Mean and standard deviation of the logarithms.
    expected: Array
    spread: Array

    @staticmethod
    def of(typical: dict[Component, float], stated: dict[Component, float]) -> Sizes:
        """Components by their typical sizes; those that were ``stated`` have these standard deviations."""
        active = tuple(typical)
        sizes = np.array([stated.get(component, size) for component, size in typical.items()])
        is_stated = np.array([component in stated for component in active])
        share = np.where([component in SYSTEMATIC for component in active], EXPECTED_SYSTEMATIC, EXPECTED)
        expected = np.log(np.where(is_stated, 1.0, share) * sizes)
        return Sizes(active, sizes, expected, np.where(is_stated, STATED, PRIOR))

    @property
    def bounds(self) -> list[tuple[float, float]]:
        """Of the logarithms."""
        return [(c + np.log(SMALLEST), c + np.log(LARGEST)) for c in np.log(self.typical)]

    def penalty(self, logs: Array) -> float:
        """-2 log of the prior's density."""
        return float((((logs - self.expected) / self.spread) ** 2).sum())

    def penalty_gradient(self, logs: Array) -> Array:
        """The derivative (k,) of ``penalty``."""
        found: Array = 2.0 * (logs - self.expected) / self.spread**2
        return found

    def values(self, logs: Array) -> dict[Component, float]:
        """Standard deviations by component; zero for those that are not active."""
        return dict.fromkeys(Component, 0.0) | dict(zip(self.active, np.exp(logs).tolist(), strict=True))
