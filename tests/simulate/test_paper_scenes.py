"""Sections 8.1 and 8.2: geometry, roles, weights and scale are the paper's."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rwhec_factors.se3 import inverse

from gtsam_rwhec import solve
from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.simulate import Noise, Simulation, cameras, sphere
from gtsam_rwhec.simulate.paper_scenes import (
    CAMERA_POSITIONS_IN_I_M,
    T_BASE_I,
    fixed_camera_poses,
    hand_trajectory,
    sphere_trajectory,
)


def largest_residual(simulation: Simulation) -> float:
    """Largest entry of A X - Y B over all measurements, B's translations divided by the true scale."""
    assert isinstance(simulation.scale, float)
    largest = 0.0
    for target, sensor in simulation.problem.pairs:
        measured = simulation.problem.measurements(target, sensor)
        B = measured.B.copy()
        B[:, :3, 3] /= simulation.scale
        residual = measured.A @ simulation.X[target] - simulation.Y[sensor] @ B
        largest = max(largest, float(np.abs(residual).max()))
    return largest


@pytest.mark.parametrize("monocular", [False, True])
def test_without_noise_the_truth_fits(monocular: bool) -> None:
    for simulation in (sphere(None, 1, monocular=monocular), cameras(None, 1, monocular=monocular)):
        assert largest_residual(simulation) < 1e-14
        assert simulation.problem.is_relative
        assert simulation.problem.scale == ("shared" if monocular else "known")
        assert simulation.scale == (0.5 if monocular else 1.0)


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 120))
@settings(max_examples=30, deadline=None)
def test_the_camera_looks_at_the_marker_from_the_sphere(seed: int, count: int) -> None:
    radii_m = np.linspace(0.3, 1.0, count)
    T_marker_camera = sphere_trajectory(radii_m, seed)
    positions = T_marker_camera[:, :3, 3]
    x, y, z = np.moveaxis(T_marker_camera[:, :3, :3], 2, 0)
    assert np.allclose(np.linalg.norm(positions, axis=1), radii_m, atol=1e-14)
    assert np.allclose(positions + radii_m[:, None] * z, 0.0, atol=1e-14)
    assert np.all(y[:, 2] < 0.0)  # towards the south pole ...
    assert np.allclose(x[:, 2], 0.0, atol=1e-15)  # ... along the meridian, so that x is horizontal
    assert np.allclose(np.cross(y, z), x, atol=1e-14)
    polar, azimuth = np.arccos(positions[:, 2] / radii_m), np.arctan2(positions[:, 1], positions[:, 0])
    for angles in (polar, azimuth):
        assert np.all((angles > np.pi / 4.0 - 1e-12) & (angles < 3.0 * np.pi / 4.0 + 1e-12))


def test_the_path_is_a_smooth_cubic_spline_of_one_knot_a_second() -> None:
    positions = sphere_trajectory(np.ones(60), 2)[:, :3, 3]
    polar = np.arccos(positions[:, 2])
    # On the knots a uniform cubic B-spline is (a + 4 b + c)/6, halfway between them (a + 23 b + 23 c + d)/48: the knots
    # that the first say must give the second.
    on_knots, halfway = polar[0::2], polar[1::2]
    count = len(on_knots)
    knots_to_values = np.zeros((2 * count, count + 3))
    for i in range(count):
        knots_to_values[i, i : i + 3] = np.array([1.0, 4.0, 1.0]) / 6.0
        knots_to_values[count + i, i : i + 4] = np.array([1.0, 23.0, 23.0, 1.0]) / 48.0
    values = np.concatenate([on_knots, halfway])
    knots, *_ = np.linalg.lstsq(knots_to_values, values)
    assert np.allclose(knots_to_values @ knots, values, atol=1e-12)
    # Uniform on [pi/4, 3pi/4] at the knots: wider than the spline, and never beyond.
    assert np.all((knots > np.pi / 4.0 - 1e-9) & (knots < 3.0 * np.pi / 4.0 + 1e-9))


def test_one_sphere_or_two() -> None:
    def radii(simulation: Simulation) -> Array:
        B = simulation.problem.measurements("camera", "marker").B
        assert isinstance(simulation.scale, float)
        return np.asarray(np.linalg.norm(B[:, :3, 3], axis=1) / simulation.scale, dtype=np.float64)

    assert np.allclose(radii(sphere(None, 3)), np.ones(100))
    assert np.allclose(radii(sphere(None, 3, monocular=True)), np.repeat([1.0, 0.3], 50))
    assert np.allclose(radii(sphere(None, 3, monocular=True, spheres=1)), np.ones(100))
    assert np.allclose(radii(sphere(None, 3, spheres=2, number_of_measurements=5)), [1.0, 1.0, 1.0, 0.3, 0.3])


def test_the_truth_of_the_sphere() -> None:
    simulation = sphere(None, 4)
    T_hand_camera = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0.1], [0, 0, 0, 1.0]])
    T_base_marker = np.array([[-1.0, 0, 0, 0.5], [0, -1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]])
    assert np.array_equal(simulation.X["camera"], T_hand_camera)
    assert np.array_equal(simulation.Y["marker"], T_base_marker)


def test_cameras_look_at_the_origin_of_i() -> None:
    T_i_camera = inverse(T_BASE_I) @ fixed_camera_poses()
    assert np.allclose(T_i_camera[:, :3, 3], CAMERA_POSITIONS_IN_I_M, atol=1e-15)
    x, y, z = np.moveaxis(T_i_camera[:, :3, :3], 2, 0)
    distances = np.linalg.norm(T_i_camera[:, :3, 3], axis=1, keepdims=True)
    assert np.allclose(T_i_camera[:, :3, 3] + distances * z, 0.0, atol=1e-15)
    assert np.allclose(y[:2], [0.0, 1.0, 0.0])
    assert np.allclose(y[2:], np.array([-1.0, 0.0, -1.0]) / np.sqrt(2.0))
    assert np.allclose(np.cross(x, y), z, atol=1e-15)


def test_the_marker_visits_the_grid_at_four_orientations() -> None:
    T_i_marker = inverse(T_BASE_I) @ hand_trajectory()
    assert T_i_marker.shape == (108, 4, 4)
    R, t = T_i_marker[:, :3, :3].reshape(4, 27, 3, 3), T_i_marker[:, :3, 3].reshape(4, 27, 3)
    assert np.allclose(R @ R.transpose(0, 1, 3, 2), np.eye(3), atol=1e-14)
    assert np.all(np.linalg.det(R) > 0.0)
    assert np.allclose(t, t[0], atol=1e-15)
    assert len(np.unique(np.round(t[0], 6), axis=0)) == 27
    assert set(np.unique(np.round(t, 6))) == {-0.6, 0.0, 0.6}
    line = np.array([9.0, 20.0, 2.0])
    for k, point in enumerate(np.array([[-10, -10, 0], [-7, -10 / 3, 2 / 3], [-4, 10 / 3, 4 / 3], [-1, 10, 2]])):
        z = R[k, :, :, 2]
        assert np.allclose(np.cross(point - t[k], z), 0.0, atol=1e-13)
        assert np.all(np.sum((point - t[k]) * z, axis=1) > 0.0)
        # Turned back by 2 pi k/3, y is orthogonal to z and to the line.
        c, s = np.cos(2.0 * np.pi * k / 3.0), np.sin(2.0 * np.pi * k / 3.0)
        y = s * R[k, :, :, 0] + c * R[k, :, :, 1]
        assert np.allclose(y @ line, 0.0, atol=1e-12)
        assert np.all(np.sum(np.cross(z, line) * y, axis=1) > 0.0)


@pytest.mark.parametrize("model", ["stated", "released"])
def test_noise_is_on_B_and_its_size_is_the_weight(model: str) -> None:
    noise = Noise(0.05, 12.0, model)  # type: ignore[arg-type]
    for simulate in (sphere, cameras):
        exact, noisy = simulate(None, 6).problem, simulate(noise, 6).problem
        assert not noisy.is_relative
        for pair in noisy.pairs:
            was, now = exact.measurements(*pair), noisy.measurements(*pair)
            assert np.array_equal(was.A, now.A)
            assert np.all(np.abs(was.B - now.B)[:, :3].max(axis=(1, 2)) > 0.0)
            assert np.all(now.sigma == 0.05)
            assert np.all(now.kappa == 12.0)


def test_the_monocular_scale_comes_after_the_noise() -> None:
    noise = Noise(0.05, 12.0, "released")
    known = cameras(noise, 7).problem.measurements("camera2", "marker")
    monocular = cameras(noise, 7, monocular=True).problem.measurements("camera2", "marker")
    assert np.array_equal(monocular.B[:, :3, 3], 0.5 * known.B[:, :3, 3])
    assert np.array_equal(monocular.B[:, :3, :3], known.B[:, :3, :3])
    assert np.all(monocular.sigma == 0.05)


@pytest.mark.parametrize(
    ("simulate", "monocular", "translation_mm", "rotation_deg"),
    [
        # Tables 2-5, kappa = 125, sigma = 5 cm: (mean, standard deviation) of t_x and r_x in rows "Ours".
        (sphere, False, (28.4, 13.0), (1.42, 0.63)),
        (sphere, True, (23.8, 11.3), (1.11, 0.53)),
        (cameras, False, (4.56, 1.96), (0.459, 0.191)),
        (cameras, True, (5.21, 2.18), (0.454, 0.194)),
    ],
)
def test_released_noise_gives_the_errors_of_the_tables(
    simulate: Callable[..., Simulation],
    monocular: bool,
    translation_mm: tuple[float, float],
    rotation_deg: tuple[float, float],
) -> None:
    # A glance at what examples/papers/tables_2_to_5.py does with 16 experiments and 1,000 runs. Means over the cameras
    # of a run, so that their standard errors (of 40 runs, and of the paper's 100) are at most these.
    runs = 40
    errors = []
    for seed in range(runs):
        simulation = simulate(Noise(0.05, 125.0, "released"), seed, monocular=monocular)
        of_cameras = simulation.errors(solve(simulation.problem)).X.values()
        errors.append(np.mean([(e.translation_mm, e.rotation_deg) for e in of_cameras], axis=0))
    for ours, (mean, std) in zip(np.mean(errors, axis=0), (translation_mm, rotation_deg), strict=True):
        assert abs(ours - mean) < 4.0 * std * np.sqrt(1.0 / 100.0 + 1.0 / runs)


def test_seeds_repeat_and_differ() -> None:
    noise = Noise(0.01, 125.0)

    def measured(seed: int | np.random.Generator) -> Array:
        B = sphere(noise, seed).problem.measurements("camera", "marker").B
        return np.asarray(B, dtype=np.float64)

    assert np.array_equal(measured(8), measured(8))
    assert np.array_equal(measured(8), measured(np.random.default_rng(8)))
    assert not np.array_equal(measured(8), measured(9))
    generator = np.random.default_rng(8)
    assert not np.array_equal(measured(generator), measured(generator))


def test_bad_options_are_refused() -> None:
    with pytest.raises(OptionError, match="spheres is 3"):
        sphere(None, 0, spheres=3)
    with pytest.raises(OptionError, match="number_of_measurements is 0"):
        sphere(None, 0, number_of_measurements=0)
