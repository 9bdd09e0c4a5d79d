"""Rig files that contradict each other are named, both places; so are logs of which one puts a frame elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
from fleets import rig_text
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.calibration import Finding, Ground
from gtsam_rwhec.fleet.unit_problem import UnitProblem, check_rigs, disagreeing_logs
from gtsam_rwhec.rig import Rig, parse_rig
from gtsam_rwhec.simulate import Noise, general

LOGS = ("monday.mcap", "tuesday.mcap", "wednesday.mcap")
PER_LOG = 20
CAMS = ["cam_0"]


def rig(text: str = "", **changed: float) -> Rig:
    return parse_rig(text or rig_text(CAMS, 2, **changed), "rig.yaml")  # type: ignore[arg-type]


def test_those_that_agree() -> None:
    more = rig(rig_text(["cam_0", "cam_1"], 3))
    check_rigs({"a": [("a.yaml", rig()), ("b.yaml", more)], "b": [("c.yaml", rig())]})


def test_a_targets_size() -> None:
    with pytest.raises(rw.errors.RigError, match=r"target tag_0 differs between a\.yaml and b\.yaml \(size_m: 0\.12 "):
        check_rigs({"a": [("a.yaml", rig())], "b": [("b.yaml", rig(size_m=0.1))]})


def test_a_cameras_intrinsics_within_a_robot_but_not_on_a_site() -> None:
    other = rig(focal=500.0)
    with pytest.raises(rw.errors.RigError, match=r"sensor cam_0 has other intrinsics in b\.yaml than in a\.yaml"):
        check_rigs({"a": [("a.yaml", rig()), ("b.yaml", other)]})
    check_rigs({"a": [("a.yaml", rig())], "b": [("b.yaml", other)]})


def test_the_carrier_of_targets_and_how_sizes_are_taken() -> None:
    text = rig_text(CAMS, 2).replace("base", "floor").replace("sizes: known", "sizes: estimate")
    with pytest.raises(rw.errors.RigError) as caught:
        check_rigs({"a": [("a.yaml", rig())], "b": [("s3://user:word@store/b.yaml", rig(text))]})
    assert "is base in a.yaml and floor in s3://store/b.yaml" in str(caught.value)
    assert "sizes is known in a.yaml and estimate in" in str(caught.value)
    assert "word" not in str(caught.value)


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


@pytest.mark.parametrize("seed", range(3))
def test_logs_that_agree_are_not_doubted(seed: int) -> None:
    assert findings(0.0, seed) == ()


@pytest.mark.parametrize("seed", range(3))
def test_a_sensor_that_moved_between_logs_is_named_with_the_log(seed: int) -> None:
    (found,) = findings(0.02, seed)
    assert found.ground is Ground.COVARIANCE_DOUBTED
    assert "the logs disagree" in found.words
    assert "wednesday.mcap puts it" in found.words
