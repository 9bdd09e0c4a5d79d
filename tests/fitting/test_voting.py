"""Poses by vote, and the fit that needs no positive scale."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from outlier_problems import corrupted

import gtsam_rwhec as rw
from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.fitting.weighted_fit import Measured, WeightedFit, by_vote, weighted_fit
from gtsam_rwhec.problem.selection import VarianceFactors, selected
from gtsam_rwhec.simulate import Noise, general, perturb

NOISE = Noise(sigma_m=0.01, kappa=2000.0)
ONE = VarianceFactors(1.0, 1.0)
THRESHOLD = 20.0


@pytest.mark.parametrize("scale", ["known", "shared", "per_target"])
@pytest.mark.parametrize("name", ["target1", "sensor0"])
@pytest.mark.parametrize("missing", [False, True])
def test_a_frame_goes_where_most_of_its_measurements_agree(scale: Any, name: str, missing: bool) -> None:
    simulation = general(3, 2, seed=1, number_of_measurements=20, noise=NOISE, scale=scale)
    own = tuple(pair for pair in simulation.problem.pairs if name in pair)
    problem, _ = corrupted(simulation, 0.6, "random", 1, NOISE, pairs=own)
    measured = Measured.of(problem)
    names = [*simulation.X, *simulation.Y]
    alpha = simulation.scale if isinstance(simulation.scale, dict) else dict.fromkeys(names, simulation.scale)
    truth = WeightedFit({**simulation.X, **simulation.Y}, alpha)
    wrong = {**truth.poses, name: np.eye(4)}
    if missing:
        del wrong[name]
    fit, saved = by_vote(name, problem, replace(truth, poses=wrong), ONE, THRESHOLD)
    assert saved > 0.0
    assert np.abs(fit.poses[name] - truth.poses[name]).max() < 0.15
    inliers = measured.together(measured.squares(fit), ONE) <= 3.0 * THRESHOLD
    assert inliers.mean() > 0.5
    stays, nothing = by_vote(name, problem, fit, ONE, THRESHOLD)
    assert nothing >= 0.0
    assert np.abs(stays.poses[name] - fit.poses[name]).max() < 0.15


def test_without_a_pose_of_the_other_frame_no_pose_is_proposed() -> None:
    simulation = general(1, 1, seed=2, number_of_measurements=5, noise=NOISE)
    fit, saved = by_vote("target0", simulation.problem, WeightedFit({}, {}), ONE, THRESHOLD)
    assert saved == 0.0
    assert not fit.poses


@pytest.mark.parametrize("scale", ["known", "shared", "per_target"])
def test_the_fit_is_what_solve_finds(scale: Any) -> None:
    problem = general(2, 2, seed=3, number_of_measurements=12, scale=scale).problem
    solution, fit = rw.solve(problem), weighted_fit(problem, None)
    for name, pose in (solution.X | solution.Y).items():
        np.testing.assert_allclose(fit.poses[name], pose.matrix(), atol=1e-7)
    for target, _ in problem.pairs:
        expected = solution.scale[target] if isinstance(solution.scale, dict) else solution.scale
        assert fit.alpha[target] == pytest.approx(expected, rel=1e-7)
    again = weighted_fit(problem, fit)
    for name, T in fit.poses.items():
        np.testing.assert_allclose(again.poses[name], T, atol=1e-7)


def test_a_poor_start_does_not_matter() -> None:
    problem = general(3, 2, seed=4, number_of_measurements=12, noise=NOISE).problem
    start = weighted_fit(problem, None)
    poses = dict(zip(start.poses, perturb(np.array(list(start.poses.values())), Noise(1.0, 0.1), 5), strict=True))
    fit = weighted_fit(problem, replace(start, poses=poses))
    for name, T in start.poses.items():
        np.testing.assert_allclose(fit.poses[name], T, atol=1e-6)


def test_a_negative_scale_on_the_way_is_no_error() -> None:
    simulation = general(1, 1, seed=5, number_of_measurements=20, scale="shared")
    raw = simulation.problem.measurements("target0", "sensor0")
    B = raw.B.copy()
    B[:, :3, 3] *= -1.0
    problem = rw.Problem("shared")
    problem.add("target0", "sensor0", raw.A, B, 0.01, 1000.0)
    with pytest.raises(rw.errors.ScaleError):
        rw.solve(problem)
    assert weighted_fit(problem, None).alpha["target0"] < 0.0


def test_too_few_measurements_raise_an_error() -> None:
    problem = general(1, 1, seed=6, number_of_measurements=5, noise=NOISE).problem
    one = selected(problem, {("target0", "sensor0"): np.arange(5) == 2})
    with pytest.raises(UnderdeterminedError):
        weighted_fit(one, None)
