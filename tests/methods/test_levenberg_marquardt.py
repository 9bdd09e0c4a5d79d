"""Levenberg and Marquardt's method: a curved valley, a chart with a free parameter, a start beyond which nothing is."""

from __future__ import annotations

import numpy as np
import pytest

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods.levenberg_marquardt import Linearised, descend, descend_on_chart


def rosenbrock(p: Array) -> Linearised:
    residual = np.array([10.0 * (p[1] - p[0] ** 2), 1.0 - p[0]])
    J = np.array([[-20.0 * p[0], 10.0], [-1.0, 0.0]])
    return Linearised(0.5 * float(residual @ residual), J.T @ residual, J.T @ J)


def test_a_curved_valley_is_followed_to_its_end() -> None:
    found = descend(rosenbrock, lambda p, step: p + step, np.array([-1.2, 1.0]), 100)
    assert found.converged
    assert found.iterations < 40
    np.testing.assert_allclose(found.point, [1.0, 1.0], atol=1e-9)


def test_the_step_limit_is_kept_and_told() -> None:
    found = descend(rosenbrock, lambda p, step: p + step, np.array([-1.2, 1.0]), 3)
    assert not found.converged
    assert found.iterations == 3
    assert found.cost < rosenbrock(np.array([-1.2, 1.0])).cost


def test_steps_to_an_infinite_cost_are_not_taken() -> None:
    def half_line(p: Array) -> Linearised:
        here = float(np.log(p[0])) if p[0] > 0.0 else np.inf
        return Linearised(0.5 * here**2, np.array([here / p[0]]), np.array([[1.0 / p[0] ** 2]]))

    found = descend(half_line, lambda p, step: p + step, np.array([20.0]), 100)
    np.testing.assert_allclose(found.point, [1.0], atol=1e-9)


def test_a_free_parameter_of_the_chart_does_no_harm() -> None:
    """The direction of p is a point on the circle; its length is free."""
    form = np.array([[2.0, 0.5], [0.5, 1.0]])

    def direction(p: Array) -> tuple[Array, Array]:
        length = np.linalg.norm(p)
        x = p / length
        return x, (np.eye(2) - np.outer(x, x)) / length

    x, _ = direction(descend_on_chart(form, direction, np.array([3.0, 1.0]), 200))
    assert x @ form @ x == pytest.approx(np.linalg.eigvalsh(form)[0], rel=1e-12)
