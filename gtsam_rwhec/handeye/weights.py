"""Checks of the weights of motions: alpha, one weight for each motion, or covariances of the residuals."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from gtsam_rwhec.errors import CountError, NoiseError, OptionError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import is_between, real_array

#: Weights above this, and below its inverse, leave no room for squares and sums in double precision.
LARGEST = 1e100


def check_one_kind(weights: ArrayLike | None, covariances: ArrayLike | None) -> None:
    """Refuse weights together with covariances (OptionError)."""
    if weights is not None and covariances is not None:
        raise OptionError("weights and covariances are both given; put the weights into the covariances")


def check_alpha(alpha: float | str) -> float:
    """Alpha as a float; an OptionError when it is not a positive number from 1 / LARGEST to LARGEST."""
    if not is_between(alpha, 1.0 / LARGEST, LARGEST):
        raise OptionError(
            f"alpha={brief(alpha)} is not a positive number from {1.0 / LARGEST:g} to {LARGEST:g}; it weighs "
            "translation residuals (1/m) against rotation residuals, about sigma_rotation / sigma_translation; "
            "'estimate' finds it from the residuals"
        )
    return float(alpha)


def _numbers(given: ArrayLike, what: str) -> Array:
    try:
        return real_array(given)
    except ValueError as error:
        raise NoiseError(f"{what} cannot be read as numbers ({error}); give an array of real numbers") from error


def check_weights(weights: ArrayLike | None, count: int) -> Array | None:
    """Weights as an array (N,), or None.

    Raises CountError when there is not one for each motion, and NoiseError for weights that are negative or not finite,
    or fewer than two that are not zero.
    """
    if weights is None:
        return None
    array = _numbers(weights, "weights")
    if array.shape != (count,):
        raise CountError(f"weights have shape {array.shape}; give one number for each of the {count} motions")
    bad = np.flatnonzero(~((array >= 0.0) & (array <= LARGEST)))
    if bad.size:
        raise NoiseError(
            f"weight {bad[0]} is {array[bad[0]]}; give a finite number from 0 (the motion is left out) to {LARGEST:g}"
        )
    if np.count_nonzero(array) < 2:
        raise NoiseError(f"{np.count_nonzero(array)} of {count} weights are not zero; AX = XB needs two motions")
    return array


def check_covariances(covariances: ArrayLike | None, count: int) -> Array | None:
    """Covariances (N, 8, 8), or (8, 8) for all motions, of (A q, B q + A q'); returns (N or 1, 8, 8), or None.

    Raises CountError for a wrong shape, NoiseError for covariances that are not symmetric, or not positive definite.
    """
    if covariances is None:
        return None
    array = _numbers(covariances, "covariances")
    if array.shape == (8, 8):
        array = array[None]
    if array.shape[1:] != (8, 8) or len(array) not in (1, count):
        raise CountError(
            f"covariances have shape {array.shape}; give (8, 8), or ({count}, 8, 8): one for each motion, of the "
            "residual (A q, B q + A q')"
        )
    asymmetry = np.abs(array - array.transpose(0, 2, 1)).max(axis=(1, 2))
    bad = np.flatnonzero(~(asymmetry <= 1e-9 * np.abs(array).max(axis=(1, 2))))
    if bad.size:
        raise NoiseError(
            f"covariance {bad[0]} is not finite and symmetric (off by {asymmetry[bad[0]]:.3g}); give finite numbers, "
            "the same on both sides of the diagonal"
        )
    smallest = np.linalg.eigvalsh(array)[:, 0]
    bad = np.flatnonzero(smallest <= 0.0)
    if bad.size:
        raise NoiseError(
            f"covariance {bad[0]} is not positive definite (smallest eigenvalue {smallest[bad[0]]:.3g}); add the "
            "variance that its most certain direction really has"
        )
    return array
