"""Time offsets as variables, and the carriers' twists."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from refinement_problems import KAPPA, SIGMA_M, refined
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.geometry import Trajectory
from gtsam_rwhec.geometry.trajectory import LocalPaths
from gtsam_rwhec.simulate import Noise, perturb
from gtsam_rwhec.simulate.simulated_noise import random_poses

X = gtsam.Pose3.Expmap(np.array([0.3, 0.1, -0.4, 1.0, 0.5, 0.2])).matrix()
Y = {
    "cam0": gtsam.Pose3.Expmap(np.array([-1.0, 0.2, 0.3, 0.1, 0.0, 0.05])).matrix(),
    "cam1": gtsam.Pose3.Expmap(np.array([0.5, 0.9, 0.0, -0.1, 0.2, 0.0])).matrix(),
}


def trajectory(t: np.ndarray) -> np.ndarray:
    """A(t): a smooth motion about all axes, T_rig_world."""
    xi = np.column_stack(
        [
            0.8 * np.sin(0.9 * t),
            0.6 * np.cos(0.7 * t),
            0.7 * np.sin(1.1 * t + 1.0),
            0.5 * np.cos(0.8 * t),
            0.4 * np.sin(1.3 * t),
            0.3 * np.cos(0.5 * t),
        ]
    )
    return se3.expmap(xi)


def problem_with(offsets_s: dict[str, float], count: int = 200, noise: bool = True) -> rw.Problem:
    """Stamps at 20 Hz; B seen at the stamp plus the offset."""
    stamps = np.arange(count) * 50_000_000
    problem = rw.Problem()
    for k, (name, offset) in enumerate(offsets_s.items()):
        B = np.linalg.inv(Y[name]) @ trajectory(stamps * 1e-9 + offset) @ X
        B = perturb(B, Noise(SIGMA_M, KAPPA), k) if noise else B
        problem.add("tag", name, trajectory(stamps * 1e-9), B, SIGMA_M, KAPPA, stamps_ns=stamps)
    return problem


def test_twists_are_the_trajectorys_velocity() -> None:
    t = np.arange(100) * 0.02
    stamps = (t * 1e9).astype(np.int64)
    shuffled = np.random.default_rng(0).permutation(100)
    twists = np.empty((100, 6))
    twists[shuffled] = LocalPaths.of(trajectory(t[shuffled]), stamps[shuffled], "here").twists()
    h = 1e-5
    expected = se3.logmap(se3.inverse(trajectory(t - h)) @ trajectory(t + h)) / (2 * h)
    np.testing.assert_allclose(twists[1:-1], expected[1:-1], atol=2e-3)
    np.testing.assert_allclose(twists[[0, -1]], expected[[0, -1]], atol=0.05)  # one side alone


def test_offsets_are_found_with_their_standard_deviations() -> None:
    truth = {"cam0": 0.035, "cam1": -0.012}
    problem = problem_with(truth)
    r = refined(problem, time_offsets=True)
    without = refined(problem)
    for name, offset in truth.items():
        deviation = np.sqrt(r.covariance(f"time_offset:{name}")[0, 0])
        assert deviation < 0.001
        assert abs(r.time_offsets_s[name] - offset) < 4.0 * deviation
        assert r.contains(name, Y[name], 0.999)
    assert r.cost < 0.5 * without.cost
    # Joint with the poses: seven rows, and an offset is correlated with the pose it would otherwise bend.
    assert r.covariance("cam0", "time_offset:cam0").shape == (7, 7)


def test_offsets_of_the_named_sensors_only() -> None:
    r = refined(problem_with({"cam0": 0.02, "cam1": 0.0}), time_offsets=("cam0",))
    assert list(r.time_offsets_s) == ["cam0"]
    assert "time_offset:cam1" not in r.names


def test_robust_losses_and_carrier_noise_go_with_offsets() -> None:
    problem = problem_with({"cam0": 0.03}, count=80)
    for options in ({"robust": "huber"}, {"carrier_noise": rw.CarrierNoise(rotation_rad=1e-3, translation_m=1e-3)}):
        r = refined(problem, time_offsets=True, **options)
        assert r.time_offsets_s["cam0"] == pytest.approx(0.03, abs=0.003)


def test_an_undetermined_offset_has_infinite_variance() -> None:
    """A constant twist, a screw: moving along it is what X and Y do too."""
    stamps = np.arange(60) * 50_000_000
    twist = np.array([0.0, 0.0, 0.5, 0.1, 0.0, 0.05])
    A = se3.expmap((stamps * 1e-9)[:, None] * twist)
    problem = rw.Problem()
    B = perturb(np.linalg.inv(Y["cam0"]) @ A @ X, Noise(SIGMA_M, KAPPA), 0)
    problem.add("tag", "cam0", A, B, SIGMA_M, KAPPA, stamps_ns=stamps)
    r = refined(problem, time_offsets=True)
    assert r.covariance("time_offset:cam0")[0, 0] == np.inf or np.sqrt(r.covariance("time_offset:cam0")[0, 0]) > 10.0


@pytest.mark.parametrize("noise_of_A", [0.0, 1e-6, 1e-4, 1e-3])
def test_stop_and_go_motion_does_not_determine_an_offset(noise_of_A: float) -> None:
    """The carrier stood at every stamp; noise in its poses looks like motion."""
    generator = np.random.default_rng(1)
    stops = np.repeat(trajectory(np.arange(10) * 1.7), 6, axis=0)
    stamps = np.array([int((5.0 * k + 0.1 * j) * 1e9) for k in range(10) for j in range(6)])
    B = perturb(np.linalg.inv(Y["cam0"]) @ stops @ X, Noise(SIGMA_M, KAPPA), generator)
    A = perturb(stops, Noise(noise_of_A, 0.5 / noise_of_A**2), generator) if noise_of_A else stops
    problem = rw.Problem()
    problem.add("tag", "cam0", A, B, SIGMA_M, KAPPA, stamps_ns=stamps)
    r = refined(problem, time_offsets=True)
    assert r.covariance("time_offset:cam0")[0, 0] == np.inf
    assert any(direction.time_offsets_s == {"cam0": 1.0} for direction in r.free_directions)
    assert r.contains("cam0", Y["cam0"], 0.9999)


def test_noise_in_the_carriers_poses_does_not_pull_an_offset_to_zero() -> None:
    """At 30 Hz the noise in differences of neighbouring poses is five times the true motion."""
    noise, scores = 0.003, []
    for seed in range(6):
        generator = np.random.default_rng(seed)
        stamps = np.arange(400) * 33_333_333
        t = 0.3e-9 * stamps
        A = perturb(trajectory(t), Noise(noise, 0.5 / noise**2), generator)
        B = perturb(np.linalg.inv(Y["cam0"]) @ trajectory(t + 0.3 * 0.03) @ X, Noise(0.003, 5e4), generator)
        problem = rw.Problem()
        problem.add("tag", "cam0", A, B, 0.003, 5e4, stamps_ns=stamps)
        r = refined(problem, time_offsets=True, carrier_noise=rw.CarrierNoise(noise, noise))
        scores.append((r.time_offsets_s["cam0"] - 0.03) / np.sqrt(r.covariance("time_offset:cam0")[0, 0]))
    assert np.sqrt(np.mean(np.square(scores))) < 2.0


@pytest.mark.parametrize("offset_s", [0.02, 0.1])
def test_large_offsets_leave_no_bias_in_the_poses(offset_s: float) -> None:
    """The carrier accelerates: the first twist alone would leave an error of second order in the poses."""
    held = []
    for seed in range(8):
        stamps = np.arange(300) * 100_000_000
        B = np.linalg.inv(Y["cam0"]) @ trajectory(1e-9 * stamps + offset_s) @ X
        problem = rw.Problem()
        noisy = perturb(B, Noise(SIGMA_M, KAPPA), seed)
        problem.add("tag", "cam0", trajectory(1e-9 * stamps), noisy, SIGMA_M, KAPPA, stamps_ns=stamps)
        r = refined(problem, time_offsets=True)
        held.append(r.contains("cam0", Y["cam0"], 0.95))
    assert np.mean(held) > 0.7


def test_outliers_and_an_offset_together() -> None:
    generator = np.random.default_rng(0)
    raw = problem_with({"cam0": 0.03}).measurements("tag", "cam0")
    B = raw.B.copy()
    bad = generator.random(len(B)) < 0.3
    B[bad] = random_poses(int(bad.sum()), 2.0, generator)
    problem = rw.Problem()
    problem.add("tag", "cam0", raw.A, B, SIGMA_M, KAPPA, stamps_ns=raw.stamps_ns)
    r = refined(problem, time_offsets=True, robust="gnc", noise="given")
    inliers = r.inliers["tag", "cam0"]
    assert not inliers[bad].any()
    assert inliers[~bad].mean() > 0.95
    assert r.time_offsets_s["cam0"] == pytest.approx(0.03, abs=0.002)


def test_the_motion_at_a_rarely_seen_tag_comes_from_other_tags() -> None:
    often = problem_with({"cam0": 0.02}).measurements("tag", "cam0")
    rare = np.arange(3, 200, 45)
    problem = rw.Problem()
    problem.add("tag", "cam0", often.A, often.B, SIGMA_M, KAPPA, stamps_ns=often.stamps_ns)
    stamps = often.stamps_ns[rare]
    problem.add("rare", "cam0", often.A[rare], often.B[rare], SIGMA_M, KAPPA, stamps_ns=stamps)
    assert refined(problem, time_offsets=True).time_offsets_s["cam0"] == pytest.approx(0.02, abs=0.002)


def test_time_offsets_with_motions_are_refused() -> None:
    problem = problem_with({"cam0": 0.0}, count=20)
    raw = problem.measurements("tag", "cam0")
    problem.add_motion("cam0", raw.A, raw.A, SIGMA_M, KAPPA, stamps_ns=raw.stamps_ns)
    with pytest.raises(rw.errors.OptionError, match="cam0 has motions of its own"):
        refined(problem, time_offsets=True)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"stamps_ns": None}, rw.errors.CountError, "tag-cam0: a time offset needs stamps"),
        (
            {"stamps_ns": np.zeros(20, dtype=np.int64)},
            rw.errors.CountError,
            "two different carrier poses have the stamp 0 ns",
        ),
        (
            {"stamps_ns": np.arange(20) * 5 * 10**9},
            rw.errors.CountError,
            "measurement at 0 ns and 19 others of 20 have no other measurement within 1 s",
        ),
    ],
)
def test_bad_stamps(change: dict[str, object], error: type[Exception], words: str) -> None:
    raw = problem_with({"cam0": 0.0}, count=20).measurements("tag", "cam0")
    problem = rw.Problem()
    problem.add("tag", "cam0", raw.A, raw.B, SIGMA_M, KAPPA, **change)
    with pytest.raises(error, match=words):
        refined(problem, time_offsets=True)


def test_unknown_sensor() -> None:
    with pytest.raises(rw.errors.FrameError, match="names 'cam9', which is not a sensor; give any of cam0"):
        refined(problem_with({"cam0": 0.0}, count=20), time_offsets=("cam9",))


def fast_path(noise: tuple[float, float] = (0.0, 0.0), seed: int = 0) -> Trajectory:
    """The carriers' path at 100 Hz, with noise in each pose (rad, m)."""
    stamps = np.arange(-100, 2200) * 10_000_000
    xi = np.random.default_rng(seed).normal(size=(len(stamps), 6)) * np.repeat(noise, 3)
    return Trajectory.of(stamps, trajectory(stamps * 1e-9) @ se3.expmap(xi))


def slow_problem(path: Trajectory, offset_s: float, seed: int = 0) -> rw.Problem:
    """Three targets seen at 2 Hz by one camera whose stamps are early: too slow to tell how the carriers move."""
    stamps = np.arange(40) * 500_000_000
    problem = rw.Problem()
    for k in range(3):
        target = gtsam.Pose3.Expmap(np.array([0.2 * k, -0.3, 0.1, 0.5 - 0.5 * k, 0.3, 0.1 * k])).matrix()
        B = np.linalg.inv(Y["cam0"]) @ trajectory(stamps * 1e-9 + offset_s) @ target
        problem.add(
            f"tag{k}", "cam0", path.at(stamps)[0], perturb(B, Noise(SIGMA_M, KAPPA), 10 * seed + k), SIGMA_M, KAPPA,
            stamps_ns=stamps,
        )  # fmt: skip
    return problem


def test_twists_along_a_path_are_its_velocity() -> None:
    stamps = np.arange(40) * 500_000_000 + 3_000_000
    twists = LocalPaths.along(fast_path(), stamps).twists()
    t, h = stamps * 1e-9, 1e-5
    expected = se3.logmap(se3.inverse(trajectory(t - h)) @ trajectory(t + h)) / (2 * h)
    np.testing.assert_allclose(twists, expected, atol=1e-4)
    with pytest.raises(rw.errors.CountError, match="at least four"):
        LocalPaths.along(fast_path(), np.array([90_000_000_000]))


def test_a_path_of_the_inverse_is_refused() -> None:
    path = fast_path()
    with pytest.raises(rw.errors.OptionError, match="inverse of A"):
        refined(
            slow_problem(path, 0.004), time_offsets=True,
            carrier_path=Trajectory.of(path.stamps_ns, np.linalg.inv(path.T)),
        )  # fmt: skip


def test_a_logged_path_determines_the_offset_of_a_slow_camera() -> None:
    problem = slow_problem(fast_path(), 0.004)
    r = refined(problem, time_offsets=True, carrier_path=fast_path())
    deviation = np.sqrt(r.covariance("time_offset:cam0")[0, 0])
    assert deviation < 0.001
    assert abs(r.time_offsets_s["cam0"] - 0.004) < 4.0 * deviation


def test_offset_with_carrier_poses_that_targets_share() -> None:
    noise = (0.002, 0.004)
    squares = []
    for seed in range(12):
        path = fast_path(noise, seed)
        r = refined(
            slow_problem(path, 0.003, seed), time_offsets=True, carrier_path=path, carrier_noise=rw.CarrierNoise(*noise)
        )
        xi = se3.logmap(np.linalg.inv(Y["cam0"])[None] @ r.Y["cam0"].matrix())[0]
        off = r.time_offsets_s["cam0"] - 0.003
        squares.append(float(xi @ r.information("cam0") @ xi) + off**2 / r.covariance("time_offset:cam0")[0, 0])
    # Seven degrees of freedom: the mean of twelve has a standard deviation of 1.1; without sharing it is beyond 13.
    assert 4.0 < np.mean(squares) < 10.5
