"""What holds for every method: Table 1's properties, exact data, refusals, the evaluation under one cost."""

from __future__ import annotations

import numpy as np
import pytest
from method_problems import exchanged, four_targets, general_pair, largest_errors, moved_translations, rotations
from naive_cost import naive_cost

import gtsam_rwhec as rw
from gtsam_rwhec.errors import (
    CountError,
    FrameError,
    MeasurementsNotKeptError,
    OptionError,
    PriorError,
    RwhecError,
    ScaleError,
    UnderdeterminedError,
)
from gtsam_rwhec.methods import METHODS, MethodOptions, cost_of_answer, run


@pytest.mark.parametrize("name", METHODS)
def test_exact_data_give_the_truth(name: str) -> None:
    simulation = general_pair(None)
    if METHODS[name].applies(simulation.problem):
        pytest.skip("for other problems")
    metres, radians = largest_errors(simulation, run(name, simulation.problem))
    assert metres < 1e-6
    assert radians < 1e-6


@pytest.mark.parametrize("name", METHODS)
def test_joint_methods_alone_let_translations_move_rotations(name: str) -> None:
    problem = general_pair().problem
    if METHODS[name].applies(problem):
        pytest.skip("for other problems")
    other = moved_translations(problem, np.random.default_rng(1))
    change = np.abs(rotations(run(name, problem)) - rotations(run(name, other))).max()
    assert (change > 1e-5) == METHODS[name].properties.joint


@pytest.mark.parametrize("name", METHODS)
def test_monocular_methods_recover_a_scale_of_a_half(name: str) -> None:
    simulation = general_pair(scale="shared")
    if METHODS[name].properties.monocular and not METHODS[name].applies(simulation.problem):
        assert run(name, simulation.problem).scale == pytest.approx(0.5, rel=0.02)
    else:
        assert METHODS[name].applies(simulation.problem)
        with pytest.raises(RwhecError):
            run(name, simulation.problem)


@pytest.mark.parametrize("name", METHODS)
def test_methods_for_several_frames_give_them_all(name: str) -> None:
    many_X = four_targets(None)
    multiple = METHODS[name].properties.multiple
    for simulation, can in (
        (many_X, multiple in ("Xs", "Xs or Ys", "Xs and Ys")),
        (exchanged(many_X), multiple in ("Xs or Ys", "Xs and Ys")),
    ):
        if can and not METHODS[name].applies(simulation.problem):
            metres, radians = largest_errors(simulation, run(name, simulation.problem))
            assert metres < 1e-5
            assert radians < 1e-5
        else:
            assert METHODS[name].applies(simulation.problem)
            with pytest.raises(RwhecError):
                run(name, simulation.problem)


@pytest.mark.parametrize("name", METHODS)
def test_cost_is_that_of_the_certified_objective_and_never_below_the_optimum(name: str) -> None:
    problem = general_pair().problem
    if METHODS[name].applies(problem):
        pytest.skip("for other problems")
    estimate = run(name, problem)
    X, Y = ({key: pose.matrix() for key, pose in poses.items()} for poses in (estimate.X, estimate.Y))
    assert estimate.cost == pytest.approx(naive_cost(problem, X, Y, estimate.scale), rel=1e-9)
    assert cost_of_answer(problem, X, Y, estimate.scale) == pytest.approx(estimate.cost, rel=1e-12)
    assert estimate.cost >= rw.solve(problem).certificate.lower_bound * (1.0 - 1e-12)
    assert estimate.seconds > 0.0
    assert estimate.residuals["target0", "sensor0"].number_of_measurements == 60


@pytest.mark.parametrize("name", METHODS)
def test_every_method_says_what_it_assumes_and_where_it_is_from(name: str) -> None:
    method = METHODS[name]
    assert method.name == name
    assert method.assumes.endswith(".")
    assert any(character.isdigit() for character in method.source)  # a year


@pytest.mark.parametrize("name", [name for name, method in METHODS.items() if not method.takes_priors])
def test_what_a_method_cannot_hold_is_refused_in_words(name: str) -> None:
    simulation = general_pair()
    raw = simulation.problem.measurements("target0", "sensor0")
    with_prior = rw.Problem()
    with_prior.add("target0", "sensor0", raw.A, raw.B)
    with_prior.fix("sensor0", np.eye(4))
    motions = rw.Problem()
    motions.add_motion("sensor0", raw.A, raw.B)
    few = rw.Problem()
    few.add("target0", "sensor0", raw.A[:2], raw.B[:2])
    moments = rw.Problem(keep_measurements=False)
    moments.add("target0", "sensor0", raw.A, raw.B)
    per_target = rw.Problem("per_target")
    per_target.add("target0", "sensor0", raw.A, raw.B)
    if METHODS[name].applies(simulation.problem):
        pytest.skip("for other problems")
    for problem, error, word in (
        (with_prior, PriorError, "sensor0"),
        (motions, FrameError, "motions"),
        (few, CountError, "at least 3"),
        (moments, MeasurementsNotKeptError, "keep_measurements"),
        (per_target, ScaleError, "per_target"),
        (rw.Problem(), CountError, "empty"),
    ):
        if word == "motions" and METHODS[name].takes_motions:
            continue
        with pytest.raises(error, match=word):
            run(name, problem)
        assert word in METHODS[name].applies(problem)


@pytest.mark.parametrize("name", ["shah2013"])
def test_parallel_axes_are_named(name: str) -> None:
    angles = np.linspace(0.0, 2.0, 12)
    A = np.tile(np.eye(4), (12, 1, 1))
    A[:, 0, 0] = A[:, 1, 1] = np.cos(angles)
    A[:, 1, 0] = np.sin(angles)
    A[:, 0, 1] = -A[:, 1, 0]
    A[:, 0, 3] = np.arange(12)
    for poses in (A, np.tile(np.eye(4), (5, 1, 1))):
        problem = rw.Problem()
        problem.add("target", "sensor", poses, poses)
        with pytest.raises(UnderdeterminedError, match="parallel axes"):
            run(name, problem)


def test_unknown_names_and_options_are_refused() -> None:
    problem = general_pair().problem
    with pytest.raises(OptionError, match="shah2013"):
        run("shah", problem)
    with pytest.raises(OptionError, match="MethodOptions"):
        run("shah2013", problem, {"seed": 1})  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="start"):
        MethodOptions(start=[1, 2, 3])  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="max_iterations"):
        MethodOptions(max_iterations=0)
