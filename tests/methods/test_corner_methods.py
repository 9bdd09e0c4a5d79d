"""Evangelista's graph of poses: its derivatives, exact data, what the robot's deviations are for."""

from __future__ import annotations

import dataclasses
from typing import get_args

import numpy as np
import pytest
from corner_problems import seen
from rwhec_factors import se3

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.fitting.fit_options import CarrierNoise
from gtsam_rwhec.fitting.observations import Observations, Views
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods import MethodOptions, corner_methods
from gtsam_rwhec.methods import reprojection as methods
from gtsam_rwhec.methods.corner_methods import Corners
from gtsam_rwhec.methods.iterative_methods import CHARTS, Parameterisation
from gtsam_rwhec.simulate.simulation import frame_distance


def with_noisy_robot(observations: Observations, generator: np.random.Generator, deviations: Array) -> Observations:
    views = {
        pair: (view.A @ se3.expmap(generator.standard_normal((len(view.A), 6)) * deviations), view.pixels)
        for pair, view in observations.views.items()
    }
    return Observations.of(observations.cameras, observations.corners, views, observations.corner_px)


def test_the_gradient_is_the_derivative_and_the_step_is_newtons() -> None:
    observations, X, Y = seen(0.3, 0, images=3)
    corners, generator = Corners.of(observations), np.random.default_rng(1)
    frames = np.array([*X.values(), *Y.values()]) @ se3.expmap(1e-2 * generator.standard_normal((4, 6)))
    pairs = [(stack, *corners.frames_of(stack)) for stack in corners.stacks]
    B = np.concatenate([se3.inverse(frames[j]) @ corners.A[stack.instant] @ frames[i] for stack, i, j in pairs])
    graph = corner_methods.Graph(frames, B @ se3.expmap(1e-3 * generator.standard_normal((len(B), 6))))
    deviations = (1e-3, 5e-4)

    def cost(step: Array) -> float:
        moves = se3.expmap(step.reshape(-1, 6))
        there = corner_methods.Graph(graph.frames @ moves[:4], graph.B @ moves[4:])
        return corner_methods.graph_model(corners, there, deviations).cost

    here = corner_methods.graph_model(corners, graph, deviations)
    assert isinstance(here, corner_methods.Bordered)
    gradient = np.concatenate([here.g, here.g_B.ravel()])
    for k in (*range(24), 24, 31, 50):
        step = np.zeros(len(gradient))
        step[k] = 1e-6
        numeric = (cost(step) - cost(-step)) / 2e-6
        assert gradient[k] == pytest.approx(numeric, rel=1e-5, abs=1e-4 * np.abs(gradient).max())
    H = np.zeros((len(gradient), len(gradient)))
    H[:24, :24] = here.H
    for v, (block, border) in enumerate(zip(here.by_B, here.C, strict=True)):
        at = slice(24 + 6 * v, 30 + 6 * v)
        H[at, at], H[at, :24], H[:24, at] = block, border, border.T
    damped = H + 0.1 * np.diag(np.diagonal(H))
    np.testing.assert_allclose(damped @ here.step(0.1), -gradient, rtol=1e-6, atol=1e-8 * np.abs(gradient).max())


def test_deviations_that_the_robot_has_are_better_than_the_identity() -> None:
    deviations = np.repeat([1e-3, 5e-4], 3)
    stated, identity = [], []
    for seed in range(3):
        observations, _, Y = seen(0.5, 20 + seed, images=8)
        noisy = with_noisy_robot(observations, np.random.default_rng(seed), deviations)
        for carrier, errors in ((CarrierNoise(rotation_rad=1e-3, translation_m=5e-4), stated), (None, identity)):
            answer = methods.run("evangelista2023", noisy, carrier=carrier)
            errors.append(frame_distance(answer.Y["left"].matrix(), Y["left"]).translation_m)
    assert np.mean(stated) < np.mean(identity)


def test_a_noise_that_the_graph_does_not_have_is_refused_in_words() -> None:
    observations, X, Y = seen(0.0, 6, images=5)
    with pytest.raises(OptionError, match="about the target carrier"):
        methods.run(
            "evangelista2023",
            observations,
            MethodOptions(start=(X, Y, 1.0)),
            carrier=CarrierNoise(rotation_rad=1e-3, translation_m=1e-3, about="sensorcarrier"),
        )


EVERY: tuple[Parameterisation, ...] = get_args(Parameterisation)


def without_images(observations: Observations, sensor: str, images: int) -> Observations:
    """The camera's first images of each target alone."""
    views = {
        (target, name): Views(view.A[:images], view.pixels[:images]) if name == sensor else view
        for (target, name), view in observations.views.items()
    }
    return dataclasses.replace(observations, views=views)


@pytest.mark.parametrize("parameterisation", EVERY)
def test_gradient_and_hessian_are_the_derivatives(parameterisation: Parameterisation) -> None:
    observations, X, Y = seen(0.0, 0, images=4)
    corners = Corners.of(without_images(observations, "right", 2))
    weights = corner_methods.weights_of(corners)
    generator = np.random.default_rng(1)

    def parameters(frames: Array) -> Array:
        return np.concatenate([CHARTS[parameterisation][0](frames[:, :3, :3]), frames[:, :3, 3]], axis=1)

    def cost(p: Array) -> float:
        return corner_methods.rp1_model(corners, weights, p, parameterisation).cost

    truth = np.array([*X.values(), *Y.values()])
    p = parameters(truth @ se3.expmap(1e-2 * generator.standard_normal((4, 6))))
    here = corner_methods.rp1_model(corners, weights, p, parameterisation)
    for k in range(p.size):
        step = np.zeros(p.size)
        step[k] = 1e-6
        numeric = (cost(p + step.reshape(p.shape)) - cost(p - step.reshape(p.shape))) / 2e-6
        assert here.g[k] == pytest.approx(numeric, rel=1e-5, abs=1e-6 * np.abs(here.g).max())
    # Gauss-Newton's Hessian is the whole one where the errors vanish
    p, direction, size = parameters(truth), generator.standard_normal(p.size), 1e-5
    step = size * direction.reshape(p.shape)
    bend = (cost(p + step) + cost(p - step) - 2.0 * cost(p)) / size**2
    H = corner_methods.rp1_model(corners, weights, p, parameterisation).H
    assert direction @ H @ direction == pytest.approx(bend, rel=1e-4)


@pytest.mark.parametrize(
    ("name", "options"), [("evangelista2023", {}), *(("tabb2017_rp1", {"parameterisation": each}) for each in EVERY)]
)
def test_exact_corners_give_the_truth(name: str, options: dict[str, Parameterisation]) -> None:
    observations, X, Y = seen(0.0, 3)
    answer = methods.run(name, observations, **options)  # type: ignore[arg-type]
    assert answer.converged
    assert answer.rms_px < 1e-5
    for frame, T in (X | Y).items():
        np.testing.assert_allclose((answer.X | answer.Y)[frame].matrix(), T, atol=1e-6 if not options else 1e-7)
    assert "images' poses" in answer.starts_from


def test_the_cost_is_chi_square_and_one_minimum_for_all_parameters() -> None:
    observations, _, _ = seen(0.3, 4)
    answers = [methods.run("tabb2017_rp1", observations, parameterisation=each) for each in EVERY]
    count = 2 * Corners.of(observations).number
    for answer in answers:
        assert answer.cost == pytest.approx(answers[0].cost, rel=1e-9)
        assert answer.cost == pytest.approx(answer.reprojection_cost, rel=1e-12)  # as many images of each camera
        assert answer.rms_px == pytest.approx(0.3 * np.sqrt(2.0), rel=0.1)
    assert 2.0 * answers[0].cost == pytest.approx(count - 24, abs=5.0 * np.sqrt(2.0 * count))
    again = methods.run("tabb2017_rp1", observations, MethodOptions(start=(answers[0].X, answers[0].Y, 1.0)))
    assert again.iterations <= 3
    assert again.cost == pytest.approx(answers[0].cost, rel=1e-9)


def test_a_camera_with_fewer_images_weighs_as_much_in_all() -> None:
    observations, _, _ = seen(0.3, 5)
    fewer = without_images(observations, "right", 6)
    assert corner_methods.weights_of(Corners.of(fewer)) == {"left": 0.5, "right": 1.0}
    answer = methods.run("tabb2017_rp1", fewer)
    assert answer.cost < answer.reprojection_cost


def test_an_unknown_parameterisation_is_refused_in_words() -> None:
    observations, _, _ = seen(0.0, 6, images=5)
    with pytest.raises(OptionError, match="'matrix' is not one of 'euler'"):
        methods.run("tabb2017_rp1", observations, parameterisation="matrix")  # type: ignore[arg-type]
