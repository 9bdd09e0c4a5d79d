"""Strobl and Hirzinger 2006: the weights that it finds, the optimum of its cost."""

from __future__ import annotations

import numpy as np
import pytest
from method_problems import largest_errors, one_pair
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.methods import MethodOptions, run
from gtsam_rwhec.methods.iterative_methods import STROBL, errors, reweighed
from gtsam_rwhec.methods.linear_systems import Stack
from gtsam_rwhec.simulate import Noise


def test_the_errors_sizes_are_found() -> None:
    noise = Noise(0.02, 200.0)  # stated: Gaussian, 1/sqrt(2 kappa) rad an axis
    simulation = one_pair(noise)
    found = reweighed(Stack.of(simulation.problem), simulation.X["camera"], simulation.Y["marker"], 100)
    assert found.settled
    assert found.sigma_R == pytest.approx(0.05, rel=0.15)
    # noise of B's rotation acts on no translation of R_A t_X + t_A - R_Y t_B - t_Y
    assert found.sigma_t == pytest.approx(0.02, rel=0.15)


def test_the_answer_is_a_fixed_point_and_a_minimum() -> None:
    simulation = one_pair(Noise(0.02, 50.0), seed=3)
    stack = Stack.of(simulation.problem)
    found = reweighed(stack, simulation.X["camera"], simulation.Y["marker"], 100)
    from_elsewhere = run("strobl2006", simulation.problem)
    np.testing.assert_allclose(from_elsewhere.X["camera"].matrix(), found.X, atol=1e-5)
    np.testing.assert_allclose(from_elsewhere.Y["marker"].matrix(), found.Y, atol=1e-5)

    def cost(X: np.ndarray, Y: np.ndarray) -> float:
        e_R, e_t = errors(stack.A, stack.B, X, Y)
        return float((e_R**2).sum() / found.sigma_R**2 + (e_t**2).sum() / found.sigma_t**2)

    generator = np.random.default_rng(1)
    least = cost(found.X, found.Y)
    for _ in range(20):
        moved = np.stack([found.X, found.Y]) @ se3.expmap(1e-3 * generator.standard_normal((2, 6)))
        assert cost(*moved) > least


def test_weights_given_with_the_problem_are_not_used() -> None:
    simulation = one_pair(seed=2)
    other = one_pair(seed=2)
    raw = other.problem.measurements("camera", "marker")
    weighed = rw.Problem()
    weighed.add("camera", "marker", raw.A, raw.B, 3.0, 0.5)
    ours, theirs = run("strobl2006", simulation.problem), run("strobl2006", weighed)
    np.testing.assert_allclose(ours.X["camera"].matrix(), theirs.X["camera"].matrix(), atol=1e-12)


def test_a_given_start_is_taken_and_named() -> None:
    simulation = one_pair()
    start = (simulation.X, simulation.Y, 1.0)
    found = run("strobl2006", simulation.problem, MethodOptions(start=start))
    assert found.starts_from == "the given start"
    assert run("strobl2006", simulation.problem).starts_from == "wang2022"
    assert "deg" in found.notes[0]
    assert largest_errors(simulation, found)[0] < 0.05
    assert STROBL.properties.joint
    assert STROBL.properties.probabilistic
