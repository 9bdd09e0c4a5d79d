"""Noise models: what a factor cannot honour is refused in words, where GTSAM would take something else in silence."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from rwhec_factors.se3 import Array

Noise = gtsam.noiseModel.Base


def checked(noise: object, dimension: int, what: str) -> Noise:
    """A Gaussian or robust noise model of a dimension, positive definite and finite.

    Raises
    ------
    TypeError
        For what is no noise model.
    ValueError
        For another dimension, a hard constraint (zero sigma), or a covariance that is singular or no number.
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
            "sigma, or add a gtsam.NonlinearEqualityPose3 to what is known"
        )
    if not np.isfinite(information).all():
        raise ValueError(f"the noise model of {what} has entries that are no numbers: sigmas {gaussian.sigmas()}")
    size = np.sqrt(np.diagonal(information))
    if not (size > 0.0).all() or np.linalg.eigvalsh(information / size[:, None] / size)[0] < 1e-14:
        raise ValueError(
            f"the noise model of {what} is singular: it says nothing of some direction (an infinite sigma?); for a "
            "part of a pose take a factor that measures that part"
        )
    return noise


def without_loss(noise: Noise) -> Any:
    """The Gaussian inside a robust model; itself where there is no loss."""
    while isinstance(noise, gtsam.noiseModel.Robust):
        noise = noise.noise()
    gaussian: Any = noise  # GTSAM has no third kind
    return gaussian


def information_of(gaussian: Any) -> Array:
    """W' W of a Gaussian noise model, (n, n)."""
    with np.errstate(invalid="ignore"):
        R = np.asarray(gaussian.R(), dtype=np.float64)
        information: Array = R.T @ R
    return information


def chordal(noise: Noise, what: str) -> Noise:
    """For the chordal residual's twelve rows, from a model of B's perturbation (6): [rotation (rad), translation (m)].

    |R - R_0|_F^2 is 2 theta^2: each of the nine rows has sqrt(2) times the rotation's standard deviation.

    Raises
    ------
    ValueError
        When rotation or translation is not isotropic, or the two are correlated: this residual holds two numbers.
    """
    gaussian = without_loss(noise)
    information = information_of(gaussian)
    diagonal = np.diagonal(information)
    same = np.r_[np.full(3, diagonal[:3].mean()), np.full(3, diagonal[3:].mean())]
    unit = np.sqrt(same)
    if np.abs(information / unit[:, None] / unit - np.eye(6)).max() > 1e-6:
        raise ValueError(
            f"the noise model of {what} is anisotropic, and the chordal residual holds one sigma for rotation and one "
            f"for translation (sigmas: {gaussian.sigmas()}); take residual='geodesic', or Diagonal.Sigmas of "
            "[r, r, r, t, t, t]"
        )
    sigma_R, sigma_t = 1.0 / unit[0], 1.0 / unit[3]
    rows: Noise = gtsam.noiseModel.Diagonal.Sigmas(np.r_[np.full(9, np.sqrt(2.0) * sigma_R), np.full(3, sigma_t)])
    return with_loss_of(noise, rows)


def with_loss_of(noise: Noise, gaussian: Noise) -> Noise:
    """A Gaussian model in the loss of another, if that has one."""
    if isinstance(noise, gtsam.noiseModel.Robust):
        return gtsam.noiseModel.Robust.Create(noise.robust(), with_loss_of(noise.noise(), gaussian))
    return gaussian
