"""Tabb and Ahmad Yousef 2017: charts of SO(3), both costs, separable and simultaneous."""

from __future__ import annotations

import numpy as np
import pytest
from method_problems import exchanged, four_targets, one_pair
from rwhec_factors import se3

from gtsam_rwhec.errors import FrameError, OptionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods import run
from gtsam_rwhec.methods.iterative_methods import C1, CHARTS, Cost, Mode, Parameterisation, tabb2017
from gtsam_rwhec.methods.method import MethodOptions, Outcome, Poses
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.simulate import Noise
from gtsam_rwhec.solver.rotations import random_rotations, vec

NOISE = Noise(0.05, 30.0)
PARAMETERISATIONS: tuple[Parameterisation, ...] = ("euler", "axis-angle", "quaternion")


def cost_of(problem: Problem, X: dict[str, Array], Y: dict[str, Array], cost: Cost) -> float:
    """As the paper writes it."""
    total = 0.0
    for target, sensor in problem.pairs:
        raw = problem.measurements(target, sensor)
        x, y = np.asarray(X[target]), np.asarray(Y[sensor])
        residual = raw.A @ x - y @ raw.B if cost == "c1" else raw.A - y @ raw.B @ np.linalg.inv(x)
        total += float((residual**2).sum())
    return total


def nearby(
    found: Outcome[Poses], generator: np.random.Generator, size: float
) -> tuple[dict[str, Array], dict[str, Array]]:
    def moved(poses: dict[str, Array]) -> dict[str, Array]:
        return {name: T @ se3.expmap(size * generator.standard_normal((1, 6)))[0] for name, T in poses.items()}

    return moved(dict(found.X)), moved(dict(found.Y))  # type: ignore[arg-type]


@pytest.mark.parametrize("name", PARAMETERISATIONS)
def test_charts_and_their_derivatives(name: Parameterisation) -> None:
    to_parameters, chart = CHARTS[name]
    R = random_rotations(20, np.random.default_rng(0))
    R[0] = np.eye(3)
    p = to_parameters(R)
    again, derivative = chart(p)
    np.testing.assert_allclose(again, R, atol=1e-12)
    for k in range(p.shape[1]):
        step = np.zeros_like(p)
        step[:, k] = 1e-6
        numeric = (vec(chart(p + step)[0]) - vec(chart(p - step)[0])) / 2e-6
        np.testing.assert_allclose(derivative[:, :, k], numeric, atol=1e-8)
    at_pole = np.array([[[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]])
    np.testing.assert_allclose(chart(to_parameters(at_pole))[0], at_pole, atol=1e-12)


@pytest.mark.parametrize("cost", ["c1", "c2"])
@pytest.mark.parametrize("parameterisation", PARAMETERISATIONS)
def test_simultaneous_is_a_minimum_of_the_cost_in_every_parameterisation(
    cost: Cost, parameterisation: Parameterisation
) -> None:
    problem = four_targets(NOISE).problem
    found = tabb2017(problem, MethodOptions(), cost, "simultaneous", parameterisation)
    least = cost_of(problem, found.X, found.Y, cost)  # type: ignore[arg-type]
    generator = np.random.default_rng(0)
    for size in (1e-2, 1e-4):
        for _ in range(10):
            assert cost_of(problem, *nearby(found, generator, size), cost) > least
    other = tabb2017(problem, MethodOptions(), cost)
    assert least == pytest.approx(cost_of(problem, other.X, other.Y, cost), rel=1e-9)  # type: ignore[arg-type]


@pytest.mark.parametrize("cost", ["c1", "c2"])
def test_separable_is_a_minimum_of_each_part_in_turn(cost: Cost) -> None:
    problem = one_pair(NOISE).problem
    found = tabb2017(problem, MethodOptions(), cost, "separable")
    whole = tabb2017(problem, MethodOptions(), cost)
    X, Y = np.asarray(found.X["camera"]), np.asarray(found.Y["marker"])
    raw = problem.measurements("camera", "marker")

    def of_rotations(R_X: Array, R_Y: Array) -> float:
        return float(((raw.A[:, :3, :3] @ R_X - R_Y @ raw.B[:, :3, :3]) ** 2).sum())

    least, least_whole = (cost_of(problem, f.X, f.Y, cost) for f in (found, whole))  # type: ignore[arg-type]
    assert least > least_whole
    generator = np.random.default_rng(1)
    for _ in range(10):
        turn = se3.expmap(np.concatenate([1e-3 * generator.standard_normal((2, 3)), np.zeros((2, 3))], axis=1))
        assert of_rotations(X[:3, :3] @ turn[0, :3, :3], Y[:3, :3] @ turn[1, :3, :3]) > of_rotations(
            X[:3, :3], Y[:3, :3]
        )
        shift = np.tile(np.eye(4), (2, 1, 1))
        shift[:, :3, 3] = 1e-3 * generator.standard_normal((2, 3))
        assert cost_of(problem, {"camera": X @ shift[0]}, {"marker": Y @ shift[1]}, cost) > least


@pytest.mark.parametrize("mode", ["simultaneous", "separable"])
def test_c2_is_c1_of_the_equation_turned_round(mode: Mode) -> None:
    simulation = four_targets(NOISE)
    problem = simulation.problem
    swapped = Problem()
    for target, sensor in problem.pairs:
        raw = problem.measurements(target, sensor)
        swapped.add(target, sensor, raw.B, raw.A)
    here, there = tabb2017(problem, MethodOptions(), "c2", mode), tabb2017(swapped, MethodOptions(), "c1", mode)
    for name in problem.targets:
        np.testing.assert_allclose(here.X[name], np.linalg.inv(np.asarray(there.X[name])), atol=1e-6)
    # Exchanging the roles of X and Y is another matter: A^-1 Y = X B^-1 measures translations elsewhere.
    turned = exchanged(simulation)
    other = tabb2017(turned.problem, MethodOptions(), "c1", mode)
    assert np.abs(np.asarray(other.Y["camera0"]) - here.X["camera0"]).max() > 1e-5


def test_what_is_not_there_is_refused_in_words() -> None:
    problem = one_pair().problem
    with pytest.raises(FrameError, match="reprojection"):
        run("tabb2017_rp1", problem)
    with pytest.raises(OptionError, match="c3"):
        tabb2017(problem, MethodOptions(), "c3")  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="euler"):
        tabb2017(problem, MethodOptions(), parameterisation="mrp")  # type: ignore[arg-type]
    assert C1.properties.joint
