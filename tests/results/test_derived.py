"""Evidence that follows from a calibration: derived numbers, the spectrum of Z, the least known directions."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from places import REPOSITORY
from refinement_problems import rig
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.report.determined_section import determines_section
from gtsam_rwhec.report.report_blocks import Listing, plain_text
from gtsam_rwhec.report.report_page import read_shown
from gtsam_rwhec.results.derived import DISTANCES_M, Derived, clock_effects, derived_of
from gtsam_rwhec.results.linear_model import measured_rows
from gtsam_rwhec.results.proof_spectrum import proof_of
from gtsam_rwhec.results.weak_poses import MORE, TURN_RAD, WeakDirection, weak_directions


@pytest.fixture(scope="module")
def calibration() -> rw.Calibration:
    return rw.calibrate(rig(targets=2, sensors=3).problem)


@pytest.fixture(scope="module")
def derived(calibration: rw.Calibration) -> Derived:
    return derived_of(calibration)


def test_points_are_those_of_uncertainty_at(calibration: rw.Calibration, derived: Derived) -> None:
    assert len(derived.points) == 3 * (len(DISTANCES_M) + 1)
    for point in derived.points:
        seen = np.array(calibration.views[point.sensor].point_m)
        at = seen * point.distance_m / np.linalg.norm(seen)
        assert point.radius_mm == pytest.approx(calibration.uncertainty_at(at, point.sensor).radius_mm, rel=1e-9)
        assert point.is_seen == (point.distance_m not in DISTANCES_M)


def test_sensors_are_in_the_frame_of_the_first(calibration: rw.Calibration, derived: Derived) -> None:
    first = min(calibration.Y)
    assert [one.second for one in derived.relative] == sorted(set(calibration.Y) - {first})
    for one in derived.relative:
        pose, covariance = calibration.relative(first, one.second)
        assert one.translation_m == pytest.approx(pose.translation())
        assert one.deviations_mm == pytest.approx(1e3 * np.sqrt(np.diagonal(covariance)[3:]))


def test_scales_have_their_deviations() -> None:
    calibration = rw.calibrate(rig(targets=1, sensors=2, scale="shared").problem)
    (scale,) = derived_of(calibration).scalars
    assert (scale.kind, scale.owner) == ("scale", "")
    assert scale.value == calibration.scale
    assert scale.deviation == pytest.approx(math.sqrt(calibration.covariance("scale")[0, 0]))


def test_a_clock_moves_poses_as_the_best_poses_of_another_offset_do() -> None:
    refined = rw.read_refined(REPOSITORY / "tests" / "golden" / "result_scales.json")
    frames = [Unknown.of(name) for name in (*refined.X, *refined.Y)]
    unknowns = (*frames, Unknown(UnknownKind.TIME_OFFSET, "sensor0"))
    size = 6 * len(frames) + 1
    J = np.random.default_rng(0).standard_normal((3 * size, size))
    information = J.T @ J
    joint = JointCovariance.of(unknowns, information, np.zeros((size, 0)), np.ones(size))
    found = list(clock_effects(replace(refined, joint=joint)))
    assert {one.frame for one in found} == {*refined.X, *refined.Y}
    # The poses of least cost where the offset is 1 ms away: information_pp x = -information_po 1e-3.
    best = np.linalg.solve(information[:-1, :-1], -1e-3 * information[:-1, -1])
    for one in found:
        omega, v = best[joint.slots[Unknown.of(one.frame)]].reshape(2, 3)
        assert one.rotation_deg == pytest.approx(math.degrees(np.linalg.norm(omega)))
        assert one.translation_mm == pytest.approx(1e3 * np.linalg.norm(v))


def test_a_proven_answer_has_one_zero_and_no_negative_eigenvalue() -> None:
    problem = rig().problem
    solution = rw.solve(problem)
    proof = proof_of(solution, problem)
    (part,) = proof.parts
    assert part.rows == 9 * 4 + 1
    assert part.eigenvalues is not None
    assert part.rounding is not None
    assert len(part.eigenvalues) == part.rows
    assert abs(part.eigenvalues[0]) <= part.rounding
    assert part.eigenvalues[1] > 1e6 * part.rounding
    assert proof.gap == solution.certificate.gap


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
def test_turns_about_one_axis_leave_more_zeros() -> None:
    angles = np.linspace(-1.0, 1.0, 12)
    A = np.tile(np.eye(4), (len(angles), 1, 1))
    A[:, :3, :3] = [[[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]] for a in angles]
    A[:, 2, 3] = np.random.default_rng(0).uniform(-1.0, 1.0, len(angles))
    planar = rw.Problem()
    planar.add("board", "cam", A, A, 0.001, 1e4)
    (part,) = proof_of(rw.solve(planar), planar).parts
    assert part.eigenvalues is not None
    assert part.rounding is not None
    assert sum(abs(value) <= 100.0 * part.rounding for value in part.eigenvalues) > 1


def test_of_other_measurements_there_is_no_spectrum() -> None:
    solution = rw.solve(rig().problem)
    (part,) = proof_of(solution, rig(seed=1).problem).parts
    assert part.eigenvalues is None
    assert part.why_not.startswith("the proof is of other measurements than these, or of other weights")
    assert part.gap == solution.certificate.gap


SIGMA_M, SIGMA_RAD = 0.002, np.radians(0.2)
OPTIONS = rw.CalibrateOptions(
    noise="given", robust="none", drift="none", systematic=False, misreadings=False, sizes="known"
)
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
