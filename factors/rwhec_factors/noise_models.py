"""Checks of noise models: the factors refuse noise that GTSAM would replace by other noise without a word."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from rwhec_factors.se3 import Array

Noise = gtsam.noiseModel.Base


def checked(noise: object, dimension: int, what: str) -> Noise:
    """A Gaussian or robust noise model of the right dimension, positive definite and finite.

    Raises
    ------
    TypeError
        If the value is not a noise model.
    ValueError
        If the dimension is wrong, a sigma is zero (a hard constraint), or the covariance is singular or not finite.
    """
    if not isinstance(noise, gtsam.noiseModel.Base):
        raise TypeError(
            f"the noise of {what} is a {type(noise).__name__}; give a gtsam.noiseModel of dimension {dimension}"
        )
    gaussian = without_loss(noise)
    if gaussian.dim() != dimension:
        raise ValueError(f"the noise model of {what} has dimension {gaussian.dim()}; it should have {dimension}")
    information = information_of(gaussian)
    if isinstance(gaussian, gtsam.noiseModel.Constrained) or np.isinf(information).any():
        raise ValueError(
            f"the noise model of {what} has a standard deviation of zero; measurements are never exact: give a small "
            "sigma, or add a gtsam.NonlinearEqualityPose3 for a known pose"
        )
    if not np.isfinite(information).all():
        raise ValueError(
            f"the noise model of {what} has entries that are NaN (sigmas: {gaussian.sigmas()}); give numbers"
        )
    size = np.sqrt(np.diagonal(information))
    if not (size > 0.0).all() or np.linalg.eigvalsh(information / size[:, None] / size)[0] < 1e-14:
        raise ValueError(
            f"the noise model of {what} is singular: some direction has no information (an infinite sigma?). "
            "To constrain a part of a pose, take a factor that measures that part"
        )
    return noise


def without_loss(noise: Noise) -> Any:
    """The Gaussian model inside a robust model; a Gaussian model itself."""
    while isinstance(noise, gtsam.noiseModel.Robust):
        noise = noise.noise()
    return noise  # GTSAM has no third kind


def information_of(gaussian: Any) -> Array:
    """W' W of a Gaussian noise model, (n, n)."""
    with np.errstate(invalid="ignore"):
        R = np.asarray(gaussian.R(), dtype=np.float64)
        information: Array = R.T @ R
    return information


def chordal(noise: Noise, what: str) -> Noise:
    """The noise of the chordal residual's rows: nine of a rotation (rad), then any three of a translation (m).

    ``noise`` is of a right perturbation, (3,) or (6,). |R - R_0|_F^2 is 2 theta^2, so each of the nine rows has sqrt(2)
    times the rotation's standard deviation.

    Raises
    ------
    ValueError
        If the rotation or the translation is not isotropic, or the two are correlated.
    """
    gaussian = without_loss(noise)
    information = information_of(gaussian)
    mean = np.diagonal(information).reshape(-1, 3).mean(axis=1)
    unit = np.sqrt(np.repeat(mean, 3))
    if np.abs(information / unit[:, None] / unit - np.eye(len(unit))).max() > 1e-6:
        raise ValueError(
            f"the noise model of {what} is anisotropic, and the chordal residual holds one sigma for rotation and one "
            f"for translation (sigmas: {gaussian.sigmas()}); take residual='geodesic', or Diagonal.Sigmas of "
            "[r, r, r, t, t, t] (Isotropic.Sigma for a rotation alone)"
        )
    rows = np.r_[np.full(9, np.sqrt(2.0 / mean[0])), np.repeat(1.0 / np.sqrt(mean[1:]), 3)]
    return with_loss_of(noise, gtsam.noiseModel.Diagonal.Sigmas(rows))


def with_loss_of(noise: Noise, gaussian: Noise) -> Noise:
    """The Gaussian model under the robust loss of ``noise``, if ``noise`` has one."""
    if isinstance(noise, gtsam.noiseModel.Robust):
        return gtsam.noiseModel.Robust.Create(noise.robust(), with_loss_of(noise.noise(), gaussian))
    return gaussian
