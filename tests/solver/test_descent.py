"""The descent never goes up, ends where the gradient is zero, and is quick about it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_problems import GROSS_NOISE, gradient_norm, optimum, reduced, searched, simulated, true_rotations

from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.simulate import Noise
from gtsam_rwhec.solver.descent import cost_of, descend
from gtsam_rwhec.solver.reduced_form import ReducedForm
from gtsam_rwhec.solver.rotations import random_rotations, retract

SCALES: tuple[ScaleMode, ...] = ("known", "shared", "per_target")


def rounding(form: ReducedForm) -> float:
    return 1e-14 * form.magnitude


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("motion", ["general", "planar", "single_axis", "none"])
def test_random_starts_never_go_up_step_by_step(motion: str, scale: ScaleMode) -> None:
    """Stopped after every number of steps: the costs only fall, but for rounding."""
    form = reduced(simulated(2, 2, 3, motion=motion, scale=scale).problem)
    generator = np.random.default_rng(0)
    for _ in range(5):
        start = random_rotations(4, generator)
        costs = [cost_of(form, start)] + [descend(form, start, steps).cost for steps in range(1, 15)]
        assert (np.diff(costs) <= rounding(form)).all()


@given(
    seed=st.integers(0, 10**6),
    targets=st.integers(1, 3),
    sensors=st.integers(1, 3),
    scale=st.sampled_from(SCALES),
    sigma=st.floats(-4.0, 0.5),
    kappa=st.floats(-0.5, 6.0),
)
@settings(max_examples=60, deadline=None)
def test_any_start_of_any_problem_ends_lower_at_a_critical_point(
    seed: int, targets: int, sensors: int, scale: ScaleMode, sigma: float, kappa: float
) -> None:
    noise = Noise(10.0**sigma, 10.0**kappa)
    form = reduced(simulated(targets, sensors, seed, noise=noise, scale=scale, number_of_measurements=6).problem)
    start = random_rotations(targets + sensors, np.random.default_rng(seed))
    end = descend(form, start, 500)
    assert end.cost <= cost_of(form, start) + rounding(form)
    assert end.cost == pytest.approx(cost_of(form, end.R), abs=rounding(form))
    assert end.converged
    assert gradient_norm(form, end.R) < 1e-11
    np.testing.assert_allclose(end.R @ end.R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), end.R.shape), atol=1e-13)


@pytest.mark.parametrize("scale", SCALES)
def test_a_start_near_the_optimum_converges_quadratically(scale: ScaleMode) -> None:
    problem = simulated(3, 2, 1, scale=scale).problem
    form, best = reduced(problem), optimum(problem)
    w = 1e-3 * np.random.default_rng(0).standard_normal((5, 3))
    end = descend(form, retract(best.R, w), 200)
    assert end.iterations <= 5
    assert end.cost == pytest.approx(best.cost, abs=rounding(form))


@pytest.mark.parametrize("scale", SCALES)
def test_exact_data_end_at_the_truth(scale: ScaleMode) -> None:
    simulation = simulated(3, 2, 2, noise=None, scale=scale)
    form = reduced(simulation.problem)
    truth = true_rotations(simulation)
    w = 0.1 * np.random.default_rng(1).standard_normal((5, 3))
    end = descend(form, retract(truth, w), 200)
    np.testing.assert_allclose(end.R, truth, atol=1e-9)
    assert end.cost < 1e-12 * form.magnitude


def test_it_stops_when_told_and_says_so() -> None:
    form = reduced(simulated(2, 2, 0, noise=GROSS_NOISE).problem)
    start = random_rotations(4, np.random.default_rng(2))
    stopped = descend(form, start, 1)
    assert not stopped.converged
    assert stopped.iterations == 1
    assert descend(form, start, 200).converged


def test_a_maximum_is_left() -> None:
    """The Hessian there is negative definite: Newton's own step would go up."""
    form = reduced(simulated(1, 1, 0).problem)
    generator = np.random.default_rng(3)
    top = max((random_rotations(2, generator) for _ in range(300)), key=lambda R: cost_of(form, R))
    end = descend(form, top, 200)
    assert end.converged
    assert end.cost < 1e-2 * cost_of(form, top)


def test_the_search_takes_the_lowest_of_its_starts() -> None:
    search = searched(simulated(1, 1, 2, noise=GROSS_NOISE, number_of_measurements=4).problem)
    found = search.run("auto", None)
    generator = np.random.default_rng(4)
    ends = [descend(search.form, random_rotations(2, generator), 200).cost for _ in range(100)]
    assert found.cost <= min(ends) + rounding(search.form)
    assert max(ends) > found.cost + 1e-3  # there are other valleys
