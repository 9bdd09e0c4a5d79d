"""The one rule by which a direction counts as free."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri, fdtri

from gtsam_rwhec.geometry.poses import Array

#: A free direction passes for determined with this probability.
SIGNIFICANCE = 1e-3


def free_threshold(squares: Array | float, degrees_of_freedom: int) -> Array:
    """Information up to which a direction is free, in units of the information that noise alone would create in it.

    Parameters
    ----------
    squares : float or array
        How many squares of noise that information sums.
    degrees_of_freedom : int
        Equations minus unknowns. The noise of rotations and that of translations are each estimated from half of them.

    Returns
    -------
    float or array
        The F quantile for these numbers; chi-square's, where nothing but the weights tells the noise.
    """
    if degrees_of_freedom <= 0:
        known: Array = np.asarray(chdtri(squares, SIGNIFICANCE) / squares)
        return known
    result: Array = np.asarray(fdtri(squares, 0.5 * degrees_of_freedom, 1.0 - SIGNIFICANCE))
    return result
