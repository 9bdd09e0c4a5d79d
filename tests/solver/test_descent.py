"""The descent never goes up, ends where the gradient is zero, and is quick about it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_problems import GROSS_NOISE, gradient_norm, optimum, part_of, reduced, searched, simulated, true_rotations

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.simulate import Noise, Simulation
from gtsam_rwhec.solver.answers import answer_of
from gtsam_rwhec.solver.descent import cost_of, descend, mirrored, spectral_start, unconstrained_start
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.parts import Part
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


def starts_of(part: Part) -> list[Array]:
    return spectral_start(part, PartForm.of(part).rotation)


def assert_one_is(starts: list[Array], truth: Array, within: float) -> None:
    assert min(float(np.abs(start - truth).max()) for start in starts) < within


def assert_rotations(R: Array) -> None:
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    assert (np.linalg.det(R) > 0.0).all()


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("sides", [(1, 1), (3, 2), (2, 3), (1, 6), (6, 1)])
def test_exact_data_give_the_truth(sides: tuple[int, int], scale: ScaleMode) -> None:
    simulation = simulated(*sides, noise=None, scale=scale)
    (start,) = starts_of(part_of(simulation.problem))
    assert_one_is([start], true_rotations(simulation), 1e-6)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("seed", range(4))
def test_the_unconstrained_minimum_of_exact_data_is_the_truth(seed: int, scale: ScaleMode) -> None:
    simulation = simulated(3, 2, seed, noise=None, scale=scale)
    form = PartForm.of(part_of(simulation.problem)).reduced
    assert_one_is(unconstrained_start(form), true_rotations(simulation), 1e-4)


@pytest.mark.parametrize("seed", range(10))
def test_parts_joined_by_their_scale_alone_have_a_sign_each(seed: int) -> None:
    """Each part's eigenvector is right up to its own sign; a common sign would turn half of them round."""
    simulation = simulated(3, 3, seed, graph=[(0, 0), (1, 1), (2, 2)], scale="shared", noise=None)
    assert_one_is(starts_of(part_of(simulation.problem)), true_rotations(simulation), 1e-6)


def fixed(simulation: Simulation, name: str) -> Simulation:
    simulation.problem.fix(name, (simulation.X | simulation.Y)[name])
    return simulation


@pytest.mark.parametrize("name", ["target0", "sensor0"])
@pytest.mark.parametrize("sides", [(3, 1), (1, 3), (2, 2), (1, 1)])
def test_a_known_frame_anchors_the_start(sides: tuple[int, int], name: str) -> None:
    """Where all centers are known (a star round a known frame) and where some are not."""
    simulation = fixed(simulated(*sides, noise=None), name)
    assert_one_is(starts_of(part_of(simulation.problem)), true_rotations(simulation), 1e-6)


@pytest.mark.parametrize("strength", [1e-3, 1.0, 1e6])
def test_a_prior_gives_both_signs_one_of_them_right(strength: float) -> None:
    simulation = simulated(2, 2, noise=None)
    simulation.problem.add_prior("sensor0", simulation.Y["sensor0"], sigma=0.1, kappa=strength)
    starts = starts_of(part_of(simulation.problem))
    assert len(starts) == 2
    assert_one_is(starts, true_rotations(simulation), 1e-5)


def test_motions_alone() -> None:
    simulation = simulated(0, 1, odometry=6, noise=None)
    assert_one_is(starts_of(part_of(simulation.problem)), true_rotations(simulation), 1e-6)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("seed", range(5))
def test_starts_are_rotations_whatever_the_noise(seed: int, scale: ScaleMode) -> None:
    part = part_of(simulated(3, 2, seed, noise=GROSS_NOISE, number_of_measurements=3, scale=scale).problem)
    forms = PartForm.of(part)
    for start in spectral_start(part, forms.rotation) + unconstrained_start(forms.reduced):
        assert start.shape == (5, 3, 3)
        assert_rotations(start)


@pytest.mark.parametrize(("sides", "odometry"), [((2, 2), 0), ((1, 3), 0), ((0, 1), 6), ((2, 1), 6)])
def test_the_image_costs_the_same_with_the_scales_sign_changed(sides: tuple[int, int], odometry: int) -> None:
    """At any rotations, not only the best: planar A is what counts, whatever B is."""
    problem = simulated(*sides, 1, motion="planar", odometry=odometry, scale="shared").problem
    part, form = part_of(problem), reduced(problem)
    R = random_rotations(len(part.free), np.random.default_rng(0))
    image = mirrored(part, R)
    np.testing.assert_allclose(np.linalg.det(image), 1.0)
    assert cost_of(form, image) == pytest.approx(cost_of(form, R), rel=1e-8)
    assert answer_of(part, form, image).scale == pytest.approx(-answer_of(part, form, R).scale, rel=1e-6)
    np.testing.assert_allclose(mirrored(part, image), R, atol=1e-12)


@pytest.mark.parametrize("scale", ["shared", "per_target"])
@pytest.mark.parametrize("motion", ["planar", "single_axis"])
def test_the_search_returns_the_image_with_positive_scales(motion: str, scale: ScaleMode) -> None:
    """Whichever of the two planar motion's descent ended at; by seed it is the one or the other."""
    mirrored_ones = 0
    for seed in range(12):
        search = searched(simulated(2, 1, seed, motion=motion, scale=scale).problem)
        found = search.with_positive_scale(search.run("auto", None))
        answer = answer_of(search.part, search.form, found.R)
        own = answer.own_scale[np.isfinite(answer.own_scale)]
        assert answer.scale > 0.0
        assert (own > 0.0).all()
        assert found.is_closed
        mirrored_ones += found.path.is_mirrored
    assert (mirrored_ones > 0) == (motion == "planar")


def test_an_answer_with_positive_scales_is_left_alone() -> None:
    simulation = simulated(2, 1, 0, scale="shared")
    search = searched(simulation.problem)
    found = search.run("auto", None)
    assert search.with_positive_scale(found) is found
    np.testing.assert_allclose(found.R, true_rotations(simulation), atol=0.1)
