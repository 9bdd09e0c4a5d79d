"""Levenberg and Marquardt's method: a curved valley, a chart with a free parameter, a start beyond which nothing is."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods.levenberg_marquardt import Linearised, descend


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
