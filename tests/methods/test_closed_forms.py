"""Closed forms: their own equations, their relations to one another, what exact data they cannot solve."""

from __future__ import annotations

import numpy as np
import pytest
from counted_calls import counted_calls
from method_problems import exchanged, four_targets, general_pair, one_pair

import gtsam_rwhec as rw
from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.methods import METHODS, MethodOptions, refusal, run
from gtsam_rwhec.methods.linear_systems import Stack, linear_translations
from gtsam_rwhec.simulate import Noise

CLOSED = ("zhuang1994", "dornaika1998_closed", "li2010_kronecker", "li2010_dq", "shah2013", "wang2022")


@pytest.mark.parametrize("seed", range(3))
def test_shah_and_wang_are_one_for_one_pair(seed: int) -> None:
    problem = one_pair(seed=seed).problem
    shah, wang = run("shah2013", problem), run("wang2022", problem)
    for name in ("camera", "marker"):
        pose = (shah.X | shah.Y)[name]
        np.testing.assert_allclose((wang.X | wang.Y)[name].matrix(), pose.matrix(), atol=1e-12)


@pytest.mark.parametrize("unknown_scale", [False, True])
def test_linear_translations_are_those_of_least_squares(unknown_scale: bool) -> None:
    simulation = four_targets(Noise(0.05, 12.0, "released"))
    stack = Stack.of(simulation.problem)
    R = np.array([T[:3, :3] for poses in (simulation.X, simulation.Y) for T in poses.values()])
    rows, right = np.zeros((len(stack.A), 3, 16)), np.empty((len(stack.A), 3))
    for i, (A, B) in enumerate(zip(stack.A, stack.B, strict=True)):
        j, k = stack.target[i], stack.sensor[i]
        rows[i, :, 3 * j : 3 * j + 3] = A[:3, :3]
        rows[i, :, 3 * k : 3 * k + 3] = -np.eye(3)
        rows[i, :, 15] = A[:3, 3]
        right[i] = R[k] @ B[:3, 3]
    if unknown_scale:
        x = np.linalg.lstsq(rows.reshape(-1, 16), right.ravel())[0]
    else:
        x = np.append(np.linalg.lstsq(rows[..., :15].reshape(-1, 15), (right - rows[..., 15]).ravel())[0], 1.0)
    t, alpha = linear_translations(stack, R, unknown_scale=unknown_scale)
    np.testing.assert_allclose(t.ravel(), x[:15] / x[15], atol=1e-10)
    assert alpha == pytest.approx(x[15], rel=1e-12)


@pytest.mark.parametrize("name", CLOSED)
def test_answers_do_not_depend_on_which_side_is_which(name: str) -> None:
    """A X = Y B, or A^-1 Y = X B^-1: the rotations' systems of most are the same."""
    simulation = general_pair(Noise(0.001, 1e5))
    here, there = run(name, simulation.problem), run(name, exchanged(simulation).problem)
    noise_m, noise_rad = 0.002, 0.01
    assert np.abs(here.X["target0"].matrix() - there.Y["target0"].matrix()).max() < max(noise_m, noise_rad)
    if name in ("dornaika1998_closed", "shah2013", "wang2022"):
        np.testing.assert_allclose(here.X["target0"].matrix()[:3, :3], there.Y["target0"].matrix()[:3, :3], atol=1e-12)


#: The cost of li2010_dq is about the origin.
@pytest.mark.parametrize("name", [*(name for name in CLOSED if name != "li2010_dq"), "dornaika1998", "lom"])
def test_a_world_origin_far_away_takes_no_more_than_its_digits(name: str) -> None:
    simulation = general_pair()
    raw = simulation.problem.measurements("target0", "sensor0")
    away = np.array([4e4, -3e4, 5e4])
    A = raw.A.copy()
    A[:, :3, 3] += away
    far = rw.Problem()
    far.add("target0", "sensor0", A, raw.B, raw.sigma, raw.kappa)
    here, there = run(name, simulation.problem), run(name, far)
    assert there.cost == pytest.approx(here.cost, rel=1e-6)
    np.testing.assert_allclose(there.Y["sensor0"].translation() - away, here.Y["sensor0"].translation(), atol=1e-6)


@pytest.mark.parametrize("name", CLOSED)
def test_no_loop_over_measurements(name: str) -> None:
    """Hardly more calls of functions for 30,000 measurements than for 60: large arrays go through in blocks."""
    simulation = general_pair()
    raw = simulation.problem.measurements("target0", "sensor0")
    many = rw.Problem()
    many.add("target0", "sensor0", np.tile(raw.A, (500, 1, 1)), np.tile(raw.B, (500, 1, 1)), 0.01, 1250.0)
    run(name, simulation.problem)  # what is made once is made here
    once, calls_once = counted_calls(lambda: run(name, simulation.problem))
    estimate, calls = counted_calls(lambda: run(name, many))
    assert calls - calls_once < 3_000  # one call for each measurement would be 30,000
    np.testing.assert_allclose(estimate.X["target0"].matrix(), once.X["target0"].matrix(), atol=1e-8)


def test_zhuang_tells_that_it_divides_by_a_half_turn() -> None:
    with pytest.raises(UnderdeterminedError, match="half turn"):
        run("zhuang1994", one_pair(None).problem)
    noisy = run("zhuang1994", one_pair().problem)
    assert "half turn" in noisy.notes[0]
    assert not run("zhuang1994", general_pair().problem).notes


def test_lis_24_entries_are_singular_where_the_target_stays_in_its_place() -> None:
    with pytest.raises(UnderdeterminedError, match="same place"):
        run("li2010_kronecker", one_pair(None).problem)


def test_dornaikas_nonlinear_minimum_takes_its_start_and_is_below_the_closed_forms_by_its_own_cost() -> None:
    simulation = one_pair(Noise(0.01, 12.0, "released"))
    raw = simulation.problem.measurements("camera", "marker")

    def own_cost(name: str, options: MethodOptions | None = None) -> float:
        found = run(name, simulation.problem, options)
        left, right = raw.A @ found.X["camera"].matrix(), found.Y["marker"].matrix() @ raw.B
        return float(((left - right) ** 2).sum())

    best = own_cost("dornaika1998")
    assert all(
        best <= own_cost(name) * (1.0 + 1e-6) for name in METHODS if refusal(METHODS[name], simulation.problem) is None
    )
    truth = MethodOptions(start=(dict(simulation.X), dict(simulation.Y), 1.0))
    assert own_cost("dornaika1998", truth) == pytest.approx(best, rel=1e-9)
    assert run("dornaika1998", simulation.problem, truth).starts_from == "the given start"
