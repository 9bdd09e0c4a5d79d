"""Fits on the way of the outlier rejection: from the optimum of the inverse equation to the physical optimum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.weighted_fit import Measured, WeightedFit, at_physical_optimum, weighted_fit
from gtsam_rwhec.problem.selection import AS_STATED
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.solver.parts import parts_of

NOISE = Noise(sigma_m=0.01, kappa=200.0)


def problem_of(seed: int, scale: rw.ScaleMode) -> rw.Problem:
    simulation = general(
        2, 2, seed=seed, number_of_measurements=15, noise=NOISE, scale=scale, odometry=8, odometry_noise=NOISE
    )
    problem = simulation.problem
    problem.add_prior("target0", simulation.X["target0"], sigma=0.05, kappa=100.0)
    problem.add_prior("sensor1", simulation.Y["sensor1"], sigma=0.02)
    if scale == "per_target":
        problem.fix_scale("sensor1", simulation.scale["sensor1"])  # type: ignore[index]
    return problem


def as_fit(solution: rw.Solution, problem: rw.Problem) -> WeightedFit:
    poses = {name: pose.matrix() for name, pose in (solution.X | solution.Y).items()}
    of = solution.scale
    alpha = dict(of) if isinstance(of, dict) else dict.fromkeys(problem.targets + problem.sensors, float(of))
    return WeightedFit(poses, alpha)


def physical_cost(problem: rw.Problem, fit: WeightedFit) -> float:
    """Summed over every measurement by itself, and the priors."""
    measured = Measured.of(problem)
    total = 0.5 * float(measured.together(measured.squares(fit), AS_STATED).sum())
    for name, beliefs in problem.priors.items():
        for prior in beliefs:
            if prior.kappa is not None:
                total += 0.5 * prior.kappa * np.sum((fit.poses[name] - prior.transform)[:3, :3] ** 2)
            if prior.sigma is not None:
                total += 0.5 * np.sum((fit.poses[name] - prior.transform)[:3, 3] ** 2) / prior.sigma**2
    return float(total)


@pytest.mark.parametrize("scale", ["per_target", "shared"])
@pytest.mark.parametrize("seed", [0, 3])
def test_the_end_is_a_minimum_of_the_physical_cost(seed: int, scale: rw.ScaleMode) -> None:
    problem = problem_of(seed, scale)
    (part,) = parts_of(problem)
    assert part.kind == "inverse"
    given = as_fit(rw.solve(problem), problem)
    end = at_physical_optimum(problem, [part], given)
    cost = physical_cost(problem, end)
    assert cost < physical_cost(problem, given) - 0.1
    for name, T in end.poses.items():  # any step away costs more
        for step in 1e-3 * np.vstack([np.eye(6), -np.eye(6)]):
            moved = replace(end, poses=end.poses | {name: T @ se3.expmap(step[None])[0]})
            assert physical_cost(problem, moved) > cost
    owners = [part.scale_owners] if scale == "per_target" else []
    for names in [(name,) for group in owners for name in group] or [tuple(end.alpha)]:
        for factor in (0.999, 1.001):
            moved = replace(end, alpha=end.alpha | {name: factor * end.alpha[name] for name in names})
            assert physical_cost(problem, moved) > cost
    assert weighted_fit(problem, None).poses["target0"] == pytest.approx(end.poses["target0"], abs=1e-6)


def test_a_negative_scale_stays() -> None:
    problem = problem_of(0, "per_target")
    given = as_fit(rw.solve(problem), problem)
    given.alpha["target0"] *= -1.0
    assert at_physical_optimum(problem, parts_of(problem), given) is given


def test_a_known_scale_needs_no_second_optimum() -> None:
    problem = general(1, 1, seed=0, noise=NOISE).problem
    given = as_fit(rw.solve(problem), problem)
    assert at_physical_optimum(problem, parts_of(problem), given) is given
