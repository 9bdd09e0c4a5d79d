"""The least known direction of a frame is that of which motion tells least; the named motion does what it says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.report.determined_section import determines_section
from gtsam_rwhec.report.report_blocks import Listing, plain_text
from gtsam_rwhec.report.report_page import read_shown
from gtsam_rwhec.results.linear_model import measured_rows
from gtsam_rwhec.results.weak_poses import MORE, TURN_RAD, WeakDirection, weak_directions

SIGMA_M, SIGMA_RAD = 0.002, np.radians(0.2)
OPTIONS = rw.CalibrateOptions(noise="given", robust="none", drift="none", systematic=False, misreadings=False)
X = se3.expmap(np.array([[0.2, -0.1, 0.4, 0.5, 0.1, -0.3]]))[0]
Y = se3.expmap(np.array([[-0.3, 0.5, 0.1, 0.05, -0.02, 0.1]]))[0]


def problem(A: np.ndarray) -> rw.Problem:
    """Measurements of one pair at A, with noise."""
    generator = np.random.default_rng(3)
    noise = generator.standard_normal((len(A), 6)) * np.repeat([SIGMA_RAD, SIGMA_M], 3)
    problem = rw.Problem()
    problem.add("board", "cam", A, se3.inverse(Y[None]) @ A @ X @ se3.expmap(noise), SIGMA_M, 0.5 / SIGMA_RAD**2)
    return problem


def mostly_about_z() -> np.ndarray:
    """Carrier poses that turn widely about z, and a little about the other axes."""
    generator = np.random.default_rng(0)
    turns = generator.uniform(-1.0, 1.0, (40, 3)) * np.array([0.08, 0.08, 1.2])
    return se3.expmap(np.hstack([turns, generator.uniform(-0.2, 0.2, (40, 3))]))


def weak_of(A: np.ndarray) -> dict[tuple[str, str], WeakDirection]:
    of = problem(A)
    calibration = rw.calibrate(of, OPTIONS)
    return {(one.frame, one.kind): one for one in weak_directions(calibration, measured_rows(of, calibration))}


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
def test_the_axis_of_the_motion_is_weak_and_the_motion_across_it_helps_as_said() -> None:
    A = mostly_about_z()
    found = weak_of(A)[("cam", "translation")]
    assert abs(found.axis_in_carrier[2]) > 0.95
    assert found.turn is not None
    assert found.turn[2] == 0.0
    assert found.after_turning is not None
    assert found.after_more is not None
    # The same measurements for real, about the target in the middle of all.
    seen = (se3.inverse(Y[None]) @ A @ X)[:, :3, 3]
    middle = A[np.argmin(np.linalg.norm(seen - np.median(seen, axis=0), axis=1))]
    turns = np.tile([TURN_RAD, -TURN_RAD], MORE // 2)[:, None] * np.array(found.turn)
    turned = se3.expmap(np.hstack([turns, np.zeros_like(turns)]))
    place = (middle @ X)[:3, 3]
    turned[:, :3, 3] = place - turned[:, :3, :3] @ place
    calibration = rw.calibrate(problem(np.concatenate([A, turned @ middle])), OPTIONS)
    axis = np.array(found.axis)
    after = 1e3 * np.sqrt(axis @ calibration.covariance("cam")[3:, 3:] @ axis)
    assert after == pytest.approx(found.after_turning, rel=0.1)
    assert found.after_turning < 0.7 * found.after_more < found.deviation


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
def test_the_report_says_the_weak_direction_and_the_turn(tmp_path: Path) -> None:
    of = problem(mostly_about_z())
    calibration = rw.calibrate(of, OPTIONS)
    rw.write_calibration(calibration, tmp_path / "result.json")
    rw.results.write_evidence(rw.results.evidence_of(of, calibration), tmp_path / "evidence.json")
    said = [
        plain_text(item)
        for block in determines_section(read_shown(tmp_path)).blocks
        if isinstance(block, Listing)
        for item in block.items
    ]
    assert len(said) == 2
    for sentence in said:
        assert "along" in sentence
        assert "carrier's z axis: ± 5.1 mm. Turn by 30 degrees to both sides about sensorcarrier's" in sentence
        assert ", with board in view of cam: 10 measurements would bring it to about ± 1.2 mm" in sentence


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
def test_frames_with_free_directions_are_left_out() -> None:
    A = mostly_about_z()
    A[:, :3, :3] = np.eye(3)
    assert weak_of(A) == {}
