"""The rule that decides whether the residuals contradict the weights, sigma and kappa."""

from __future__ import annotations

from scipy.special import chdtr, chdtrc

#: Residuals may cost this many times what the weights predict. The noise is then larger by the root, 1.4 times.
UNLIKELY = 2.0
#: Residuals may cost this share of what the weights predict. The noise is then smaller by the root, half as large.
FAR_SMALLER = 0.25
#: With few degrees of freedom, chance often makes such a cost. Its probability must be smaller than this.
CHANCE = 1e-3


def contradicted_by(cost: float, degrees_of_freedom: int) -> float | None:
    """The cost over its expectation with true weights. It is None where the cost is not surely too large.

    With true weights, twice the cost is a chi-square with ``degrees_of_freedom``, equations minus unknowns.
    """
    if degrees_of_freedom <= 0:
        return None
    ratio = cost / (0.5 * degrees_of_freedom)
    return ratio if ratio > UNLIKELY and chdtrc(degrees_of_freedom, 2.0 * cost) < CHANCE else None


def overstated_by(cost: float, degrees_of_freedom: int) -> float | None:
    """The cost over its expectation, where it is surely far too small: the noise that was stated is too large."""
    if degrees_of_freedom <= 0:
        return None
    ratio = cost / (0.5 * degrees_of_freedom)
    return ratio if ratio < FAR_SMALLER and chdtr(degrees_of_freedom, 2.0 * cost) < CHANCE else None
