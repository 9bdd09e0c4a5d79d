"""Late clocks are found in the residuals and estimated; clocks that are right are left alone."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.clock_test import FEWEST, clocks_of
from gtsam_rwhec.geometry.poses import Array

SIGMA_RAD, SIGMA_M, STEP_S = np.radians(0.3), 0.003, 0.1


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


@pytest.mark.parametrize("late_s", [0.004, 0.03, -0.07])
def test_a_late_clock_is_found_and_estimated(late_s: float) -> None:
    """70 ms at 10 Hz look like rows that are shifted by one; the stamps say that the clock is late."""
    problem, Y = moving(0, late_s)
    calibration = rw.calibrate(problem)
    assert calibration.verdict is rw.Verdict.USE
    sigma_s = np.sqrt(calibration.covariance("time_offset:cam")[0, 0])
    assert calibration.time_offsets_s["cam"] == pytest.approx(late_s, abs=max(4.0 * sigma_s, 2e-4))
    assert calibration.contains("cam", Y, 0.9999)
    assert why_of(calibration).chosen == "estimated for cam"


def test_clocks_that_are_right_are_left_alone() -> None:
    """Offsets over their standard deviations are those of a t distribution, and none is called late."""
    ratios = []
    for seed in range(12):
        problem, _ = moving(seed, count=60)
        calibration = rw.calibrate(problem, rw.CalibrateOptions(time_offsets=False, robust="none", misreadings=False))
        assert calibration.refined is not None
        (test,), without = clocks_of(problem, calibration.refined)
        assert not without
        assert not test.is_late
        ratios.append(test.offset_s / test.sigma_s)
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 2.0


def test_what_cannot_be_tested_says_why() -> None:
    problem, _ = moving(1, 0.03, stamped=False)
    assert "cam cannot be tested, as it has no stamps" in why_of(rw.calibrate(problem)).evidence
    few, _ = moving(1, count=FEWEST - 1)
    assert f"it has fewer than {FEWEST} measurements" in why_of(rw.calibrate(few)).evidence
    late, _ = moving(1, 0.03)
    told = rw.calibrate(late, rw.CalibrateOptions(time_offsets=False))
    assert why_of(told).evidence == "an option says so"
    assert told.time_offsets_s == {}
