"""The noise has the distribution that its name says, on the side that the paper says."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import kstest, norm, vonmises

from gtsam_rwhec.errors import NoiseError, OptionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.simulate import Noise, langevin_rotations, perturb
from gtsam_rwhec.simulate.simulated_noise import Section, random_poses, released_rotations, released_translations

Draw = Callable[[int, float, int], Array]

COUNT = 20_000
# Seeds are fixed, so a test either passes always or never; a tail this small is no chance of the seed.
SMALLEST_P_VALUE = 1e-3


def angles_of(rotations: Array) -> Array:
    skew = rotations - rotations.transpose(0, 2, 1)
    sines = np.linalg.norm(np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]]), axis=0) / 2.0
    return np.arctan2(sines, (np.trace(rotations, axis1=1, axis2=2) - 1.0) / 2.0)


def axes_of(rotations: Array) -> Array:
    skew = rotations - rotations.transpose(0, 2, 1)
    axes = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    return axes / np.linalg.norm(axes, axis=1, keepdims=True)


def langevin_distribution(kappa: float, angles: Array) -> Array:
    """P(angle <= t) of the density exp(2 kappa cos t) (1 - cos t), by integration on a grid."""
    top = min(np.pi, 12.0 / np.sqrt(2.0 * kappa)) if kappa > 0.0 else np.pi
    grid = np.linspace(0.0, top, 200_001)
    density = np.exp(2.0 * kappa * (np.cos(grid) - 1.0)) * (1.0 - np.cos(grid))
    cumulative = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2.0)])
    return np.interp(angles, grid, cumulative / cumulative[-1])


@pytest.mark.parametrize("kappa", [0.0, 1e-3, 0.4, 0.5, 0.6, 3.0, 12.0, 125.0, 1e4])
def test_langevin_angles_follow_their_density(kappa: float) -> None:
    angles = angles_of(langevin_rotations(COUNT, kappa, 1))
    # A variable's distribution function makes it uniform.
    assert kstest(langevin_distribution(kappa, angles), "uniform").pvalue > SMALLEST_P_VALUE


@pytest.mark.parametrize("draw", [langevin_rotations, released_rotations])
def test_rotation_axes_are_uniform(draw: Draw) -> None:
    axes = axes_of(draw(COUNT, 12.0, 4))
    for coordinate in axes.T:
        # Archimedes: each coordinate of a uniform direction is uniform on [-1, 1].
        assert kstest((coordinate + 1.0) / 2.0, "uniform").pvalue > SMALLEST_P_VALUE


def test_released_angles_are_von_mises() -> None:
    angles = angles_of(released_rotations(COUNT, 12.0, 5))
    assert kstest(angles, lambda t: 2.0 * vonmises(12.0).cdf(t) - 1.0).pvalue > SMALLEST_P_VALUE


def test_stated_translations_are_normal() -> None:
    translations = perturb(np.tile(np.eye(4), (COUNT, 1, 1)), Noise(0.05, 12.0), 7)[:, :3, 3]
    assert kstest(translations.ravel(), norm(scale=0.05).cdf).pvalue > SMALLEST_P_VALUE
    assert np.allclose(np.cov(translations.T), 0.05**2 * np.eye(3), atol=1e-4)


@pytest.mark.parametrize("section", ["8.1", "8.2"])
def test_released_translations_lie_along_one_octant(section: Section) -> None:
    translations = released_translations(COUNT, 0.05, 8, section)
    assert np.all((translations >= 0.0).all(axis=1) | (translations <= 0.0).all(axis=1))
    assert abs(np.mean(translations[:, 0] > 0.0) - 0.5) < 4.0 * 0.5 / np.sqrt(COUNT)


def test_released_camera_lengths_are_half_normal() -> None:
    lengths = np.linalg.norm(released_translations(COUNT, 0.05, 9, "8.2"), axis=1)
    assert kstest(lengths / 0.05, lambda x: 2.0 * norm.cdf(x) - 1.0).pvalue > SMALLEST_P_VALUE


def test_released_sphere_lengths_are_longer_than_those_of_the_cameras() -> None:
    # E[1/|u|] over the unit cube against E[1] = 1, everything else being equal.
    def chord(y: float, x: float) -> float:
        # integral of 1/sqrt(r^2 + z^2) over z in [0, 1]
        return float(np.arcsinh(1.0 / max(np.hypot(x, y), 1e-300)))

    expected = quad(lambda x: quad(chord, 0.0, 1.0, args=(x,))[0], 0.0, 1.0)[0]
    lengths = np.linalg.norm(released_translations(COUNT, 1.0, 10, "8.1"), axis=1)
    error = lengths.std() / np.sqrt(COUNT)
    assert abs(lengths.mean() - expected * np.sqrt(2.0 / np.pi)) < 4.0 * error


def test_noise_acts_on_the_right() -> None:
    poses = random_poses(50, 1.0, np.random.default_rng(11))
    noise = Noise(sigma_m=0.01, kappa=125.0)
    noisy = perturb(poses, noise, 12)
    generator = np.random.default_rng(12)
    rotations = langevin_rotations(50, noise.kappa, generator)
    translations = generator.normal(0.0, noise.sigma_m, (50, 3))
    assert np.array_equal(noisy[:, :3, :3], poses[:, :3, :3] @ rotations)
    assert np.array_equal(noisy[:, :3, 3], poses[:, :3, 3] + translations)
    assert np.array_equal(noisy[:, 3], poses[:, 3])


@given(
    seed=st.integers(0, 2**32 - 1),
    sigma_m=st.floats(1e-12, 1e3),
    kappa=st.floats(1e-12, 1e18),
    model=st.sampled_from(["stated", "released"]),
)
@settings(max_examples=50, deadline=None)
def test_noisy_poses_are_poses_and_repeat_with_the_seed(seed: int, sigma_m: float, kappa: float, model: str) -> None:
    poses = random_poses(5, 1.0, np.random.default_rng(seed))
    before = poses.copy()
    noise = Noise(sigma_m, kappa, model)  # type: ignore[arg-type]
    noisy = perturb(poses, noise, seed, "8.2")
    assert np.array_equal(poses, before)
    assert np.array_equal(noisy, perturb(poses, noise, np.random.default_rng(seed), "8.2"))
    rotations = noisy[:, :3, :3]
    assert np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3), atol=1e-13)
    assert np.all(np.linalg.det(rotations) > 0.0)


def test_no_noise_is_a_copy() -> None:
    poses = random_poses(3, 1.0, np.random.default_rng(13))
    noisy = perturb(poses, None, 0)
    assert np.array_equal(noisy, poses)
    assert not np.shares_memory(noisy, poses)


@pytest.mark.parametrize("size", [0.0, -1.0, float("nan"), float("inf")])
def test_sizes_must_be_positive_and_finite(size: float) -> None:
    with pytest.raises(NoiseError, match="sigma_m"):
        Noise(size, 1.0)
    with pytest.raises(NoiseError, match="kappa"):
        Noise(1.0, size)


def test_an_unknown_model_is_refused() -> None:
    with pytest.raises(OptionError, match="'gaussian'"):
        Noise(1.0, 1.0, "gaussian")  # type: ignore[arg-type]


def test_released_noise_needs_one_of_the_papers_rules() -> None:
    with pytest.raises(OptionError, match="stated"):
        perturb(np.eye(4)[None], Noise(0.01, 12.0, "released"), 0)
