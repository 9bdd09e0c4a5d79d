"""From simulated measurements to the noise that they have, and to covariances that hold."""

from __future__ import annotations

from dataclasses import replace
from itertools import accumulate
from typing import Any

import numpy as np
import pytest
import synthetic_logs as logs
from noisy_rows import problem_of, random_poses, rows_of, task_of
from rwhec_factors import se3
from simulated_cells import CAMERA

import gtsam_rwhec as rw
from gtsam_rwhec.fitting import Component, NoiseOptions, refine_under_noise, under_noise
from gtsam_rwhec.fitting.component_posterior import SMALLEST, Mixture, Point, Sizes, fitted
from gtsam_rwhec.fitting.fit_options import About, Walk
from gtsam_rwhec.fitting.noise_likelihood import Estimate
from gtsam_rwhec.fitting.noise_search import Settled, Task
from gtsam_rwhec.fitting.unknowns import State

C = Component
X = se3.expmap(np.array([[0.2, -0.3, 0.1, 0.5, 0.4, 0.2]]))[0]
Y = se3.expmap(np.array([[1.2, 0.4, -0.6, 0.7, -0.4, 0.5]]))[0]


def twists(chance: np.random.Generator, count: int, rotation: float, translation: float) -> np.ndarray:
    size = np.repeat([rotation, translation], 3)
    found: np.ndarray = se3.expmap(size * chance.normal(size=(count, 6)))
    return found


def simulated(
    count: int = 80, *, seed: int = 0, of_A: tuple[float, float] = (0.0, 0.0), walk: tuple[float, float] = (0.0, 0.0)
) -> rw.Problem:
    """One pair: a board on a hand. B's noise is 2 mrad and 1 mm; A's is a twist of the hand; the sensor may drift."""
    chance = np.random.default_rng(seed)
    A = random_poses(chance, count, 0.7, 0.3)
    exact = np.linalg.inv(Y) @ A @ X
    drift = np.eye(4)
    B = np.empty_like(exact)
    for i, step in enumerate(twists(chance, count, *walk)):
        if i:
            motion = exact[i - 1] @ np.linalg.inv(exact[i])  # the sensor's, T_before_after
            drift = np.linalg.inv(motion) @ drift @ motion @ step
        B[i] = np.linalg.inv(drift) @ exact[i]
    B = B @ twists(chance, count, 0.002, 0.001)
    problem = rw.Problem()
    problem.add("board", "camera", A @ twists(chance, count, *of_A), B, stamps_ns=np.arange(count) * 10**8)
    return problem


def refined_under(
    problem: rw.Problem, options: NoiseOptions | None = None
) -> tuple[rw.Refined, rw.fitting.NoiseInData]:
    return refine_under_noise(problem, rw.solve(problem), options=options)


def test_noise_of_a_and_b_are_told_apart() -> None:
    refined, noise = refined_under(simulated(of_A=(0.004, 0.0001)))
    of = noise.deviations
    assert of[C.ROTATION].low < 0.0025
    assert of[C.CARRIER_ROTATION].value == pytest.approx(0.004, rel=0.2)
    assert noise.hand == "targetcarrier"
    assert noise.correlation is None
    assert not noise.has_systematic
    assert refined.contains("board", X, 0.9999)
    assert refined.contains("camera", Y, 0.9999)
    words = str(noise)
    assert words.startswith("Noise of B for each axis: ")
    assert "Noise of A for each axis: " in words
    assert "not found, and not excluded" in words


def test_a_drift_whose_own_optimum_is_worse_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """A rough fit promised it, and 196 poses of a tiny tag were USE 46 mm and 5 degrees off (6 mm and 3 without)."""
    settle = Task.settle

    def worse(task: Task, start: State, side: About, walk: Walk | None, **how: Any) -> Settled:
        found = settle(task, start, side, walk, **how)
        return found if walk is None else replace(found, fit=replace(found.fit, objective=found.fit.objective + 1e6))

    monkeypatch.setattr(Task, "settle", worse)
    assert refined_under(simulated(walk=(0.003, 0.002)))[1].correlation is None


@pytest.mark.parametrize("walk", [(0.003, 0.002), (0.0, 0.0)])
def test_a_short_log_whose_errors_drift_asks_for_care(walk: tuple[float, float]) -> None:
    """Of 19 stations of a drifting odometry the map was USE at chi2 62: a model of drift took 20."""
    calibration = rw.calibrate(simulated(18, walk=walk))
    assert (rw.Ground.CORRELATED in calibration.judgement.grounds) is (walk[0] > 0.0)
    assert ("18 instants are too few to tell how" in calibration.verdict_reason) is (walk[0] > 0.0)
    assert calibration.contains("board", X, 0.95)


@pytest.mark.parametrize("seed", [0, 10])
def test_an_odometry_is_a_random_walk_though_fading_errors_fit_it_nearly_as_well(seed: int) -> None:
    """The map was USE at chi2 56, and at 144 with care: a walk had to be better by 6, and its first fit stood still."""
    chance = np.random.default_rng(seed)
    at = np.linspace(0.0, 6.0, 40)[:, None] * chance.uniform(0.6, 3.0, 6) + chance.uniform(0.0, 6.0, 6)
    A = se3.expmap(np.sin(at) * np.repeat([0.7, 0.4], 3))
    exact = np.linalg.inv(np.linalg.inv(Y) @ A @ X)
    steps = np.linalg.inv(exact[:-1]) @ exact[1:] @ twists(chance, 39, 0.002, 0.002)
    seen = np.array(list(accumulate([exact[0], *steps], np.matmul)))
    problem = rw.Problem()
    B = np.linalg.inv(seen) @ twists(chance, 40, 0.001, 0.001)
    problem.add("map", "camera", A, B, stamps_ns=np.arange(40) * 10**8)
    calibration = rw.calibrate(problem)
    assert calibration.contains("map", X, 0.99)


def test_a_scale_that_runs_away_under_the_noise_is_not_told() -> None:
    """A camera turns and hardly moves, and its odometry drifts: the scale fell to 2e-5; it was 1e-11 on another log."""
    chance = np.random.default_rng(4)
    at = 0.15 * np.arange(50)[:, None] * chance.uniform(0.6, 1.6, 6) + chance.uniform(0.0, 6.0, 6)
    A = Y @ np.linalg.inv(se3.expmap(np.sin(at) * np.repeat([0.5, 0.01], 3)))
    drift = np.array(list(accumulate(twists(chance, 50, 0.005, 0.005 / 6.0), np.matmul)))
    B = np.linalg.inv(Y) @ A @ X @ drift
    B[:, :3, 3] *= 0.3
    problem = rw.Problem("shared")
    problem.add("map", "camera", A @ twists(chance, 50, 3e-3, 9e-4), B, stamps_ns=np.arange(50) * 150_000_000)
    judged = rw.calibrate(problem)
    assert judged.verdict is rw.Verdict.DO_NOT_USE
    assert "the motion does not tell the scale: it went from 0.28" in judged.verdict_reason
    assert judged.scale == pytest.approx(0.3, rel=0.1)


def test_a_random_walk_is_found_and_the_frames_are_worth_less() -> None:
    refined, noise = refined_under(simulated(walk=(0.003, 0.002)))
    assert (noise.correlation, noise.frame) == (1.0, "sensor")
    assert noise.drift_evidence > 50.0
    assert noise.deviations[C.DRIFT_ROTATION].value == pytest.approx(0.003, rel=0.3)
    assert noise.deviations[C.DRIFT_TRANSLATION].value == pytest.approx(0.002, rel=0.3)
    assert noise.worth < 60.0
    assert "80 frames are worth about" in str(noise)
    assert refined.keys["drift:79"] in list(refined.values.keys())
    plain = rw.refine(simulated(walk=(0.003, 0.002)), refined.solution, rw.RefineOptions(noise="estimate"))
    assert not plain.contains("camera", Y) or plain.covariance("camera").trace() > refined.covariance("camera").trace()


@pytest.mark.parametrize("frame", ["sensor", "target", "detection"])
def test_errors_that_fade_are_found_in_their_frame(frame: str) -> None:
    """The target's or the sensor's pose is off by errors of which 0.9 are left after each step."""
    chance = np.random.default_rng(5)
    A = random_poses(chance, 80, 0.7, 0.3)
    xi = np.zeros((80, 6))
    for i in range(80):
        xi[i] = (0.9 * xi[i - 1] if i else 0.0) + (1.0 if i == 0 else np.sqrt(0.19)) * chance.normal(size=6)
    fading = se3.expmap(xi * np.repeat([0.01, 0.005], 3))
    exact = np.linalg.inv(Y) @ A @ X
    B = fading @ exact if frame == "sensor" else exact @ fading
    if frame == "detection":
        B[:, :3, 3] = exact[:, :3, 3] + fading[:, :3, 3]
    B = B @ twists(chance, 80, 0.002, 0.001)
    problem = rw.Problem()
    problem.add("board", "camera", A, B, stamps_ns=np.arange(80) * 10**8)
    refined, noise = refined_under(problem)
    assert noise.frame == frame
    assert noise.correlation is not None
    assert 0.6 <= noise.correlation < 1.0
    assert ("of detections" if frame == "detection" else f"in the {frame}'s frame") in str(noise)
    assert refined.contains("board", X, 0.9999)
    assert refined.contains("camera", Y, 0.9999)


def test_options_overrule() -> None:
    problem = simulated(of_A=(0.004, 0.0001), count=40)
    stated = {C.CARRIER_ROTATION: 0.004, C.CARRIER_TRANSLATION: 0.0001}
    _, noise = refined_under(problem, NoiseOptions(stated=stated, side="sensorcarrier", drift="none", systematic=False))
    assert noise.hand == "sensorcarrier"
    assert noise.deviations[C.CARRIER_ROTATION].value == pytest.approx(0.004, rel=0.1)
    assert not noise.arms_assumed
    _, noise = refined_under(problem, NoiseOptions(carrier=False, drift="walk", systematic=False))
    assert C.CARRIER_ROTATION not in noise.deviations
    assert noise.correlation == 1.0


def test_noise_of_a_that_is_larger_than_all_residuals_is_no_error() -> None:
    stated = {C.CARRIER_ROTATION: 0.1, C.CARRIER_TRANSLATION: 0.05}
    _, noise = refined_under(simulated(40), NoiseOptions(stated=stated))
    assert noise.deviations[C.CARRIER_ROTATION].value == pytest.approx(0.1, rel=0.2)


def test_too_few_measurements_are_refused() -> None:
    problem = simulated(2)
    with pytest.raises(rw.errors.CountError, match="12 equations for 12 unknowns leave 0"):
        refine_under_noise(problem, rw.solve(problem))


def test_measurements_that_drift_explains_come_back_and_outliers_do_not() -> None:
    problem = simulated(walk=(0.003, 0.002))
    raw = problem.measurements("board", "camera")
    B = raw.B.copy()
    B[30:33] = B[30:33] @ twists(np.random.default_rng(3), 3, 0.5, 0.2)
    whole = rw.Problem()
    whole.add("board", "camera", raw.A, B, stamps_ns=raw.stamps_ns)
    first = np.ones(len(B), dtype=bool)
    first[25:45] = False
    kept = rw.Problem()
    kept.add("board", "camera", raw.A[first], B[first], stamps_ns=raw.stamps_ns[first])
    pair = rw.Pair("board", "camera")
    found = under_noise(kept, rw.solve(kept))
    assert np.flatnonzero(~found.agreeing(whole, {pair: first})[pair]).tolist() == [30, 31, 32]
    refined, noise = found.refined({pair: first})
    assert refined.inlier_counts[pair] == (60, 80)
    again, same = under_noise(kept, rw.solve(kept), before=found.settled).refined()
    assert same.correlation == noise.correlation
    assert again.X["board"].equals(refined.X["board"], 1e-4)


def test_measurements_of_one_standstill_share_an_instant() -> None:
    """An encoder's jitter does not make ten errors of A out of one."""
    chance = np.random.default_rng(0)
    stations = random_poses(chance, 12, 0.7, 0.3)
    wrong = stations @ twists(chance, 12, 0.003, 0.003)  # A's error, once a station
    A = np.repeat(wrong, 10, axis=0) @ twists(chance, 120, 1e-6, 3e-6)
    B = np.linalg.inv(Y) @ np.repeat(stations, 10, axis=0) @ X @ twists(chance, 120, 0.002, 0.001)
    problem = rw.Problem()
    problem.add("board", "camera", A, B, stamps_ns=np.arange(120) * 10**8)
    refined, noise = refined_under(problem)
    assert noise.instants == 12
    assert noise.deviations[C.CARRIER_TRANSLATION].value == pytest.approx(0.003, rel=0.4)
    assert not noise.has_systematic
    assert refined.contains("board", X, 0.999)


def test_thinned_rows_keep_the_time_between_instants() -> None:
    rows, *_ = rows_of(problem_of(2, 1, 11, shared=False))
    fewer = rows.thinned(3)
    assert fewer.instants.count == 8  # 4 of each track
    np.testing.assert_allclose(fewer.instants.step, [0.0, 3.0, 3.0, 3.0, 0.0, 3.0, 3.0, 3.0])
    np.testing.assert_array_equal(fewer.residual[4:], rows.residual[11::3])


def test_frames_that_thinned_rows_do_not_see_are_held() -> None:
    """One target is seen at a few instants of a dense log, all of which are thinned out."""
    chance = np.random.default_rng(0)
    A = random_poses(chance, 620, 0.7, 0.3)
    problem = rw.Problem()
    for name, rows in (("board", np.arange(620)), ("rare", np.arange(1, 620, 60))):
        B = np.linalg.inv(Y) @ A[rows] @ X @ twists(chance, len(rows), 0.002, 0.001)
        problem.add(name, "camera", A[rows], B, stamps_ns=rows * 10**8)
    refined, noise = refined_under(problem, NoiseOptions(systematic=False, drift="none"))
    assert noise.instants == 620
    assert np.isfinite(refined.covariance()).all()
    assert refined.contains("rare", X, 0.9999)


def test_a_component_is_held_where_it_is_stated_and_free_elsewhere() -> None:
    sizes = Sizes.of({C.ROTATION: 0.01, C.TRANSLATION: 0.004}, {C.ROTATION: 0.02})
    assert sizes.penalty(np.log([0.02, 0.3 * 0.004])) == pytest.approx(0.0, abs=1e-12)
    step = 1e-6
    at = np.log([0.021, 0.01])
    by_difference = [(sizes.penalty(at + step * e) - sizes.penalty(at - step * e)) / (2 * step) for e in np.eye(2)]
    np.testing.assert_allclose(sizes.penalty_gradient(at), by_difference, rtol=1e-6)
    assert sizes.penalty(np.log([0.03, 0.004])) > 100.0 > sizes.penalty(np.log([0.02, 0.1]))
    assert np.exp(sizes.bounds[1][0]) == pytest.approx(SMALLEST * 0.004)


@pytest.mark.parametrize("walk", [None, Walk(1.0, "sensor"), Walk(0.9, "target")])
def test_a_fit_ends_where_the_gradient_is_nothing_or_points_out_of_the_bounds(walk: Walk | None) -> None:
    problem = simulated(walk=(0.003, 0.002), of_A=(0.002, 0.001))
    task = task_of(problem, rw.solve(problem))
    model = task.model(task.variables.start(rw.solve(problem)), "targetcarrier", walk, systematic=True)
    sizes = task.sizes(model, systematic=True)
    fit = fitted(model, sizes, sizes.expected, enough=1e-9)
    end = Point.at(model, sizes, fit.logs)
    assert end.value == pytest.approx(fit.objective, rel=1e-12)
    low, high = np.array(sizes.bounds).T
    inside = (fit.logs > low) & (fit.logs < high)
    np.testing.assert_allclose(end.gradient[inside], 0.0, atol=1e-3)
    assert (end.gradient[fit.logs == low] > 0.0).all()
    for start in (sizes.expected - 2.0, sizes.expected + 2.0):
        assert fitted(model, sizes, start).objective == pytest.approx(fit.objective, abs=0.02)


def test_priors_of_frames_count() -> None:
    problem = simulated(30)
    loose = refined_under(problem)[0]
    problem.add_prior("camera", Y, sigma=1e-5, kappa=1e9)
    tight = refined_under(problem)[0]
    assert loose.covariance("camera").trace() > 10.0 * tight.covariance("camera").trace()
    np.testing.assert_allclose(tight.Y["camera"].matrix(), Y, atol=1e-4)


def test_the_constant_error_of_an_arm_is_in_the_frames_of_both_carriers() -> None:
    problem = simulated(30)
    with_it = refined_under(problem)[0]
    without = refined_under(problem, NoiseOptions(systematic=False))[0]
    for name in ("board", "camera"):
        added = with_it.covariance(name) - without.covariance(name)
        assert np.linalg.eigvalsh(added).max() > 0.05 * np.linalg.eigvalsh(without.covariance(name)).max()


def test_a_mixture_has_weights_and_quantiles() -> None:
    problem = simulated(15)
    refined, noise = refined_under(problem)
    for of in noise.deviations.values():
        assert 0.0 < of.low <= of.value <= of.high
    assert refined.degrees_of_freedom > 3.0


@pytest.mark.parametrize(("count", "seed"), [(10, 3), (12, 5), (12, 7), (15, 5)])
def test_errors_that_few_measurements_do_not_show_may_also_be_nothing(count: int, seed: int) -> None:
    """Before the data the 5 % quantile is e^-3.3 of the median, and nothing in the data speaks against small ones."""
    _, noise = refined_under(simulated(count, seed=seed, of_A=(0.002, 0.001)))
    assert not noise.has_systematic
    of = noise.deviations[C.SYSTEMATIC_ROTATION]
    assert of.low < 0.1 * of.value


def test_the_ellipsoid_is_the_average_of_models_with_and_without_an_arms_errors() -> None:
    """The share of the constant error falls with the probability that it is there, down to nothing."""
    chance = np.random.default_rng(5)
    root = np.diag(chance.uniform(0.5, 2.0, 3))
    estimates = tuple(Estimate(0.0, np.zeros(3), root @ root.T) for _ in range(8))
    mixture = Mixture(np.zeros(3), root @ root.T, np.zeros((8, 1)), np.full(8, 0.125), estimates)
    added = np.broadcast_to(3.0 * root, (8, 3, 3))
    shares = [mixture.share_of(np.eye(3), added, probability) for probability in (1.0, 0.5, 0.12, 0.0)]
    assert shares[0] == pytest.approx(1.0, abs=0.15)
    assert shares[0] > shares[1] > shares[2] > shares[3]
    assert shares[3] < 0.02


def hardly_tilting(seed: int, frames: int = 400) -> tuple[rw.Problem, np.ndarray]:
    """A vehicle that hardly tilts, tracked with white noise, and its camera's odometry, which walks."""
    chance = np.random.default_rng(seed)
    t = np.arange(frames) / 15.0
    frequency, phase = chance.uniform(0.02, 0.3, (4, 6)), chance.uniform(0.0, 6.0, (4, 6))
    twist = np.sin(2.0 * np.pi * frequency * t[:, None, None] + phase).sum(axis=1) * [0.004, 0.004, 0.8, 2.0, 2.0, 0.03]
    body = se3.pose(se3.expmap(twist * [1, 1, 1, 0, 0, 0])[:, :3, :3], twist[:, 3:])
    Y = random_poses(chance, 1, 0.6, 0.1)[0]
    camera = body @ Y
    steps = (
        np.linalg.inv(camera[:-1])
        @ camera[1:]
        @ se3.expmap(chance.normal(size=(frames - 1, 6)) * np.repeat([1e-4, 1e-3], 3))
    )
    walked = np.empty_like(camera)
    walked[0] = np.eye(4)
    for k, step in enumerate(steps):
        walked[k + 1] = walked[k] @ step
    noisy = (se3.expmap(chance.normal(size=(frames, 6)) * np.repeat([8e-4, 5e-4], 3)) for _ in range(2))
    problem = rw.Problem()
    A, B = (np.linalg.inv(T @ noise) for T, noise in zip((body, walked), noisy, strict=True))
    problem.add("map", "camera", A, B, stamps_ns=np.round(1e9 * t).astype(np.int64))
    return problem, Y


def test_noise_in_the_derivatives_is_no_information() -> None:
    """A's noise is in residuals and in their derivatives: together they say that a height is what it is taken to be."""
    problem, Y = hardly_tilting(0)
    squares = []
    for without in (True, False):
        with pytest.MonkeyPatch.context() as patch:
            if not without:
                patch.setattr(Task, "without_noise", lambda self, found: (self, found))
            refined, noise = refined_under(problem)
        assert noise.hand == "sensorcarrier"
        assert not noise.has_systematic  # the evidence is that of the side that was chosen in the end
        error = se3.logmap((np.linalg.inv(refined.Y["camera"].matrix()) @ Y)[None])[0]
        squares.append(float(error @ np.linalg.solve(refined.covariance("camera"), error)))
    assert squares[0] < 12.6 < squares[1], squares


def test_a_wall_of_small_tags_along_a_path_that_walks() -> None:
    """Their noise is of their own axes, most of it along the ray: about other axes it ended 80 to 190 mm off."""
    chance, frames, size = np.random.default_rng(1), 23, 0.5 * 0.05
    square = size * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
    exact = np.array([logs.hand(1.0 + i) for i in range(frames)])
    hands = exact @ np.array(list(accumulate(twists(chance, frames, np.radians(0.01), 4e-4), np.matmul)))
    problem = rw.Problem()
    for row, column in np.ndindex(5, 5):
        at = (0.08 * (row - 2), 0.08 * (column - 2), chance.normal(0.0, 5e-3))
        tag = logs.pose(chance.normal(0.0, 3.0, 3), at)
        for name, T_hand_camera in logs.Y.items():
            T = se3.inverse(exact @ T_hand_camera) @ tag
            P = square @ T[:, :3, :3].mT + T[:, None, :3, 3]
            px = chance.normal(CAMERA.project(P), 0.1)
            seen = ((px > 0.0) & (px < (CAMERA.width, CAMERA.height))).all(axis=(1, 2))
            stamps = 10**9 * np.flatnonzero(seen)
            A = se3.inverse(hands[seen])
            problem.add_corners(
                f"tag_{row}{column}", name, A, px[seen], square, CAMERA, corner_px=0.1, stamps_ns=stamps
            )
    refined, _ = refined_under(problem)
    for name, T in logs.Y.items():
        assert refined.contains(name, T, 0.9999)
