"""The unknowns' distribution with that of the components mixed in.

A covariance for components that are estimated from few measurements is too small if they count as known. So the
components' posterior is sampled (a Gaussian about the mode, weighted by the true density), and

    mean = sum w_i step_i,    covariance = sum w_i (covariance_i + (step_i - mean) (step_i - mean)')
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, fdtri, ndtri

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.noise_model.components import PRIOR
from gtsam_rwhec.noise_model.likelihood import Estimate, NoiseModel
from gtsam_rwhec.noise_model.reml import Fitted, curvature, value_and_gradient

#: Samples of the components.
SAMPLES = 32
#: Samples of the unknowns for each.
DRAWS = 64
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
    """The unknowns under all probable components.

    Attributes
    ----------
    step : (p,) array
    covariance : (p, p) array
    logs, weights : (n, k) and (n,) arrays
        The samples of the components' logarithms, and their weights.
    estimates : tuple of Estimate
        For each sample.
    """

    step: Array
    covariance: Array
    logs: Array
    weights: Array
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
        drawn = []
        used = np.flatnonzero(rows.any(axis=0))  # few of many unknowns
        of_used = rows[:, used]
        for i, estimate in enumerate(self.estimates):
            root = np.linalg.cholesky(of_used @ estimate.covariance[used[:, None], used] @ of_used.T)
            sample = rows @ (estimate.step - self.step) + chance.normal(size=(DRAWS, len(rows))) @ root.T
            if added is not None:
                sample = sample + chance.normal(size=(DRAWS, added.shape[2])) @ added[i].T
            drawn.append(sample)
        return np.concatenate(drawn), np.repeat(self.weights, DRAWS) / DRAWS

    def degrees_of_freedom(self, rows: Array) -> float:
        """Those of an F quantile that fits the ellipsoid of functions (m, p) of the unknowns; inf for chi-square."""
        m = len(rows)
        found = _quantile(*self.draws(rows), rows @ self.covariance @ rows.T)
        if found <= chdtri(m, 1.0 - CONFIDENCE) * 1.01:
            return float(np.inf)
        if found >= m * fdtri(m, FEWEST, CONFIDENCE):
            return FEWEST
        low, high = np.log(FEWEST), np.log(1e6)
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            is_large = m * fdtri(m, np.exp(middle), CONFIDENCE) > found
            low, high = (middle, high) if is_large else (low, middle)
        return float(np.exp(low))

    def share_of(self, rows: Array, added: Array, probability: float = 1.0) -> float:
        """The share of the mean of ``added`` with which the ellipsoid holds as much of the samples as it says.

        The posterior of a standard deviation that the data hardly show has a long tail. Its mean square would make the
        ellipsoid far too large, its mode too small. ``probability`` is that of ``added`` being there at all.
        """
        samples, weights = self.draws(rows, added)
        if probability < 1.0:
            without, as_often = self.draws(rows)
            samples = np.concatenate([samples, without])
            weights = np.concatenate([probability * weights, (1.0 - probability) * as_often])
        plain = rows @ self.covariance @ rows.T
        mean = np.einsum("n,nij,nkj->ik", self.weights, added, added)
        wanted = chdtri(len(rows), 1.0 - CONFIDENCE)
        low, high = 0.0, 1.0
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            is_small = _quantile(samples, weights, plain + middle * mean) > wanted
            low, high = (middle, high) if is_small else (low, middle)
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


def mixture_of(model: NoiseModel, fit: Fitted, whole: NoiseModel, samples: int = SAMPLES) -> Mixture:
    """The mixture about the most probable components; the unknowns are those of the ``whole`` model."""
    k = len(fit.logs)
    low, high = np.array(fit.sizes.bounds).T
    H = 0.5 * curvature(lambda logs: value_and_gradient(model, fit.sizes, logs)[1], fit.logs, low, high)
    values, vectors = np.linalg.eigh(H)
    spread = vectors / np.sqrt(np.maximum(values, 0.5 / PRIOR**2))
    drawn = normal_points(samples, k)
    logs = np.clip(fit.logs + drawn @ spread.T, low, high)
    estimates = [model.evaluate(fit.sizes.values(at)) for at in logs]
    heights = np.array([e.minus_two_log for e in estimates]) + np.array([fit.sizes.penalty(at) for at in logs])
    if whole is not model:
        estimates = [whole.evaluate(fit.sizes.values(at)) for at in logs]
    weights = np.exp(-0.5 * (heights - fit.objective) + 0.5 * (drawn**2).sum(axis=1))
    weights = np.minimum(weights / weights.mean(), HEAVIEST)
    weights /= weights.sum()
    steps = np.array([e.step for e in estimates])
    mean = weights @ steps
    away = steps - mean
    covariance = np.einsum("n,nij->ij", weights, np.array([e.covariance for e in estimates]))
    covariance += (weights[:, None] * away).T @ away
    return Mixture(mean, covariance, logs, weights, tuple(estimates))
