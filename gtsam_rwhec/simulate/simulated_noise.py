"""Noise on simulated pose measurements, drawn for all measurements at once.

Every noise acts on the right of a pose T_a_b = (R_a_b, t_a_b), as in the RWHEC paper (Section 8):

    R_noisy = R_a_b R_eps          R_eps close to the identity, axes of frame b
    t_noisy = t_a_b + eps          eps in metres, axes of frame a

There are two models, because the paper's experiments used other noise than its text states:

``stated``
    As the text says: R_eps ~ Langevin(I, kappa), eps ~ N(0, sigma^2 I). Use it for honest statistics: the library's
    cost is the negative log-likelihood of this noise.
``released``
    Reproduces the paper's Tables 2-5. R_eps turns about a uniform axis by an angle from von Mises(0, kappa), whose
    density is exp(kappa cos t) in place of exp(2 kappa cos t) (1 - cos t). Its mean square is 1/kappa in place of
    3/(2 kappa): angles are smaller by sqrt(3/2). eps has one random length along a random direction of the positive
    octant, or against it. Sections 8.1 and 8.2 have different rules for the length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, TypedDict, get_args

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike
from rwhec_factors.se3 import pose
from scipy.spatial.transform import Rotation

from gtsam_rwhec.errors import NoiseError, OptionError
from gtsam_rwhec.geometry.poses import Array

NoiseModel = Literal["stated", "released"]
#: The rule of this section of the RWHEC paper gives the lengths of released translations.
Section = Literal["8.1", "8.2"]
Seed = int | Generator


@dataclass(frozen=True, slots=True)
class Noise:
    """Size and model of the noise on a pose.

    Raises
    ------
    NoiseError
        If sigma_m or kappa is not positive and finite.
    OptionError
        If the model is unknown.
    """

    #: Standard deviation of the translation along each axis, metres. With ``released`` noise it is only a scale: those
    #: lengths are not Gaussian in three dimensions.
    sigma_m: float
    #: Concentration of the rotation, no unit. A large kappa of ``stated`` noise means a standard deviation of 1/sqrt(2
    #: kappa) rad about each axis.
    kappa: float
    model: NoiseModel = "stated"  #: See the module. The default is the model that the cost assumes.

    def __post_init__(self) -> None:
        for name, value in (("sigma_m", self.sigma_m), ("kappa", self.kappa)):
            if not (math.isfinite(value) and value > 0.0):
                raise NoiseError(
                    f"Noise: {name} is {value!r}, but must be positive and finite; "
                    "for measurements without noise pass noise=None to the simulator"
                )
        if self.model not in get_args(NoiseModel):
            raise OptionError(f"Noise: model is {self.model!r}; choose one of {', '.join(get_args(NoiseModel))}")


def langevin_rotations(count: int, kappa: float, seed: Seed) -> Array:
    """Draw rotations (count, 3, 3) from the isotropic Langevin distribution Langevin(I, kappa) on SO(3), exactly.

    The density is proportional to exp(kappa tr R) in the Haar measure; kappa = 0 is uniform. So the axis is uniform,
    and the angle t has a density proportional to exp(2 kappa cos t) (1 - cos t) on [0, pi]. As a unit quaternion (w,
    v), tr R = 3 - 4 |v|^2: a Bingham distribution with density exp(-4 kappa |v|^2). It is sampled by rejection from an
    angular central Gaussian envelope (Kent, Ganeiber, Mardia: A new unified approach for the simulation of a wide class
    of directional distributions, 2018). At least 44 draws in 100 are accepted, at any kappa >= 0.
    """
    generator = np.random.default_rng(seed)
    bingham = np.array([0.0, 4.0 * kappa, 4.0 * kappa, 4.0 * kappa])
    # The envelope with the most acceptances has 1/b + 3/(b + 8 kappa) = 1. The form of its positive root without
    # cancellation is used.
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


def released_rotations(count: int, kappa: float, seed: Seed) -> Array:
    """Rotations (N, 3, 3) of ``released`` noise: a uniform axis, and an angle from von Mises(0, kappa)."""
    generator = np.random.default_rng(seed)
    axes = random_directions(count, generator)
    return rotations_of_vectors(generator.vonmises(0.0, kappa, (count, 1)) * axes)


def released_translations(count: int, sigma_m: float, seed: Seed, section: Section) -> Array:
    """Translations (N, 3) of ``released`` noise, metres, with u uniform on [0,1]^3 and z standard normal.

    Section 8.1 has u sigma z / (u'u). Its lengths sigma |z| / |u| have heavy tails, since |u| comes close to zero.
    Section 8.2 has sigma z u / |u|.
    """
    generator = np.random.default_rng(seed)
    u = generator.random((count, 3))
    z = generator.standard_normal((count, 1))
    length = np.linalg.norm(u, axis=1, keepdims=True)
    translations: Array = sigma_m * z * u / (length**2 if section == "8.1" else length)
    return translations


def perturb(poses: Array, noise: Noise | None, seed: Seed, section: Section | None = None) -> Array:
    """Noisy copies of poses T_a_b (N, 4, 4), metres: R_a_b R_eps, t_a_b + eps. Without noise, a copy.

    `section` is the section of the paper whose rule ``released`` noise has for translations; without one ``released``
    noise is an OptionError.
    """
    noisy: Array = np.array(poses, dtype=np.float64)
    if noise is None:
        return noisy
    generator = np.random.default_rng(seed)
    count = len(noisy)
    if noise.model == "stated":
        rotations = langevin_rotations(count, noise.kappa, generator)
        translations: Array = generator.normal(0.0, noise.sigma_m, (count, 3))
    elif section is not None:
        rotations = released_rotations(count, noise.kappa, generator)
        translations = released_translations(count, noise.sigma_m, generator, section)
    else:
        raise OptionError(
            'Noise: model is "released", but only the simulations of the paper\'s Sections 8.1 and 8.2 '
            '(simulate.sphere, simulate.cameras) have its translations; use model="stated" here'
        )
    noisy[:, :3, :3] = noisy[:, :3, :3] @ rotations
    noisy[:, :3, 3] += translations
    return noisy


class Weights(TypedDict):
    """The arguments of ``Problem.add`` that weigh measurements."""

    sigma: float | None
    kappa: float | None


def weights_of(noise: Noise | None) -> Weights:
    """The weights that belong to the noise; ``None`` for exact measurements."""
    return {"sigma": None, "kappa": None} if noise is None else {"sigma": noise.sigma_m, "kappa": noise.kappa}


def rotations_of_vectors(vectors_rad: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of axis times angle (..., 3), radians."""
    return Rotation.from_rotvec(np.asarray(vectors_rad, dtype=np.float64)).as_matrix()


def rotations_of_quaternions(quaternions_wxyz: Array) -> Array:
    """Rotation matrices (N, 3, 3) of quaternions (N, 4), scalar first, of any length but zero."""
    return Rotation.from_quat(quaternions_wxyz, scalar_first=True).as_matrix()


def random_directions(count: int, generator: Generator) -> Array:
    """Unit vectors (N, 3), uniform on the sphere."""
    directions = generator.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions


def random_poses(count: int, extent_m: float, generator: Generator) -> Array:
    """Poses (N, 4, 4): rotation uniform on SO(3), translation uniform in the cube of half-width extent_m."""
    rotations = rotations_of_quaternions(generator.standard_normal((count, 4)))
    return pose(rotations, generator.uniform(-extent_m, extent_m, (count, 3)))
