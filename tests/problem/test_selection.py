"""Some of a problem's measurements, or all of them weighed anew: what stays, what goes, and how long it takes."""

from __future__ import annotations

import time
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gtsam_rwhec as rw
from gtsam_rwhec.errors import CountError, FrameError, MeasurementsNotKeptError, NoiseError
from gtsam_rwhec.problem.selection import VarianceFactors, reweighted, selected
from gtsam_rwhec.simulate import Noise, general

NOISE = Noise(sigma_m=0.01, kappa=500.0)
PAIR = ("target0", "sensor0")


def rig(seed: int = 0, **options: object) -> rw.Problem:
    return general(3, 2, seed=seed, number_of_measurements=12, noise=NOISE, **options).problem  # type: ignore[arg-type]


def masks(problem: rw.Problem, seed: int, share: float = 0.7) -> dict[tuple[str, str], np.ndarray]:
    generator = np.random.default_rng(seed)
    return {pair: generator.random(problem.moments(*pair).count) < share for pair in problem.pairs}


def assert_same_moments(got: rw.Problem, expected: rw.Problem) -> None:
    assert got.pairs == expected.pairs
    a, c = (
        got.gauge.sensor_carrier - expected.gauge.sensor_carrier,
        got.gauge.target_carrier - expected.gauge.target_carrier,
    )
    for pair in got.pairs:
        one = got.moments(*pair)
        other = expected.moment_stack([pair]).shifted(a, c).as_summed().one(0)
        assert one.count == other.count
        assert one.kappa == pytest.approx(other.kappa)
        np.testing.assert_allclose(one.translation, other.translation, atol=1e-11 * np.abs(one.translation).max())
        np.testing.assert_allclose(one.rotation, other.rotation, atol=1e-11 * np.abs(one.rotation).max())


def test_selected_is_the_problem_of_these_measurements_alone() -> None:
    problem = rig(odometry=8, odometry_noise=NOISE, scale="shared")
    keep = masks(problem, 1)
    expected = rw.Problem("shared")
    for target, sensor in problem.pairs:
        raw, mask = problem.measurements(target, sensor), keep[target, sensor]
        if target == sensor:
            expected.add_motion(sensor, raw.A[mask], raw.B[mask], raw.sigma[mask], raw.kappa[mask])
        else:
            expected.add(target, sensor, raw.A[mask], raw.B[mask], raw.sigma[mask], raw.kappa[mask])
    got = selected(problem, keep)
    assert_same_moments(got, expected)
    assert got.targets == problem.targets
    assert got.sensors == problem.sensors
    assert got.has_measurements
    assert not got.is_relative
    assert rw.solve(got).cost == pytest.approx(rw.solve(expected).cost, rel=1e-9)


def test_knowledge_stamps_and_covariances_stay_and_the_problem_does_not_change() -> None:
    problem = rig(scale="per_target")
    A = problem.measurements(*PAIR).A
    covariances = np.eye(6) * np.linspace(1e-5, 2e-5, len(A))[:, None, None]
    stamps = np.arange(len(A)) * 5
    problem.add(*PAIR, A, problem.measurements(*PAIR).B, covariances=covariances, stamps_ns=stamps)
    problem.fix("sensor1", np.eye(4))
    problem.add_prior("target1", np.eye(4), sigma=1.0)
    problem.fix_scale("target2", 1.5)
    before = problem.moments(*PAIR)
    mask = np.zeros(24, dtype=bool)
    mask[[3, 13, 20]] = True
    got = selected(problem, {PAIR: mask})
    raw, whole = got.measurements(*PAIR), problem.measurements(*PAIR)
    np.testing.assert_array_equal(raw.B, whole.B[mask])
    assert raw.stamps_ns is not None
    assert whole.stamps_ns is not None
    np.testing.assert_array_equal(raw.stamps_ns, whole.stamps_ns[mask])
    np.testing.assert_array_equal(raw.covariance_of_B(), whole.covariance_of_B()[mask])
    assert got.has_covariances
    assert set(got.fixed) == {"sensor1"}
    assert set(got.priors) == {"target1"}
    assert got.fixed_scales == {"target2": 1.5}
    assert got.moments("target1", "sensor0").count == 12  # a pair that is not named stays whole
    got.add_prior("target1", np.eye(4), kappa=1.0)
    got.fix("sensor0", np.eye(4))
    assert len(problem.priors["target1"]) == 1
    assert "sensor0" not in problem.fixed
    np.testing.assert_array_equal(problem.moments(*PAIR).translation, before.translation)
    assert len(whole.A) == 24


def test_a_frame_without_measurements_is_left_out_with_what_is_known_of_it() -> None:
    problem = rig()
    problem.fix("target1", np.eye(4))
    problem.add_prior("target1", np.eye(4), sigma=1.0)
    problem.add_prior("target2", np.eye(4), sigma=5.0)
    none = np.zeros(12, dtype=bool)
    got = selected(problem, {("target1", "sensor0"): none, ("target1", "sensor1"): none})
    assert got.targets == ("target0", "target2")
    assert not got.fixed
    assert set(got.priors) == {"target2"}
    assert rw.solve(got).certificate.is_certified
    one_pair = selected(problem, {("target1", "sensor0"): none})
    assert one_pair.targets == problem.targets
    assert ("target1", "sensor0") not in one_pair.pairs


def test_weights_multiply_squared_residuals() -> None:
    problem = rig(odometry=6, odometry_noise=NOISE)
    twice = {pair: np.full(problem.moments(*pair).count, 2.0) for pair in problem.pairs}
    solution = rw.solve(problem)
    assert rw.certify(reweighted(problem, twice), solution.X, solution.Y).cost == pytest.approx(2.0 * solution.cost)
    factors = reweighted(problem, {}, VarianceFactors(4.0, 9.0))
    raw, other = problem.measurements(*PAIR), factors.measurements(*PAIR)
    np.testing.assert_allclose(other.sigma, 3.0 * raw.sigma)
    np.testing.assert_allclose(other.kappa, raw.kappa / 4.0)
    zero_or_one = {pair: mask.astype(float) for pair, mask in masks(problem, 3).items()}
    assert_same_moments(reweighted(problem, zero_or_one), selected(problem, masks(problem, 3)))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_covariances_are_weighed_like_sigma_and_kappa(seed: int) -> None:
    generator = np.random.default_rng(seed)
    problem = rig()
    raw = problem.measurements(*PAIR)
    root = generator.standard_normal((12, 6, 6))
    problem.add(*PAIR, raw.A, raw.B, covariances=1e-4 * (root @ root.transpose(0, 2, 1) + np.eye(6)))
    w = generator.uniform(0.1, 3.0, 24)
    rotation, translation = generator.uniform(0.2, 5.0, 2)
    got = reweighted(problem, {PAIR: w}, VarianceFactors(rotation, translation)).measurements(*PAIR)
    whole = problem.measurements(*PAIR)
    block_rotation = whole.covariance_of_B()[:, :3, :3] * rotation / w[:, None, None]
    np.testing.assert_allclose(got.covariance_of_B()[:, :3, :3], block_rotation, rtol=1e-12)
    cross = whole.covariance_of_B()[:, :3, 3:] * np.sqrt(rotation * translation) / w[:, None, None]
    np.testing.assert_allclose(got.covariance_of_B()[:, :3, 3:], cross, rtol=1e-12)
    variances = np.einsum("nii->ni", got.covariance_of_B())
    np.testing.assert_allclose(got.sigma**2, variances[:, 3:].mean(axis=1), rtol=1e-12)
    np.testing.assert_allclose(got.kappa, 0.5 / variances[:, :3].mean(axis=1), rtol=1e-12)


def test_bad_input_is_refused_in_words() -> None:
    problem = rig()
    with pytest.raises(FrameError, match="no measurements of"):
        selected(problem, {("target9", "sensor0"): np.ones(12, dtype=bool)})
    with pytest.raises(CountError, match="give 12 booleans"):
        selected(problem, {PAIR: np.ones(11, dtype=bool)})
    with pytest.raises(CountError, match="give 12 booleans"):
        selected(problem, {PAIR: np.ones(12)})
    with pytest.raises(CountError, match="nothing is left"):
        selected(problem, {pair: np.zeros(12, dtype=bool) for pair in problem.pairs})
    with pytest.raises(CountError, match="give 12"):
        reweighted(problem, {PAIR: np.ones(3)})
    for bad in (-1.0, np.nan, np.inf):
        with pytest.raises(NoiseError, match="target0-sensor0"):
            reweighted(problem, {PAIR: np.full(12, bad)})
    with pytest.raises(NoiseError, match=r"rotation=0\.0"):
        reweighted(problem, {}, VarianceFactors(0.0, 1.0))
    with pytest.raises(MeasurementsNotKeptError, match="keep_measurements=True"):
        selected(rig(keep_measurements=False), {PAIR: np.ones(12, dtype=bool)})


def test_nothing_is_warned_of_again() -> None:
    problem = rw.Problem()
    whole = rig()
    raw = whole.measurements(*PAIR)
    off = raw.B.copy()
    off[:, :3, :3] *= 1.0 + 1e-7
    off[:, :3, 3] *= 1000.0
    with warnings.catch_warnings(record=True, action="always") as caught:
        problem.add(*PAIR, raw.A, off)
    assert caught
    with warnings.catch_warnings(action="error"):
        assert reweighted(problem, {PAIR: np.linspace(0.0, 1.0, 12)}).is_relative


def test_the_real_dataset_is_weighed_anew_in_milliseconds(utias_folder: object) -> None:
    problem = rw.read_csv(str(utias_folder))
    weights = {pair: np.full(problem.moments(*pair).count, 0.5) for pair in problem.pairs}
    times = []
    for _ in range(5):
        start = time.process_time()
        reweighted(problem, weights)
        times.append(time.process_time() - start)
    assert min(times) < 0.1
