"""The rule that decides whether a direction is free."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri, fdtri

from gtsam_rwhec.geometry.poses import Array

#: The probability that a free direction counts as determined.
SIGNIFICANCE = 1e-3
#: Fewer equations to spare than this count as so many; the quantile is 1e60 there, and would overflow below.
LEAST_SPARE = 0.1


def free_threshold(squares: Array | float, fitted: Array | float, spare: Array | float) -> Array:
    """Information up to which a direction is free, in units of the information that noise alone would create in it.

    The information sums ``squares`` squares of noise. The direction is the weakest, so it fits ``fitted`` of them away;
    one at least is left. ``spare`` is the number of equations to spare that tell the noise. So this is an F quantile,
    times the share of the squares that is left. Without equations to spare only the weights tell the noise, and it is
    the chi-square quantile over ``squares``.
    """
    left = np.maximum(np.subtract(squares, fitted), 1.0)
    quantile = fdtri(left, np.maximum(spare, LEAST_SPARE), 1.0 - SIGNIFICANCE)
    if np.min(spare, initial=1.0) <= 0.0:
        quantile = np.where(np.greater(spare, 0.0), quantile, chdtri(left, SIGNIFICANCE) / left)
    return np.asarray(quantile * left / squares)
