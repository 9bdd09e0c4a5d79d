"""Strobl and Hirzinger 2006: Jacobians, the weights that it finds, the optimum of its cost."""

from __future__ import annotations

import numpy as np
import pytest
from method_problems import largest_errors, one_pair
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.methods import MethodOptions, run
from gtsam_rwhec.methods.absolute import Stack
from gtsam_rwhec.methods.strobl2006 import METHOD, errors, jacobian, reweighed
from gtsam_rwhec.simulate import Noise
from gtsam_rwhec.solver.rotations import random_rotations, retract


@pytest.mark.parametrize("size", [1.0, 1e-4])
def test_jacobians_are_the_derivatives(size: float) -> None:
    generator = np.random.default_rng(0)
    stack = Stack.of(one_pair(Noise(0.05 * size, 12.0 / size**2)).problem)
    R = random_rotations(2, generator)
    if size < 1.0:  # near the truth the errors are small
        simulation = one_pair()
        R = np.stack([simulation.X["camera"][:3, :3], simulation.Y["marker"][:3, :3]])
    t = generator.standard_normal((2, 3))
    e_R, _ = errors(stack.A, stack.B, R, t)
    away = np.linalg.norm(e_R, axis=1) < 3.0  # the logarithm jumps at pi
    J_R, J_t = jacobian(stack.A, stack.B, R, e_R)
    for k in range(12):
        step = np.zeros(12)
        step[k] = 1e-6
        ahead = errors(stack.A, stack.B, retract(R, step[:6].reshape(2, 3)), t + step[6:].reshape(2, 3))
        behind = errors(stack.A, stack.B, retract(R, -step[:6].reshape(2, 3)), t - step[6:].reshape(2, 3))
        numeric_R, numeric_t = ((x - y) / 2e-6 for x, y in zip(ahead, behind, strict=True))
        analytic_R = J_R[:, :, k] if k < 6 else np.zeros_like(e_R)
        np.testing.assert_allclose(analytic_R[away], numeric_R[away], atol=1e-7)
        np.testing.assert_allclose(J_t[:, :, k], numeric_t, atol=1e-7)


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
        R, t = np.stack([X[:3, :3], Y[:3, :3]]), np.stack([X[:3, 3], Y[:3, 3]])
        e_R, e_t = errors(stack.A, stack.B, R, t)
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
    assert run("strobl2006", simulation.problem).starts_from == "shah2013"
    assert "deg" in found.notes[0]
    assert largest_errors(simulation, found)[0] < 0.05
    assert METHOD.properties.joint
    assert METHOD.properties.probabilistic
