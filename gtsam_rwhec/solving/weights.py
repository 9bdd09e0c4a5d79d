"""One rule about weights: when the residuals contradict what sigma and kappa claim of the noise."""

from __future__ import annotations

from scipy.special import chdtrc

#: Residuals may cost this many times what the weights predict: the noise is then larger by the square root, 1.4.
UNLIKELY = 2.0
#: With few degrees of freedom, chance makes such a cost often; it must be rarer than this to count.
CHANCE = 1e-3


def contradicted_by(cost: float, degrees_of_freedom: int) -> float | None:
    """How many times what true weights predict the residuals cost, where that is beyond doubt too much; else None.

    With true weights twice the cost is a chi-square with that many degrees of freedom.

    Parameters
    ----------
    cost : float
        Half the squared residuals over their variances.
    degrees_of_freedom : int
        Equations minus unknowns.
    """
    if degrees_of_freedom <= 0:
        return None
    ratio = cost / (0.5 * degrees_of_freedom)
    return ratio if ratio > UNLIKELY and chdtrc(degrees_of_freedom, 2.0 * cost) < CHANCE else None
