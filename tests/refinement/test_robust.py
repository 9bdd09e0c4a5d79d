"""Losses of GTSAM's and graduated truncation inside refine."""

from __future__ import annotations

import numpy as np
import pytest
from refinement_problems import copied, distance, refined, rig

import gtsam_rwhec as rw
from gtsam_rwhec.selection import selected
from gtsam_rwhec.simulate import Simulation
from gtsam_rwhec.simulate.transforms import random_poses

LOSSES = ("huber", "cauchy", "tukey", "geman_mcclure")


def with_outliers(share: float, seed: int = 0) -> tuple[Simulation, rw.Problem, dict[tuple[str, str], np.ndarray]]:
    """A rig, and its problem with a share of each pair's B replaced by random poses."""
    simulation = rig(seed=seed, number_of_measurements=40)
    generator = np.random.default_rng(seed)
    bad = {pair: generator.random(40) < share for pair in simulation.problem.pairs}

    def B(pair: tuple[str, str], raw: rw.Measurements) -> np.ndarray:
        poses = raw.B.copy()
        poses[bad[pair]] = random_poses(int(bad[pair].sum()), 2.0, generator)
        return poses

    return simulation, copied(simulation.problem, B=B), bad


def worst_error(simulation: Simulation, answer: rw.Refined) -> float:
    errors = simulation.errors(answer)
    return max(e.translation_mm for e in [*errors.X.values(), *errors.Y.values()])


@pytest.mark.parametrize("loss", LOSSES)
def test_without_outliers_a_loss_costs_little(loss: str) -> None:
    simulation = rig(seed=3, number_of_measurements=60)
    plain, robust = refined(simulation.problem), refined(simulation.problem, robust=loss)
    ratio = np.diag(robust.covariance()) / np.diag(plain.covariance())
    assert 0.99 < ratio.mean() < 2.5
    assert worst_error(simulation, robust) < 2.5 * worst_error(simulation, plain)
    assert all(robust.contains(name, T, 0.9999) for name, T in (simulation.X | simulation.Y).items())


@pytest.mark.parametrize("loss", ["cauchy", "tukey"])
def test_a_loss_holds_a_few_outliers_off(loss: str) -> None:
    """From the certified solution, which a tenth of outliers has pulled away."""
    simulation, problem, _ = with_outliers(0.1, seed=2)
    assert worst_error(simulation, refined(problem, robust=loss)) < 0.3 * worst_error(simulation, refined(problem))


@pytest.mark.parametrize("noise", ["given", "estimate"])
def test_gnc_finds_them_all(noise: str) -> None:
    simulation, problem, bad = with_outliers(0.4)
    r = refined(problem, robust="gnc", noise=noise)
    for pair, outlier in bad.items():
        assert not r.inliers[pair][outlier].any()
        assert r.inliers[pair][~outlier].mean() > 0.95
    alone = selected(problem, {pair: ~outlier for pair, outlier in bad.items()})
    assert worst_error(simulation, r) < 1.2 * worst_error(simulation, refined(alone, noise=noise)) + 0.1
    assert all(r.contains(name, T, 0.9999) for name, T in (simulation.X | simulation.Y).items())


def test_gnc_with_the_chordal_residual() -> None:
    _, problem, bad = with_outliers(0.2)
    r = refined(problem, robust="gnc", residual="chordal")
    assert all(not r.inliers[pair][outlier].any() for pair, outlier in bad.items())
    assert distance(r, refined(problem, robust="gnc")) < 0.01


def test_the_estimated_noise_of_what_is_left_is_not_shrunk_by_the_cut() -> None:
    """Leaving 10 % of good measurements out takes their variance away; it is given back."""
    estimates = []
    for seed in range(4):
        problem = rig(seed=seed, number_of_measurements=100).problem
        r = refined(problem, robust="gnc", noise="estimate", inlier_confidence=0.9)
        plain = refined(problem, noise="estimate")
        pair = problem.pairs[0]
        estimates.append(r.noise[pair].translation_m / plain.noise[pair].translation_m)
    assert np.mean(estimates) == pytest.approx(1.0, abs=0.03)
