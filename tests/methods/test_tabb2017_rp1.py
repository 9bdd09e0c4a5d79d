"""Tabb and Ahmad Yousef's rp1: derivatives by all parameters, one minimum for all of them, the cameras' weights."""

from __future__ import annotations

import dataclasses
from typing import get_args

import numpy as np
import pytest
from corner_problems import seen
from rwhec_factors import se3

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.fitting.observations import Observations, Views
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods import MethodOptions, corner_methods
from gtsam_rwhec.methods import reprojection as methods
from gtsam_rwhec.methods.corner_methods import Corners
from gtsam_rwhec.methods.iterative_methods import CHARTS, Parameterisation

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


def test_exact_corners_give_the_truth_in_all_parameters() -> None:
    observations, X, Y = seen(0.0, 3)
    for parameterisation in EVERY:
        answer = methods.run("tabb2017_rp1", observations, parameterisation=parameterisation)
        assert answer.converged
        for found, truth in ((answer.X, X), (answer.Y, Y)):
            for name, T in truth.items():
                np.testing.assert_allclose(found[name].matrix(), T, atol=1e-7)


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
