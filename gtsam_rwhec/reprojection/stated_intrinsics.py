"""Whether the images contradict the stated intrinsics: the innovation test; and what only their prior holds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, chdtri

from gtsam_rwhec.geometry.poses import Array

#: Directions count in which the images say at least this share of what the prior and the images say together.
TOLD = 0.05
#: Stated intrinsics are contradicted where chance gives such an innovation with less than this probability.
LEVEL = 1e-3
#: A direction is held by the prior where its posterior deviation is above this share of the prior's.
HELD = 0.7


@dataclass(frozen=True, eq=False)
class Innovation:
    """What the images say against stated intrinsics.

    Attributes
    ----------
    deviations : float
        How far off, as deviations of one normal number with the same probability.
    probability : float
        That chance gives as much.
    off : (m,) array
        Estimated less stated parameters.
    """

    deviations: float
    probability: float
    off: Array

    @property
    def is_contradicted(self) -> bool:
        """Whether chance does not explain it."""
        return self.probability < LEVEL


def innovation_of(off: Array, prior: Array, posterior: Array) -> Innovation:
    """The test of estimated less stated parameters (m,), with the prior's deviations (m,) and the posterior (m, m).

    Before the images, `off` has the covariance prior^2 - posterior: z^2 of its principal parts is chi-square.
    """
    covariance = np.eye(len(off)) - posterior / np.outer(prior, prior)
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    told = values > TOLD
    if not told.any():
        return Innovation(0.0, 1.0, off)
    z2 = float(((vectors.T @ (off / prior))[told] ** 2 / values[told]).sum())
    probability = float(chdtrc(told.sum(), z2))
    return Innovation(float(np.sqrt(chdtri(1.0, max(probability, 1e-300)))), probability, off)


def held_by_prior(prior: Array, posterior: Array) -> np.ndarray:
    """Which parameters (m,) only the prior holds."""
    return np.asarray(np.sqrt(np.diagonal(posterior)) > HELD * prior)
