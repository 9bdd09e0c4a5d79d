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
from gtsam_rwhec.methods import METHODS, MethodOptions, Takes, cost_of_answer, refusal, run
from gtsam_rwhec.simulate import Noise, general

#: All but those that need images.
FOR_A_PAIR = [name for name, method in METHODS.items() if refusal(method, general_pair(None).problem) is None]


@pytest.mark.parametrize("name", FOR_A_PAIR)
def test_exact_data_give_the_truth(name: str) -> None:
    simulation = general_pair(None)
    metres, radians = largest_errors(simulation, run(name, simulation.problem))
    assert metres < 1e-6
    assert radians < 1e-6


@pytest.mark.parametrize("name", FOR_A_PAIR)
def test_joint_methods_alone_let_translations_move_rotations(name: str) -> None:
    problem = general_pair().problem
    other = moved_translations(problem, np.random.default_rng(1))
    change = np.abs(rotations(run(name, problem)) - rotations(run(name, other))).max()
    assert (change > 1e-5) == METHODS[name].properties.joint


@pytest.mark.parametrize("name", METHODS)
def test_monocular_methods_recover_a_scale_of_a_half(name: str) -> None:
    simulation = general_pair(scale="shared")
    if METHODS[name].properties.monocular and refusal(METHODS[name], simulation.problem) is None:
        assert run(name, simulation.problem).scale == pytest.approx(0.5, rel=0.02)
    else:
        assert refusal(METHODS[name], simulation.problem) is not None
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
        if can and refusal(METHODS[name], simulation.problem) is None:
            metres, radians = largest_errors(simulation, run(name, simulation.problem))
            assert metres < 1e-5
            assert radians < 1e-5
        else:
            assert refusal(METHODS[name], simulation.problem) is not None
            with pytest.raises(RwhecError):
                run(name, simulation.problem)


@pytest.mark.parametrize("name", FOR_A_PAIR)
def test_cost_is_that_of_the_certified_objective_and_never_below_the_optimum(name: str) -> None:
    problem = general_pair().problem
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


@pytest.mark.parametrize("name", [name for name in FOR_A_PAIR if Takes.PRIORS not in METHODS[name].takes])
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
    for problem, error, word in (
        (with_prior, PriorError, "sensor0"),
        (motions, FrameError, "motions"),
        (few, CountError, "at least 3"),
        (moments, MeasurementsNotKeptError, "keep_measurements"),
        (per_target, ScaleError, "per_target"),
        (rw.Problem(), CountError, "empty"),
    ):
        if word == "motions" and Takes.MOTIONS in METHODS[name].takes:
            continue
        with pytest.raises(error, match=word):
            run(name, problem)
        assert word in str(refusal(METHODS[name], problem))


def planar(noise: Noise | None) -> rw.Problem:
    """All rotations about one axis."""
    return general(1, 1, seed=1, motion="planar", number_of_measurements=40, noise=noise).problem


def standing_still() -> rw.Problem:
    problem = rw.Problem()
    problem.add("target0", "sensor0", np.tile(np.eye(4), (5, 1, 1)), np.tile(np.eye(4), (5, 1, 1)), 0.01, 1250.0)
    return problem


def free_or_refused(name: str, problem: rw.Problem) -> str:
    """What a method's answer leaves free, or why there is no answer."""
    try:
        return "; ".join(map(str, run(name, problem).free_directions))
    except UnderdeterminedError as error:
        return str(error)


@pytest.mark.parametrize("name", FOR_A_PAIR)
@pytest.mark.parametrize("noise", [None, Noise(0.001, 1e5)])
def test_parallel_axes_are_an_error_or_name_what_is_free(name: str, noise: Noise | None) -> None:
    problem = planar(noise)
    words = free_or_refused(name, problem)
    assert any(known in words for known in ("one axis only", "parallel axes", "leave a direction free"))


@pytest.mark.parametrize("name", FOR_A_PAIR)
def test_standing_still_is_an_error_or_names_what_is_free(name: str) -> None:
    words = free_or_refused(name, standing_still())
    assert any(known in words for known in ("the motion did not turn", "all the same", "do not move"))


@pytest.mark.parametrize("name", FOR_A_PAIR)
def test_two_motions_about_two_axes_are_enough(name: str) -> None:
    simulation = general(1, 1, seed=2, number_of_measurements=3)
    estimate = run(name, simulation.problem)
    assert max(largest_errors(simulation, estimate)) < 1e-5
    assert not estimate.free_directions


#: The columns of the RWHEC paper's Table 1 that its text has: how many frames.
TABLE_1 = {
    "dornaika1998": "",
    "strobl2006": "",
    "li2010_dq": "",
    "shah2013": "",
    "heller2014": "",
    "wise2020": "",
    "wang2022": "Xs or Ys",
    "evangelista2023": "Xs",
    "horn2023": "Xs or Ys",
    "certified": "Xs and Ys",
}


@pytest.mark.parametrize("name", [name for name in TABLE_1 if name in METHODS])
def test_numbers_of_frames_are_table_1s(name: str) -> None:
    assert METHODS[name].properties.multiple == TABLE_1[name]


def test_unknown_names_and_options_are_refused() -> None:
    problem = general_pair().problem
    with pytest.raises(OptionError, match="shah2013"):
        run("shah", problem)
    with pytest.raises(OptionError, match="MethodOptions"):
        run("shah2013", problem, {"seed": 1})  # type: ignore[arg-type]
    for start in ([1, 2, 3], (1, 2, 3), ({}, {}, "1"), ({}, {})):
        with pytest.raises(OptionError, match="start"):
            MethodOptions(start=start)  # type: ignore[arg-type]
    for count in (0, "a", None, 1.5, True):
        with pytest.raises(OptionError, match="max_iterations"):
            MethodOptions(max_iterations=count)  # type: ignore[arg-type]
    for seed in (-1, "a", 0.5):
        with pytest.raises(OptionError, match="seed"):
            MethodOptions(seed=seed)  # type: ignore[arg-type]
