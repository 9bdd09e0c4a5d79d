"""Time offsets as variables, and the twists that they move A along."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from refinement_problems import KAPPA, SIGMA_M, refined
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import Noise, perturb
from gtsam_rwhec.twists import carrier_twists

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
    twists[shuffled] = carrier_twists(trajectory(t[shuffled]), stamps[shuffled], "here")
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


def test_only_the_sensors_named() -> None:
    r = refined(problem_with({"cam0": 0.02, "cam1": 0.0}), time_offsets=("cam0",))
    assert list(r.time_offsets_s) == ["cam0"]
    assert "time_offset:cam1" not in r.names


def test_robust_losses_and_carrier_noise_go_with_offsets() -> None:
    problem = problem_with({"cam0": 0.03}, count=80)
    for options in (
        {"robust": "huber"},
        {"carrier_noise": rw.CarrierNoise(rotation_rad=1e-3, translation_m=1e-3)},
    ):
        r = refined(problem, time_offsets=True, **options)
        assert r.time_offsets_s["cam0"] == pytest.approx(0.03, abs=0.003)


def test_an_offset_that_nothing_tells_has_infinite_variance() -> None:
    """A constant twist, a screw: moving along it is what X and Y do too."""
    stamps = np.arange(60) * 50_000_000
    twist = np.array([0.0, 0.0, 0.5, 0.1, 0.0, 0.05])
    A = se3.expmap((stamps * 1e-9)[:, None] * twist)
    problem = rw.Problem()
    B = perturb(np.linalg.inv(Y["cam0"]) @ A @ X, Noise(SIGMA_M, KAPPA), 0)
    problem.add("tag", "cam0", A, B, SIGMA_M, KAPPA, stamps_ns=stamps)
    r = refined(problem, time_offsets=True)
    assert r.covariance("time_offset:cam0")[0, 0] == np.inf or np.sqrt(r.covariance("time_offset:cam0")[0, 0]) > 10.0


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"stamps_ns": None}, rw.errors.CountError, "tag-cam0: a time offset needs stamps"),
        ({"stamps_ns": np.zeros(20, dtype=np.int64)}, rw.errors.CountError, "two measurements have the stamp 0 ns"),
        (
            {"stamps_ns": np.arange(20) * 5 * 10**9},
            rw.errors.CountError,
            "measurement at 0 ns has no other within 1 s",
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
    with pytest.raises(rw.errors.FrameError, match="names 'cam9', which is no sensor; there are cam0"):
        refined(problem_with({"cam0": 0.0}, count=20), time_offsets=("cam9",))
