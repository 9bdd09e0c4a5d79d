"""The rule that decides whether a direction is free."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri, fdtri

from gtsam_rwhec.geometry.poses import Array

#: The probability that a free direction counts as determined.
SIGNIFICANCE = 1e-3


def free_threshold(squares: Array | float, degrees_of_freedom: int) -> Array:
    """Information up to which a direction is free, in units of the information that noise alone would create in it.

    This is the F quantile of both numbers. With no degrees of freedom only the weights tell the noise, and it is the
    chi-square quantile over ``squares``. The information sums ``squares`` squares of noise. ``degrees_of_freedom`` is
    equations minus unknowns. The noise of rotations and that of translations are each estimated from half of them.
    """
    if degrees_of_freedom <= 0:
        return np.asarray(chdtri(squares, SIGNIFICANCE) / squares)
    return np.asarray(fdtri(squares, 0.5 * degrees_of_freedom, 1.0 - SIGNIFICANCE))
