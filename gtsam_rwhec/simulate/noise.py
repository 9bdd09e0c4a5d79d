"""Noise on simulated pose measurements, drawn for all measurements at once.

Every noise acts on the right of a pose T_a_b = (R_a_b, t_a_b), as in the RWHEC paper (Section 8):

    R_noisy = R_a_b R_eps          R_eps close to the identity, axes of frame b
    t_noisy = t_a_b + eps          eps in metres, axes of frame a

Two models are offered, because the paper's published experiments were run with other noise than its text states:

``stated``
    What the text says: R_eps ~ Langevin(I, kappa), eps ~ N(0, sigma^2 I). For honest statistics: the cost that the
    library minimises is this noise's negative log-likelihood.
``released``
    What reproduces the paper's Tables 2-5: R_eps turns about a uniform axis by an angle from von Mises(0, kappa), with
    the density exp(kappa cos t) in place of exp(2 kappa cos t) (1 - cos t). Its mean square is 1/kappa in place of
    3/(2 kappa): angles smaller by sqrt(3/2). eps has one random length along a random direction of the positive
    octant, or its opposite, by a rule of its own in each of Sections 8.1 and 8.2.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypedDict, get_args

import numpy as np
from numpy.random import Generator

from gtsam_rwhec.errors import NoiseError, OptionError
from gtsam_rwhec.simulate.transforms import (
    FloatArray,
    random_directions,
    rotations_of_quaternions,
    rotations_of_vectors,
)

NoiseModel = Literal["stated", "released"]
Seed = int | Generator
ReleasedTranslations = Callable[[int, float, Generator], FloatArray]


@dataclass(frozen=True, slots=True)
class Noise:
    """Size and model of the noise on a pose.

    Parameters
    ----------
    sigma_m
        Standard deviation of the translation along each axis, metres. (With ``released`` noise only a scale: the
        lengths that it gives are not Gaussian in three dimensions.)
    kappa
        Concentration of the rotation, no unit. Large ones mean a standard deviation of 1/sqrt(2 kappa) rad about each
        axis for ``stated`` noise.
    model
        ``"stated"`` (default, because it is the one that the cost assumes) or ``"released"``; see the module.

    Raises
    ------
    NoiseError
        If sigma_m or kappa is not positive and finite.
    OptionError
        If the model is not one of the two.
    """

    sigma_m: float
    kappa: float
    model: NoiseModel = "stated"

    def __post_init__(self) -> None:
        for name, value in (("sigma_m", self.sigma_m), ("kappa", self.kappa)):
            if not (math.isfinite(value) and value > 0.0):
                raise NoiseError(
                    f"Noise: {name} is {value!r}, but must be positive and finite; "
                    "for measurements without noise pass noise=None to the simulator"
                )
        if self.model not in get_args(NoiseModel):
            raise OptionError(f"Noise: model is {self.model!r}; choose one of {', '.join(get_args(NoiseModel))}")


def langevin_rotations(count: int, kappa: float, seed: Seed) -> FloatArray:
    """Draw from the isotropic Langevin distribution Langevin(I, kappa) on SO(3), exactly.

    The density is proportional to exp(kappa tr R) in the Haar measure, so the axis is uniform and the angle t has
    density proportional to exp(2 kappa cos t) (1 - cos t) on [0, pi]. As a unit quaternion (w, v), tr R = 3 - 4 |v|^2:
    a Bingham distribution with density exp(-4 kappa |v|^2), which is sampled by rejection from an angular central
    Gaussian envelope (Kent, Ganeiber, Mardia: A new unified approach for the simulation of a wide class of
    directional distributions, 2018); 44 draws in 100 or more are accepted, at any kappa >= 0.

    Parameters
    ----------
    count
        Number of rotations N.
    kappa
        Concentration; 0 gives uniform rotations.
    seed
        Seed, or a generator to draw from.

    Returns
    -------
    (N, 3, 3) rotation matrices.
    """
    generator = np.random.default_rng(seed)
    bingham = np.array([0.0, 4.0 * kappa, 4.0 * kappa, 4.0 * kappa])
    # The envelope of the highest acceptance has 1/b + 3/(b + 8 kappa) = 1; of the two ways to write the positive root,
    # the one that subtracts no like numbers.
    linear = 8.0 * kappa - 4.0
    root = math.hypot(linear, math.sqrt(32.0 * kappa))
    b = 16.0 * kappa / (linear + root) if linear > 0.0 else (root - linear) / 2.0
    envelope = 1.0 + 2.0 * bingham / b
    log_bound = (b - 4.0) / 2.0 + 2.0 * math.log(4.0 / b)

    quaternions_wxyz = np.empty((count, 4))
    filled = 0
    while filled < count:
        proposals = generator.standard_normal((2 * (count - filled) + 16, 4)) / np.sqrt(envelope)
        proposals /= np.linalg.norm(proposals, axis=1, keepdims=True)
        squares = proposals * proposals
        log_ratio = -squares @ bingham + 2.0 * np.log(squares @ envelope) - log_bound
        accepted = proposals[np.log1p(-generator.random(len(proposals))) < log_ratio][: count - filled]
        quaternions_wxyz[filled : filled + len(accepted)] = accepted
        filled += len(accepted)
    return rotations_of_quaternions(quaternions_wxyz)


def released_rotations(count: int, kappa: float, seed: Seed) -> FloatArray:
    """Draw rotations as the paper's experiments were run: a uniform axis, an angle from von Mises(0, kappa).

    Returns
    -------
    (N, 3, 3) rotation matrices.
    """
    generator = np.random.default_rng(seed)
    axes = random_directions(count, generator)
    angles = generator.vonmises(0.0, kappa, (count, 1))
    return rotations_of_vectors(angles * axes)


def gaussian_translations(count: int, sigma_m: float, seed: Seed) -> FloatArray:
    """Draw from N(0, sigma^2 I): (N, 3) translations in metres."""
    return np.random.default_rng(seed).normal(0.0, sigma_m, (count, 3))


def released_sphere_translations(count: int, sigma_m: float, seed: Seed) -> FloatArray:
    """Draw translations as Section 8.1 was run: u sigma z / (u'u), u uniform on [0,1]^3, z standard normal.

    Returns
    -------
    (N, 3) translations in metres. Their lengths sigma |z| / |u| have heavy tails: |u| comes close to zero.
    """
    generator = np.random.default_rng(seed)
    u = generator.random((count, 3))
    z = generator.standard_normal((count, 1))
    translations: FloatArray = u * sigma_m * z / np.sum(u * u, axis=1, keepdims=True)
    return translations


def released_camera_translations(count: int, sigma_m: float, seed: Seed) -> FloatArray:
    """Draw translations as Section 8.2 was run: sigma z u/|u|, u uniform on [0,1]^3, z standard normal.

    Returns
    -------
    (N, 3) translations in metres.
    """
    generator = np.random.default_rng(seed)
    u = generator.random((count, 3))
    z = generator.standard_normal((count, 1))
    translations: FloatArray = sigma_m * z * u / np.linalg.norm(u, axis=1, keepdims=True)
    return translations


def perturb(
    poses: FloatArray,
    noise: Noise | None,
    seed: Seed,
    released_translations: ReleasedTranslations | None = None,
) -> FloatArray:
    """Add noise to poses on the right: R_a_b R_eps, t_a_b + eps.

    Parameters
    ----------
    poses
        (N, 4, 4) poses T_a_b, metres; not changed.
    noise
        The noise; ``None`` returns a copy.
    seed
        Seed, or a generator to draw from.
    released_translations
        The rule for the translations of ``released`` noise: :func:`released_sphere_translations` or
        :func:`released_camera_translations`. ``stated`` noise does not use it.

    Returns
    -------
    (N, 4, 4) noisy poses.

    Raises
    ------
    OptionError
        If the noise is ``released`` and there is no rule for its translations.
    """
    noisy = np.array(poses, dtype=np.float64)
    if noise is None:
        return noisy
    generator = np.random.default_rng(seed)
    count = len(noisy)
    if noise.model == "stated":
        rotations = langevin_rotations(count, noise.kappa, generator)
        translations = gaussian_translations(count, noise.sigma_m, generator)
    elif released_translations is not None:
        rotations = released_rotations(count, noise.kappa, generator)
        translations = released_translations(count, noise.sigma_m, generator)
    else:
        raise OptionError(
            'Noise: model is "released", whose translations are defined only for the paper\'s Sections 8.1 and 8.2 '
            '(simulate.sphere, simulate.cameras); use model="stated" here'
        )
    noisy[:, :3, :3] = noisy[:, :3, :3] @ rotations
    noisy[:, :3, 3] += translations
    return noisy


class Weights(TypedDict):
    """What ``Problem.add`` takes as weights."""

    sigma: float | None
    kappa: float | None


def weights_of(noise: Noise | None) -> Weights:
    """The weights that belong to the noise; none for exact measurements."""
    return {"sigma": None, "kappa": None} if noise is None else {"sigma": noise.sigma_m, "kappa": noise.kappa}
