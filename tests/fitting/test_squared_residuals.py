"""Squared residuals against the certified cost, the chi-square distribution, and full covariances."""

from __future__ import annotations

import numpy as np
import pytest
from rwhec_factors import se3
from scipy.stats import chi2

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.weighted_fit import Measured, WeightedFit, weighted_fit
from gtsam_rwhec.problem.selection import VarianceFactors
from gtsam_rwhec.simulate import Noise, Simulation, general

NOISE = Noise(sigma_m=0.01, kappa=500.0)
ONE = VarianceFactors(1.0, 1.0)


def truth(simulation: Simulation) -> WeightedFit:
    scale = simulation.scale
    names = [*simulation.X, *simulation.Y]
    alpha = scale if isinstance(scale, dict) else dict.fromkeys(names, scale)
    return WeightedFit({**simulation.X, **simulation.Y}, alpha)


@pytest.mark.parametrize("scale", ["known", "shared"])
def test_half_the_sum_of_squares_is_the_certified_cost(scale: rw.ScaleMode) -> None:
    problem = general(
        2, 2, seed=1, number_of_measurements=9, noise=NOISE, scale=scale, odometry=7, odometry_noise=NOISE
    ).problem
    measured = Measured.of(problem)
    squares = measured.squares(weighted_fit(problem, None))
    assert 0.5 * measured.together(squares, ONE).sum() == pytest.approx(rw.solve(problem).cost, rel=1e-9)


@pytest.mark.parametrize("scale", ["known", "shared", "per_target"])
def test_squares_at_the_truth_are_chi_square(scale: rw.ScaleMode) -> None:
    simulation = general(2, 2, seed=2, number_of_measurements=2000, noise=NOISE, scale=scale)
    measured = Measured.of(simulation.problem)
    squares = measured.squares(truth(simulation))
    count = len(measured.A)
    for values, degrees in ((squares.rotation, 3), (squares.translation, 3), (measured.together(squares, ONE), 6)):
        assert values.mean() == pytest.approx(degrees, abs=4.0 * np.sqrt(2.0 * degrees / count))
        beyond = float((values > chi2.ppf(0.95, degrees)).mean())
        assert beyond == pytest.approx(0.05, abs=4.0 * np.sqrt(0.05 * 0.95 / count))
    factors = VarianceFactors(4.0, 9.0)
    np.testing.assert_allclose(
        measured.together(squares, factors), squares.rotation / 4.0 + squares.translation / 9.0, rtol=1e-12
    )


def test_full_covariances_are_used_whole() -> None:
    """Noise that is large along the line of sight, and correlated with the rotation: still chi-square."""
    generator = np.random.default_rng(3)
    simulation = general(1, 1, seed=3, number_of_measurements=3000)
    raw = simulation.problem.measurements("target0", "sensor0")
    root = np.diag([0.01, 0.02, 0.005, 0.002, 0.003, 0.05]) @ (np.eye(6) + 0.3 * generator.standard_normal((6, 6)))
    covariance = root @ root.T
    xi = generator.standard_normal((len(raw.B), 6)) @ root.T
    noisy = raw.B @ se3.expmap(xi)
    problem = rw.Problem()
    problem.add("target0", "sensor0", raw.A, noisy, covariances=covariance)
    measured = Measured.of(problem)
    squares = measured.squares(truth(simulation))
    for values, degrees in ((squares.rotation, 3), (squares.translation, 3), (measured.together(squares, ONE), 6)):
        assert values.mean() == pytest.approx(degrees, rel=0.06)
        assert float((values > chi2.ppf(0.95, degrees)).mean()) == pytest.approx(0.05, abs=0.015)
    twice = measured.together(squares, VarianceFactors(2.0, 2.0))
    np.testing.assert_allclose(twice, 0.5 * measured.together(squares, ONE), rtol=1e-12)


def test_frames_without_a_pose_are_infinitely_far() -> None:
    simulation = general(2, 1, seed=4, noise=NOISE, number_of_measurements=5)
    measured = Measured.of(simulation.problem)
    fit = truth(simulation)
    squares = measured.squares(WeightedFit({n: T for n, T in fit.poses.items() if n != "target1"}, fit.alpha))
    by_pair = measured.by_pair(measured.together(squares, ONE))
    assert np.isfinite(by_pair["target0", "sensor0"]).all()
    assert np.isinf(by_pair["target1", "sensor0"]).all()


def test_parts_of_the_measurements_keep_their_pairs() -> None:
    simulation = general(2, 2, seed=5, noise=NOISE, number_of_measurements=4)
    measured = Measured.of(simulation.problem)
    fit = truth(simulation)
    own = Measured.of(simulation.problem, (rw.Pair("target1", "sensor0"), rw.Pair("target0", "sensor0")))
    assert [own.pair_of(i) for i in (0, 3, 4, 7)] == [("target1", "sensor0")] * 2 + [("target0", "sensor0")] * 2
    whole = measured.by_pair(measured.together(measured.squares(fit), ONE))
    part = own.by_pair(own.together(own.squares(fit), ONE))
    for pair, values in part.items():
        np.testing.assert_array_equal(values, whole[pair])
