"""Losses of GTSAM's and graduated truncation inside refine."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from refinement_problems import copied, distance, refined, rig
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.pose_fit import GeodesicModel
from gtsam_rwhec.problem.selection import selected
from gtsam_rwhec.simulate import Noise, Simulation, perturb
from gtsam_rwhec.simulate.simulated_noise import random_poses

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


def test_without_outliers_a_loss_costs_little() -> None:
    simulation = rig(seed=3, number_of_measurements=60)
    plain = refined(simulation.problem)
    for loss in LOSSES:
        robust = refined(simulation.problem, robust=loss)
        ratio = np.diag(robust.covariance()) / np.diag(plain.covariance())
        assert 0.99 < ratio.mean() < 2.5, loss
        assert worst_error(simulation, robust) < 2.5 * worst_error(simulation, plain), loss
        assert all(robust.contains(name, T, 0.9999) for name, T in (simulation.X | simulation.Y).items()), loss


@pytest.mark.parametrize("loss", ["cauchy", "tukey"])
def test_a_loss_withstands_a_few_outliers(loss: str) -> None:
    """The start is the certified solution, which a tenth of outliers has pulled away."""
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


def test_the_threshold_does_not_shrink_the_estimated_noise_of_inliers() -> None:
    """Leaving 10 % of good measurements out lowers the estimated variance; the estimate corrects for this."""
    estimates = []
    for seed in range(4):
        problem = rig(seed=seed, number_of_measurements=100).problem
        r = refined(problem, robust="gnc", noise="estimate", inlier_confidence=0.9)
        plain = refined(problem, noise="estimate")
        pair = problem.pairs[0]
        estimates.append(r.noise[pair].translation_m / plain.noise[pair].translation_m)
    assert np.mean(estimates) == pytest.approx(1.0, abs=0.03)


DEPTH = np.diag(np.r_[np.full(3, np.radians(0.3)), 0.002, 0.002, 0.02]) ** 2


def depth_camera(seed: int, bad_share: float = 0.0) -> tuple[rw.Problem, np.ndarray]:
    """A camera whose depth is ten times noisier than the other axes, with its true full covariances."""
    raw = rig(1, 1, seed=seed, noise=None, number_of_measurements=30).problem.measurements("target0", "sensor0")
    generator = np.random.default_rng(seed)
    bad = generator.random(30) < bad_share
    xi = generator.multivariate_normal(np.zeros(6), DEPTH, 30)
    B = raw.B @ se3.expmap(xi)
    B[bad] = random_poses(int(bad.sum()), 2.0, generator)
    problem = rw.Problem()
    problem.add("target0", "sensor0", raw.A, B, covariances=DEPTH)
    return problem, bad


def test_gnc_uses_full_covariances_and_keeps_good_measurements() -> None:
    kept = outliers = good = 0
    for seed in range(6):
        problem, bad = depth_camera(seed, bad_share=0.2)
        inliers = refined(problem, robust="gnc").inliers["target0", "sensor0"]
        kept, good, outliers = kept + inliers[~bad].sum(), good + (~bad).sum(), outliers + inliers[bad].sum()
    assert outliers == 0
    assert kept / good > 0.97


@pytest.mark.parametrize("each", [False, True])
def test_gnc_knows_the_noise_of_A(each: bool) -> None:
    """A is five times noisier than B: if A counted as exact, all measurements would be outliers."""
    raw = rig(1, 1, seed=2, noise=None, number_of_measurements=40).problem.measurements("target0", "sensor0")
    generator = np.random.default_rng(0)
    A = perturb(raw.A, Noise(0.005, 0.5 / 0.005**2), generator)
    B = perturb(raw.B, Noise(0.001, 0.5 / 0.001**2), generator)
    B[:8] = random_poses(8, 2.0, generator)
    problem = rw.Problem()
    problem.add("target0", "sensor0", A, B, 0.001, 0.5 / 0.001**2, stamps_ns=raw.stamps_ns)
    covariances = {("target0", "sensor0"): np.tile(np.eye(6) * 0.005**2, (40, 1, 1))}
    noise = rw.CarrierNoise(covariances=covariances) if each else rw.CarrierNoise(0.005, 0.005)
    inliers = refined(problem, robust="gnc", noise="given", carrier_noise=noise).inliers["target0", "sensor0"]
    assert not inliers[:8].any()
    assert inliers[8:].mean() > 0.9


def test_to_choose_inliers_takes_no_variables_for_the_carriers(monkeypatch: pytest.MonkeyPatch) -> None:
    """A long log has thousands of carrier poses: with a variable for each, every choice took minutes."""
    simulation = rig(2, 2, seed=2, number_of_measurements=20)
    problem, generator = rw.Problem(), np.random.default_rng(0)
    for pair in simulation.problem.pairs:
        raw = simulation.problem.measurements(*pair)
        B = raw.B.copy()
        B[:4] = random_poses(4, 2.0, generator)
        problem.add(*pair, raw.A, B, raw.sigma, raw.kappa, stamps_ns=np.arange(20) * 10**8)
    with_variables: list[bool] = []
    of = GeodesicModel.of

    def recorded(*arguments: Any) -> GeodesicModel:
        model = of(*arguments)
        with_variables.append(model.carriers is not None)
        return model

    monkeypatch.setattr(GeodesicModel, "of", staticmethod(recorded))
    told: list[str] = []
    options = rw.RefineOptions(robust="gnc", noise="estimate", carrier_noise=rw.CarrierNoise(0.0005, 0.0005))
    r = rw.refine(problem, rw.solve(problem), options, progress=told.append)
    assert not any(mask[:4].any() for mask in r.inliers.values())
    assert with_variables[-1]
    assert with_variables.count(True) == 1
    assert len(with_variables) >= 2
    assert any("choosing the inliers under the full noise, step 1 of at most" in one for one in told)


@pytest.mark.parametrize("loss", ["huber", "tukey"])
def test_under_a_loss_outliers_make_no_free_directions(loss: str) -> None:
    for seed in range(4):
        simulation = rig(1, 1, seed=seed, scale="shared", number_of_measurements=40)
        generator = np.random.default_rng(seed)

        raw = simulation.problem.measurements("target0", "sensor0")
        B = raw.B.copy()
        B[:8] = random_poses(8, 2.0, generator)
        problem = copied(simulation.problem, B=lambda pair, raw, B=B: B)
        assert refined(problem, robust=loss).free_directions == ()


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
def test_more_than_half_outliers_are_warned_of_where_the_noise_is_estimated() -> None:
    """Most of B at random: an estimated noise grows until everything is an inlier."""
    _, problem, _ = with_outliers(0.8)
    solution = rw.solve(problem)
    with pytest.warns(rw.errors.OutliersWarning, match="half of the measurements may be outliers.*noise='given'"):
        rw.refine(problem, solution, rw.RefineOptions(robust="gnc", noise="estimate"))


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
def test_moved_is_relative_to_the_given_solution() -> None:
    """Outliers had pulled the given solution away, but not the start of the refinement."""
    _, problem, _ = with_outliers(0.2)
    solution = rw.solve(problem)
    r = rw.refine(problem, solution, rw.RefineOptions(robust="gnc"))
    apart = np.linalg.norm(solution.Y["sensor0"].between(r.Y["sensor0"]).translation())
    assert r.moved["sensor0"].translation_mm == pytest.approx(1e3 * apart, rel=1e-6)
    assert r.moved["sensor0"].translation_mm > 10.0
    assert r.initial_cost > 2.0 * r.cost
