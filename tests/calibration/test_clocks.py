"""Which clocks are worth estimating: motion between the stamps decides, not the stamps alone."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from board_by_camera import poses, problem_of
from rwhec_factors import se3
from said import choice

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.clock_offsets import FEWEST_STAMPS, Clock, offsets_worth_estimating
from gtsam_rwhec.fitting import clock_rates
from gtsam_rwhec.fitting.noise_refinement import under_noise
from gtsam_rwhec.geometry import Trajectory
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.selection import selected
from gtsam_rwhec.simulate import Noise, perturb
from gtsam_rwhec.simulate.simulated_noise import random_poses

X, Y = random_poses(2, 0.5, np.random.default_rng(0))
SIGMA_RAD, SIGMA_M, STEP_S = np.radians(0.3), 0.003, 0.1
NOISE = Noise(0.003, 0.5 / np.radians(0.3) ** 2)


def road(t: np.ndarray) -> np.ndarray:
    """A motion about all axes; the fastest part takes two seconds."""
    frequency, phase = np.array([1.1, 0.8, 1.9, 0.9, 1.3, 3.1]), np.arange(6.0)
    return se3.expmap(np.array([0.4, 0.4, 0.3, 0.3, 0.2, 0.1]) * np.sin(frequency * t[:, None] + phase))


def logged(hertz: float = 100.0) -> Trajectory:
    stamps = np.round(np.arange(-200.0, 6000.0) * 1e9 / hertz).astype(np.int64)
    return Trajectory.of(stamps[stamps < 60 * 10**9], road(stamps[stamps < 60 * 10**9] * 1e-9))


def clock(
    seconds: np.ndarray,
    *,
    offset_s: float = 0.0,
    seed: int = 0,
    scale: str = "known",
    path: Trajectory | None = None,
    noise_of_A: float = 3e-4,
) -> Clock:
    """The decision for measurements at these times, which were paired with an offset that nobody knows of."""
    generator = np.random.default_rng(seed)
    A = road(seconds) @ se3.expmap(noise_of_A * generator.normal(size=(len(seconds), 6)))
    B = perturb(np.linalg.inv(Y) @ road(seconds + offset_s) @ X, NOISE, generator)
    if scale != "known":
        B[:, :3, 3] *= 2.0
    problem = rw.Problem(scale)
    problem.add("tag", "cam", A, B, stamps_ns=np.round(seconds * 1e9).astype(np.int64))
    (found,) = offsets_worth_estimating(problem, rw.solve(problem), path)
    return found


@pytest.mark.parametrize("scale", ["known", "shared", "per_target"])
def test_a_stream_tells(scale: str) -> None:
    found = clock(np.arange(300) / 30.0, offset_s=0.01, scale=scale)
    assert found.is_worth_estimating
    assert found.offset_s == pytest.approx(0.01, abs=4.0 * found.sigma_s)
    assert found.sigma_s < 0.001
    assert str(found).startswith("The clock of cam is estimated, because motion tells it to +-")


def test_keyframes_close_to_one_another_tell() -> None:
    seconds = np.cumsum(np.random.default_rng(1).uniform(0.05, 0.2, 120))
    found = clock(seconds, offset_s=0.008)
    assert found.is_worth_estimating
    assert found.offset_s == pytest.approx(0.008, abs=4.0 * found.sigma_s)


def test_stations_do_not_tell_but_a_logged_path_does() -> None:
    far = clock(np.arange(15) * 3.0)
    assert not far.is_worth_estimating
    assert "path about its stamps is not known (3 s apart)" in far.evidence
    near = clock(np.cumsum(np.random.default_rng(2).uniform(0.7, 0.99, 40)))
    assert not near.is_worth_estimating
    assert "how they moved between stamps 0.85 s apart is not known" in near.evidence
    path = logged()
    seconds = np.cumsum(np.random.default_rng(2).uniform(0.7, 0.99, 40))
    along = clock(seconds, offset_s=0.004, path=path, noise_of_A=0.0)
    assert along.is_worth_estimating
    assert along.offset_s == pytest.approx(0.004, abs=4.0 * along.sigma_s)


def test_standstill_does_not_tell() -> None:
    stops = np.repeat(np.arange(12) * 4.1, 8)
    stamps = np.concatenate([np.arange(8) * 33_333_333 + k * 4 * 10**9 for k in range(12)])
    generator = np.random.default_rng(3)
    A = road(stops) @ se3.expmap(3e-4 * generator.normal(size=(96, 6)))
    problem = rw.Problem()
    problem.add("tag", "cam", A, perturb(np.linalg.inv(Y) @ road(stops) @ X, NOISE, generator), stamps_ns=stamps)
    (found,) = offsets_worth_estimating(problem, rw.solve(problem))
    assert not found.is_worth_estimating
    assert "the carriers stood still" in found.evidence


def test_what_has_no_stamps_or_too_few_is_said() -> None:
    problem = rw.Problem()
    seconds = np.arange(30) / 10.0
    B = np.linalg.inv(Y) @ road(seconds) @ X
    problem.add("tag", "cam", road(seconds), B)
    problem.add("tag", "late", road(seconds[:5]), B[:5], stamps_ns=np.arange(5) * 10**8)
    cam, late = offsets_worth_estimating(problem, rw.solve(problem))
    assert cam.evidence == "its measurements have no stamps"
    assert late.evidence == "5 stamps are too few for an offset"
    assert str(late) == "The clock of late is taken as right, because 5 stamps are too few for an offset."


def test_an_offset_beyond_the_path_is_left_to_the_streams() -> None:
    found = clock(np.arange(600) / 30.0, offset_s=0.9)
    assert not (found.is_worth_estimating and abs(found.offset_s) > 0.5)


def test_outliers_do_not_decide() -> None:
    seconds = np.arange(300) / 30.0
    generator = np.random.default_rng(4)
    B = perturb(np.linalg.inv(Y) @ road(seconds + 0.006) @ X, NOISE, generator)
    B[:30] = random_poses(30, 0.5, generator)
    problem, good = rw.Problem(), rw.Problem()
    stamps = np.round(seconds * 1e9).astype(np.int64)
    problem.add("tag", "cam", road(seconds), B, stamps_ns=stamps)
    good.add("tag", "cam", road(seconds[30:]), B[30:], stamps_ns=stamps[30:])
    (found,) = offsets_worth_estimating(problem, rw.solve(good))
    assert found.is_worth_estimating
    assert found.offset_s == pytest.approx(0.006, abs=0.002)


@pytest.mark.campaign
def test_the_first_estimates_standard_deviation_holds() -> None:
    seconds = np.arange(300) / 30.0
    found = [clock(seconds, offset_s=0.005, seed=seed) for seed in range(200)]
    held = [abs(c.offset_s - 0.005) < 1.96 * c.sigma_s for c in found]
    assert np.mean(held) > 0.89


def moving(seed: int, late_s: float = 0.0, count: int = 120, *, stamped: bool = True) -> tuple[rw.Problem, gtsam.Pose3]:
    """A carrier on a smooth path at 10 Hz, and T_sensorcarrier_sensor: the stamp t is the carriers' t + late_s."""
    rng = np.random.default_rng(seed)
    X, Y = (gtsam.Pose3.Expmap(size * rng.standard_normal(6)) for size in (1.0, 0.3))
    hertz, phase = rng.uniform(0.1, 0.4, (6, 2)), rng.uniform(0.0, 6.0, (6, 2))
    size = np.r_[np.full(3, 0.5), np.full(3, 0.3)]

    def A(seconds: Array) -> Array:
        xi = size * np.sin(2.0 * np.pi * hertz * seconds[:, None, None] + phase).sum(axis=2)
        return np.array([gtsam.Pose3.Expmap(each).matrix() for each in xi])

    seconds = STEP_S * np.arange(count)
    noise = np.r_[np.full(3, SIGMA_RAD), np.full(3, SIGMA_M)] * rng.standard_normal((count, 6))
    exact = np.linalg.inv(Y.matrix()) @ A(seconds + late_s) @ X.matrix()
    B = exact @ np.array([gtsam.Pose3.Expmap(xi).matrix() for xi in noise])
    problem = rw.Problem()
    stamps = np.round(1e9 * seconds).astype(np.int64) if stamped else None
    problem.add("tag", "cam", A(seconds), B, stamps_ns=stamps)
    return problem, Y


def why_of(calibration: rw.Calibration) -> rw.Choice:
    return next(choice for choice in calibration.choices if choice.what == "time offsets")


@pytest.mark.parametrize("late_s", [0.0, 0.004, -0.07])
def test_a_late_clock_is_found_and_estimated(late_s: float) -> None:
    """70 ms at 10 Hz look like rows that are shifted by one; one of 0 has its share in the covariances."""
    problem, Y = moving(0, late_s)
    calibration = rw.calibrate(problem)
    assert calibration.verdict is rw.Verdict.USE
    sigma_s = np.sqrt(calibration.covariance("time_offset:cam")[0, 0])
    assert calibration.time_offsets_s["cam"] == pytest.approx(late_s, abs=max(4.0 * sigma_s, 2e-4))
    assert calibration.contains("cam", Y, 0.9999)
    assert why_of(calibration).chosen == "estimated for cam"


def test_calibrate_says_why_an_offset_is_not_estimated() -> None:
    problem, _ = moving(1, 0.03, count=30, stamped=False)
    assert why_of(rw.calibrate(problem)).evidence == "the measurements have no stamps"
    few, _ = moving(1, count=FEWEST_STAMPS - 1)
    assert why_of(rw.calibrate(few)).evidence == f"cam: {FEWEST_STAMPS - 1} stamps are too few for an offset"
    late, _ = moving(1, 0.03, count=30)
    told = rw.calibrate(late, rw.CalibrateOptions(time_offsets=False))
    assert why_of(told).evidence == "an option says so"
    assert told.time_offsets_s == {}


def test_without_stamps_the_words_say_that_it_may_be_a_clock() -> None:
    """Its errors vary with the motion, as those of an arm do, or fade as drift does."""
    g, t = np.random.default_rng(0), np.arange(120) * STEP_S
    B = perturb(np.linalg.inv(Y) @ road(t + 0.04) @ X, NOISE, g)
    unstamped, stamped = rw.Problem(), rw.Problem()
    unstamped.add("tag", "cam", road(t), B)
    stamped.add("tag", "cam", road(t), B, stamps_ns=np.round(t * 1e9).astype(np.int64))
    found = rw.calibrate(unstamped)
    assert rw.Ground.SYSTEMATIC in found.judgement.grounds
    assert "it may also be a late clock" in found.verdict_reason
    told = rw.calibrate(stamped, rw.CalibrateOptions(time_offsets=False, misreadings=False))
    assert "it may also be a late clock" not in told.verdict_reason


def test_a_late_clock_that_was_taken_as_right_is_not_passed_over() -> None:
    options = rw.CalibrateOptions(time_offsets=False, misreadings=False)
    late = rw.calibrate(moving(0, 0.03)[0], options)
    assert late.judgement.grounds == (rw.Ground.LATE_CLOCK,)
    assert "the clock of cam was taken as right, but motion tells it to" in late.verdict_reason
    assert rw.calibrate(moving(0)[0], options).verdict is rw.Verdict.USE


def test_the_clock_of_a_sensor_that_the_option_leaves_out_is_not_passed_over() -> None:
    """A tuple names the sensors whose offsets are estimated; the others count as right, and are asked too."""
    problem = rw.Problem()
    for sensor, late_s in (("cam", 0.0), ("late", 0.03)):
        raw = moving(0, late_s, count=40)[0].measurements("tag", "cam")
        problem.add("tag", sensor, raw.A, raw.B, stamps_ns=raw.stamps_ns)
    found = rw.calibrate(problem, rw.CalibrateOptions(time_offsets=("cam",), misreadings=False))
    assert rw.Ground.LATE_CLOCK in found.judgement.grounds
    assert "the clock of late was taken as right, but motion tells it to" in found.verdict_reason
    assert "the clock of cam" not in found.verdict_reason
    assert list(found.time_offsets_s) == ["cam"]
    assert rw.Ground.LATE_CLOCK not in rw.calibrate(problem, rw.CalibrateOptions(time_offsets=True)).judgement.grounds


def stream_with(rate: float, seed: int) -> rw.Problem:
    """A stream of half a minute, whose clock is 5 ms late in its middle, and too slow by a rate."""
    seconds = np.arange(300) / 10.0 + 0.5
    late_s = 0.005 + rate * (seconds - seconds.mean())
    stamps = np.round(seconds * 1e9).astype(np.int64)
    true = np.linalg.inv(Y) @ road(seconds + late_s) @ X
    B = perturb(true, Noise(0.001, 0.5 / np.radians(0.1) ** 2), np.random.default_rng(seed))
    problem = rw.Problem()
    problem.add("tag", "cam", logged().at(stamps)[0], B, stamps_ns=stamps)
    return problem


def rate_found(found: rw.Calibration) -> clock_rates.ClockRate:
    assert found.noise.model is not None
    (clock,) = found.noise.model.clocks
    return clock


ALONG = rw.CalibrateOptions(carrier_path=logged(), time_offsets=True)


@pytest.mark.parametrize("rate", [4e-4, -1e-4])
def test_a_stretched_clock_is_found_and_taken_off(rate: float) -> None:
    found = rw.calibrate(stream_with(rate, 1), ALONG)
    clock = rate_found(found)
    assert clock.is_sure
    assert clock.rate == pytest.approx(rate, abs=4.0 * clock.deviation)
    assert found.time_offsets_s["cam"] == pytest.approx(0.005, abs=2e-4)
    assert found.verdict is rw.Verdict.USE
    assert found.contains("cam", Y)
    assert choice(found, "rate of the clock of cam").evidence == str(clock)


def test_a_right_clock_is_not_accused() -> None:
    found = rw.calibrate(stream_with(0.0, 2), ALONG)
    assert not rate_found(found).is_sure
    assert found.outliers.number == 0
    assert found.contains("cam", Y)


def test_a_rate_that_is_an_unknown_costs_nothing() -> None:
    """The deviations are at most 2 % larger than with a rate that is known."""
    problem = stream_with(0.0, 3)
    found = under_noise(problem, rw.solve(problem), ALONG.refinement(time_offsets=True)).settled
    C = found.model.evaluate(found.fit.sizes.values(found.fit.logs)).covariance  # the rate is its last direction
    known = C[:-1, :-1] - np.outer(C[:-1, -1], C[:-1, -1]) / C[-1, -1]
    assert (np.diagonal(C)[:-1] <= 1.02**2 * np.diagonal(known)).all()


def test_without_a_path_or_with_few_stamps_no_rate_is_an_unknown() -> None:
    seconds = np.arange(200) / 10.0
    problem = rw.Problem()
    problem.add("tag", "cam", road(seconds), road(seconds), stamps_ns=np.round(seconds * 1e9).astype(np.int64))
    assert clock_rates.clocks_with_rate(problem, ("cam",), logged()) == {"cam": 9_950_000_000}
    assert clock_rates.clocks_with_rate(problem, ("cam",), None) == {}
    assert clock_rates.clocks_with_rate(problem, (), logged()) == {}
    few = selected(problem, {problem.pairs[0]: np.arange(200) < 99})
    assert clock_rates.clocks_with_rate(few, ("cam",), logged()) == {}


@pytest.mark.parametrize("share", [0.0, 0.01])
def test_poses_that_were_logged_before_a_move_ended_are_named(share: float) -> None:
    """Noise of A and systematic errors held them in part: 6 of 40 were USE, and no word said why others were not."""
    chance = np.random.default_rng(1)
    A = poses(chance, 20, 0.8, 0.3)
    B = np.linalg.inv(Y) @ A @ X @ poses(chance, 20, 1e-3, 4e-4)
    back = se3.logmap(np.linalg.inv(A[1:]) @ A[:-1])
    A[1:] = A[1:] @ se3.expmap(share * back)
    judgement = rw.calibrate(problem_of(A, B)).judgement
    assert (rw.Ground.LATE_POSES in judgement.grounds) is (share > 0.0)
    assert ("each A of board-camera is 1 % of the way to the pose before it" in judgement.reason) is (share > 0.0)


def on_a_path(late_s: float, *, count: int, seed: int, noise: float, walk: float = 0.0) -> rw.Problem:
    """Poses and views every 0.4 s without stamps, the poses of ``late_s`` later."""
    chance = np.random.default_rng(seed)
    faster, phase = chance.uniform(1.0, 2.5, 6), chance.uniform(0.0, 6.0, 6)

    def path(at: np.ndarray) -> np.ndarray:
        return np.asarray(se3.expmap(np.sin(at[:, None] * faster + phase) * ([0.5] * 3 + [0.2] * 3)))

    at = np.arange(count) * 0.4
    drift = se3.expmap(walk * np.cumsum(chance.normal(size=(count, 6)), axis=0)) if walk else np.eye(4)
    B = np.linalg.inv(Y) @ path(at) @ X @ drift @ poses(chance, count, noise, 0.4 * noise)
    return problem_of(path(at + late_s), B)


@pytest.mark.parametrize(("late_s", "walk"), [(0.03, 0.0), (0.0, 0.0), (0.0, 2e-3)])
def test_a_late_clock_without_stamps_is_named_and_drift_is_not_taken_for_one(late_s: float, walk: float) -> None:
    """Residuals of few such views are small: USE, and 2 degrees off where 0.2 were claimed."""
    judgement = rw.calibrate(on_a_path(late_s, count=12, seed=2, noise=1e-3, walk=walk)).judgement
    assert (rw.Ground.LATE_POSES in judgement.grounds) is (late_s > 0.0)
    assert ("% of a row later than its B" in judgement.reason) is (late_s > 0.0)


def test_a_late_clock_that_is_less_than_sure_is_in_the_covariance() -> None:
    """Neither was in its ellipsoid of 99 %: the lag shows at 3.65 deviations, below the bar."""
    found = rw.calibrate(on_a_path(0.03, count=7, seed=24, noise=6e-3))
    assert found.verdict is rw.Verdict.USE
    assert found.contains("camera", Y, 0.99)
    assert found.contains("board", X, 0.99)
