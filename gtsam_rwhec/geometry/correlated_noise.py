"""White noise, and noise with decaying correlation in time: its weights, and which of them residuals make likeliest."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from gtsam_rwhec.geometry.poses import Array

#: Shares s of the correlated noise in the variance, with time constants (s); likelihood compares them. The last ones
#: are random walks over seconds to minutes.
CHOICES = (
    *product((0.2, 0.5, 0.8, 0.95), (0.15, 0.5, 1.5, 5.0, 20.0)),
    *product((0.9, 0.99, 0.999, 0.9999, 0.99999, 0.9999999), (200.0,)),
)
#: Correlated noise replaces white noise if -2 log likelihood falls by this much: 99 % of chi-square with two degrees of
#: freedom.
CLEARLY_LIKELIER = 9.2


@dataclass(frozen=True)
class CorrelatedNoise:
    """The weights Sigma^-1 of n measurements in order of time: white noise, and noise with decaying correlation.

    A detection's error depends on the view, and visual odometry drifts; neighbouring errors are alike. Sigma is
    w I + s K with w + s = 1 and K_ij = exp(-|t_i - t_j| / tau) (Ornstein-Uhlenbeck). K^-1 is tridiagonal (Rue and Held,
    Gaussian Markov Random Fields, Section 1.1): all below takes time proportional to n, by Sigma^-1 =
    K^-1 (s I + w K^-1)^-1 and log|Sigma| = log|s I + w K^-1| + log|K|.
    """

    share: float  #: Part of the variance that fades, s
    time_constant_s: float  #: tau

    @staticmethod
    def white() -> CorrelatedNoise:
        """Noise without correlation."""
        return CorrelatedNoise(0.0, 1.0)

    def weighted(self, seconds: Array, columns: Array, track: np.ndarray | None = None) -> tuple[Array, float]:
        """Sigma^-1 times columns (n, m), and log|Sigma|.

        ``seconds`` (n,) do not decrease; where there are several tracks (n,), within each, one after the other.
        """
        if self.share == 0.0 or not len(seconds):
            return columns, 0.0
        apart = np.diff(seconds) if track is None else np.where(np.diff(track), np.inf, np.diff(seconds))
        rho = np.minimum(np.exp(-apart / self.time_constant_s), 1.0 - 1e-9)
        rest = 1.0 - rho**2
        diagonal = np.ones(len(seconds))
        diagonal[1:] += rho**2 / rest
        diagonal[:-1] += rho**2 / rest
        beside = -rho / rest
        banded = np.zeros((2, len(seconds)))
        banded[0, 1:] = (1.0 - self.share) * beside
        banded[1] = self.share + (1.0 - self.share) * diagonal
        factor = cholesky_banded(banded)
        U = cho_solve_banded((factor, False), columns)
        result: Array = diagonal[:, None] * U
        result[1:] += beside[:, None] * U[:-1]
        result[:-1] += beside[:, None] * U[1:]
        return result, float(2.0 * np.log(factor[1]).sum() + np.log(rest).sum())


def likeliest(seconds: Array, residuals: Array, track: np.ndarray) -> tuple[CorrelatedNoise, float]:
    """The noise that makes residuals likeliest, and -2 log of this likelihood, up to a constant.

    White noise is the answer unless another one is clearly likelier. ``seconds`` (n,), ``residuals`` (n, m) and
    ``track`` (n,) are as in ``CorrelatedNoise.weighted``: all columns have one variance, and tracks are independent.
    """
    square = float((residuals**2).sum())
    best, lowest = CorrelatedNoise.white(), residuals.size * np.log(square + 1e-300) - CLEARLY_LIKELIER
    for share, constant in CHOICES:
        noise = CorrelatedNoise(share, constant)
        weighted, determinant = noise.weighted(seconds, residuals, track)
        square = float((residuals * weighted).sum())
        value = residuals.size * np.log(square + 1e-300) + residuals.shape[1] * determinant
        if value < lowest:
            best, lowest = noise, value
    return best, lowest
