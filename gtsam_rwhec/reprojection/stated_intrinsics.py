"""Whether the images contradict the stated intrinsics: the innovation test; and what only their prior holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, chdtri

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.reprojection.lens import PINHOLE

#: Directions count in which the images say at least this share of what the prior and the images say together.
TOLD = 0.05
#: The parts of a camera's parameters, which are stated well or badly for reasons of their own. Each is tested alone:
#: among all parameters together a centre that is off by three deviations drowns.
PARTS = {"focal length": slice(0, 2), "centre": slice(2, PINHOLE), "distortion": slice(PINHOLE, None)}
#: A stated part is contradicted where chance gives such an innovation with less than this probability; where it does
#: so with less than the second, its deviations are widened all the same.
CONTRADICTED, DOUBTED = 0.0025, 0.05
#: By so many times: what is contradicted is off as nominal intrinsics are, and no calibration's.
WIDER_CONTRADICTED, WIDER_DOUBTED = 10.0, 3.0
#: A direction is held by the prior where its posterior deviation is above this share of the prior's.
HELD = 0.7


@dataclass(frozen=True, eq=False)
class Innovation:
    """What the images say against stated intrinsics.

    Attributes
    ----------
    off : (m,) array
        Estimated less stated parameters.
    probabilities : dict of str to float
        That chance gives as much, by part ("focal length", "centre", "distortion").
    """

    off: Array
    probabilities: Mapping[str, float]

    @property
    def probability(self) -> float:
        """That chance gives one part as much: Bonferroni's bound."""
        return min(1.0, len(self.probabilities) * min(self.probabilities.values()))

    @property
    def deviations(self) -> float:
        """How far off the worst part is, as deviations of one normal number with the same probability."""
        return deviations_of(min(self.probabilities.values()))

    @property
    def contradicted(self) -> tuple[str, ...]:
        """The parts that chance does not explain."""
        return tuple(part for part, probability in self.probabilities.items() if probability < CONTRADICTED)

    @property
    def doubted(self) -> tuple[str, ...]:
        """The parts that chance hardly explains, or not at all."""
        return tuple(part for part, probability in self.probabilities.items() if probability < DOUBTED)

    @property
    def is_contradicted(self) -> bool:
        """Whether chance does not explain a part."""
        return bool(self.contradicted)


def deviations_of(probability: float) -> float:
    """The deviations that a normal number exceeds with a probability, either way."""
    return float(np.sqrt(chdtri(1.0, max(probability, 1e-300))))


def innovation_of(off: Array, prior: Array, posterior: Array) -> Innovation:
    """The test of estimated less stated parameters (m,), with the prior's deviations (m,) and the posterior (m, m)."""
    return Innovation(
        off, {part: chance_of(off[at], prior[at], posterior[at, at]) for part, at in PARTS.items() if len(off[at])}
    )


def chance_of(off: Array, prior: Array, posterior: Array) -> float:
    """The probability that chance gives as much; `off` (m,), the prior's deviations (m,) and the posterior (m, m).

    Before the images, `off` has the covariance prior^2 - posterior: z^2 of its principal parts is chi-square.
    """
    covariance = np.eye(len(off)) - posterior / np.outer(prior, prior)
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    told = values > TOLD
    if not told.any():
        return 1.0
    z2 = float(((vectors.T @ (off / prior))[told] ** 2 / values[told]).sum())
    return float(chdtrc(told.sum(), z2))


def wider(deviation: Array, innovation: Innovation) -> Array:
    """The prior's deviations (m,), wider for the parts that are doubted."""
    result = deviation.copy()
    for part in innovation.doubted:
        result[PARTS[part]] *= WIDER_CONTRADICTED if part in innovation.contradicted else WIDER_DOUBTED
    return result


def held_by_prior(prior: Array, posterior: Array) -> np.ndarray:
    """Which parameters (m,) only the prior holds: alone, or in a direction that the images do not tell.

    A focal length that only the prior holds leaves fx and fy each a deviation that is smaller than the prior's, since
    the images tell that they are equal. So principal directions are asked, in the prior's deviations; a direction
    names the parameters that have half of its largest part and more.
    """
    scaled = posterior / np.outer(prior, prior)
    values, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    parts = np.abs(vectors[:, values > HELD**2])
    of_directions = (parts >= 0.5 * parts.max(axis=0, initial=0.0)).any(axis=1)
    return np.asarray(of_directions | (np.diagonal(scaled) > HELD**2))
