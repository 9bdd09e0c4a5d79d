"""How many degrees of freedom a covariance has whose noise was estimated.

Its logarithm moves with those of the noise's variances v: w = d log |C| / d log v over the dimension. These have the
covariance V = 2 (d^2 (-2 log L) / d (log v)^2)^-1 at the maximum, so C's variance factor has the variance w' V w, which
2 / nu is for nu degrees of freedom (Fai and Cornelius 1996).
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.reprojection.reduced import Noise, Reduced

#: The step of numeric derivatives by the logarithm of a deviation.
STEP = 1e-3
#: A deviation that counts less than this, rad or m, is none: its variance has no part in a covariance.
NOTHING = 1e-6
#: Fewer degrees of freedom than this are not told from noise.
FEWEST = 3.0


def degrees_of_freedom(reduced: Reduced, noise: Noise, *, carrier: bool) -> dict[tuple[str, str], float]:
    """Of each unknown's covariance; with `carrier` false only the corners' noise was estimated."""
    deviations = np.array([noise.corner_px, noise.carrier_rad, noise.carrier_m])
    free = [0, *(i for i in (1, 2) if carrier and deviations[i] > NOTHING)]

    def at(step: Array) -> Noise:
        moved = deviations.copy()
        moved[free] *= np.exp(step)
        return Noise(*moved.tolist())

    steps = STEP * np.eye(len(free))
    gradients = [
        (reduced.minus_two_log_likelihood(at(step))[1] - reduced.minus_two_log_likelihood(at(-step))[1])[free]
        for step in steps
    ]
    # by log v = 2 log s
    hessian = np.array(gradients) / (2.0 * STEP) / 4.0
    values, vectors = np.linalg.eigh(0.5 * (hessian + hessian.T))
    V = (vectors * (2.0 / np.maximum(values, 1e-6))) @ vectors.T
    above, below = ([np.linalg.inv(reduced.information(at(sign * step))) for step in steps] for sign in (1.0, -1.0))
    result = {}
    for name, rows in reduced.slots.items():
        size = rows.stop - rows.start
        w = np.array([
            (np.linalg.slogdet(up[rows, rows])[1] - np.linalg.slogdet(down[rows, rows])[1]) / (2.0 * STEP) / 2.0 / size
            for up, down in zip(above, below, strict=True)
        ])  # fmt: skip
        variance = float(w @ V @ w)
        result[name] = max(2.0 / variance, FEWEST) if variance > 0.0 else float("inf")
    return result
