"""From the certified optimum of the inverse equation to the physical one."""

from __future__ import annotations

import numpy as np
import pytest

import gtsam_rwhec as rw
from gtsam_rwhec.problem.moments import edge_forms
from gtsam_rwhec.problem.variance_factors import VarianceFactors
from gtsam_rwhec.refinement import exact_scales
from gtsam_rwhec.refinement.certified_fit import CertifiedFit
from gtsam_rwhec.refinement.exact_scales import with_exact_scales
from gtsam_rwhec.refinement.squared_residuals import Measured
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.solver.parts import parts_of
from gtsam_rwhec.solver.residuals import PairPoses
from gtsam_rwhec.solver.variables import given_answer

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


@pytest.mark.parametrize("scale", ["per_target", "shared"])
@pytest.mark.parametrize("seed", [0, 1])
def test_gradient_and_hessian_numerically(seed: int, scale: rw.ScaleMode) -> None:
    problem = problem_of(seed, scale)
    (part,) = parts_of(problem)
    assert part.kind == "inverse"
    solution = rw.solve(problem)
    answer = given_answer(part, solution.X, solution.Y, solution.scale)
    forms = np.add(*edge_forms(part.moments.translation, part.moments.rotation, part.moments.kappa))
    size = exact_scales._number_of_unknowns(part)
    generator = np.random.default_rng(seed)
    for away in (0.0, 0.5):
        at = exact_scales._moved(part, answer, away * generator.standard_normal(size))
        _, gradient, hessian = exact_scales._expand(part, at, forms)
        assert np.linalg.eigvalsh(hessian)[0] > 0.0
        for i in range(size):
            step = np.zeros(size)
            step[i] = 1e-5
            up, down = (exact_scales._expand(part, exact_scales._moved(part, at, s), forms)[0] for s in (step, -step))
            assert (up - down) / 2e-5 == pytest.approx(gradient[i], rel=1e-5, abs=1e-5 * np.abs(gradient).max() + 1e-3)


@pytest.mark.parametrize("scale", ["per_target", "shared"])
def test_the_end_is_a_minimum_of_the_physical_cost(scale: rw.ScaleMode) -> None:
    problem = problem_of(3, scale)
    (part,) = parts_of(problem)
    solution = rw.solve(problem)
    given = given_answer(part, solution.X, solution.Y, solution.scale)
    end = with_exact_scales(part, given)
    forms = np.add(*edge_forms(part.moments.translation, part.moments.rotation, part.moments.kappa))
    before = exact_scales._expand(part, given, forms)[0]
    cost, gradient, hessian = exact_scales._expand(part, end, forms)
    assert cost < before - 0.1
    assert float(gradient @ np.linalg.solve(hessian, gradient)) < 1e-6
    # The same cost from every measurement by itself.
    poses = PairPoses.of(part, end)
    names = {name: part.free.index(name) for name in part.free}
    fit = CertifiedFit({}, {}, certified=True)
    for name, i in names.items():
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = end.R[i], end.t[i] + part.frame_shift(name)
        fit.poses[name] = T
    for e, pair in enumerate(part.pairs):
        fit.alpha[pair[0]] = float(poses.alpha[e])
    measured = Measured.of(problem)
    total = 0.5 * measured.together(measured.squares(fit), VarianceFactors(1.0, 1.0)).sum()
    for name, beliefs in problem.priors.items():
        for prior in beliefs:
            if prior.kappa is not None:
                total += 0.5 * prior.kappa * np.sum((fit.poses[name] - prior.transform)[:3, :3] ** 2)
            if prior.sigma is not None:
                total += 0.5 * np.sum((fit.poses[name] - prior.transform)[:3, 3] ** 2) / prior.sigma**2
    assert total == pytest.approx(cost, rel=1e-9)


def test_known_scale_needs_nothing() -> None:
    problem = general(1, 1, seed=0, noise=NOISE).problem
    (part,) = parts_of(problem)
    solution = rw.solve(problem)
    answer = given_answer(part, solution.X, solution.Y, 1.0)
    assert with_exact_scales(part, answer) is answer
