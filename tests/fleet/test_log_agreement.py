"""Logs of which one puts a frame elsewhere are named; logs that agree are not."""

from __future__ import annotations

import numpy as np
import pytest
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.calibration import Finding, Ground
from gtsam_rwhec.fleet.log_agreement import disagreeing_logs
from gtsam_rwhec.fleet.unit_problem import UnitProblem
from gtsam_rwhec.simulate import Noise, general

LOGS = ("monday.mcap", "tuesday.mcap", "wednesday.mcap")
PER_LOG = 20


def findings(moved_m: float, seed: int) -> tuple[Finding, ...]:
    """What is found where the sensor is elsewhere in the last log."""
    made = general(2, 1, seed=seed, number_of_measurements=len(LOGS) * PER_LOG, noise=Noise(0.001, 1e4))
    problem, log_of = rw.Problem(), {}
    step = se3.expmap(np.array([[0.0, 0.0, 0.0, moved_m, 0.0, 0.0]]))[0]
    for pair in made.problem.pairs:
        raw = made.problem.measurements(*pair)
        log_of[pair] = np.repeat(np.arange(len(LOGS)), PER_LOG)
        B = np.where((log_of[pair] == 2)[:, None, None], np.linalg.inv(step) @ raw.B, raw.B)
        problem.add(*pair, raw.A, B)
    return disagreeing_logs(rw.calibrate(problem), UnitProblem(problem, None, (), None, log_of), LOGS)


@pytest.mark.parametrize("seed", range(5))
def test_logs_that_agree_are_not_doubted(seed: int) -> None:
    assert findings(0.0, seed) == ()


@pytest.mark.parametrize("seed", range(5))
def test_a_sensor_that_moved_between_logs_is_named_with_the_log(seed: int) -> None:
    (found,) = findings(0.02, seed)
    assert found.ground is Ground.COVARIANCE_DOUBTED
    assert "the logs disagree" in found.words
    assert "wednesday.mcap puts it" in found.words
