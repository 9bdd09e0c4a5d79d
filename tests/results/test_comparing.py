"""What changed from one calibration to the next: two logs, a camera that was knocked; the test's chances and groups."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2, f
from two_logs import KNOCKED, calibrated, log_of

import gtsam_rwhec as rw
from gtsam_rwhec.errors import FileFormatError, FrameError, OptionError
from gtsam_rwhec.fitting.unknowns import Unknown
from gtsam_rwhec.results.change_test import ChangeTest, change_test
from gtsam_rwhec.results.changed_frames import without_constant_errors
from gtsam_rwhec.results.log_history import CleaningReport, DetectionReport, LogFields
from gtsam_rwhec.results.result_file import Result
from gtsam_rwhec.results.schema import CalibrationFields
from gtsam_rwhec.simulate.simulated_rigs import Motion


@pytest.fixture(scope="module")
def old() -> rw.Calibration:
    return calibrated(log_of(0))


@pytest.fixture(scope="module")
def same() -> rw.Calibration:
    return calibrated(log_of(1))


@pytest.fixture(scope="module")
def knocked() -> rw.Calibration:
    return calibrated(log_of(2, knocked="left"))


def result_of(of: rw.Calibration, /, **changed: object) -> Result:
    assert of.solution is not None
    result = Result(of.solution, of.refined, None)
    return dataclasses.replace(result, **changed)  # type: ignore[arg-type]


def log_fields(sensors: str = "hand", targets: str = "base") -> LogFields:
    return LogFields(
        sensor_carrier=sensors,
        target_carrier=targets,
        detection=DetectionReport(sources=("a.mcap",), images={}, undecoded={}, tracks=(), strangers={}, corner_px={}),
        cleaning=CleaningReport(tracks=(), time_offsets_s={}, coarse_sigma_s={}),
        outliers=(),
        sizes=(),
        time_offsets=(),
    )


def test_nothing_changed(old: rw.Calibration, same: rw.Calibration) -> None:
    found = rw.results.difference(old, same)
    assert not found.has_changed
    assert found.test is not None
    assert found.test.dimension == 24
    assert str(found).startswith("Nothing changed by more than chance at 1 %: the two differ by ")


def test_a_knocked_camera_is_named_with_its_movement(old: rw.Calibration, knocked: rw.Calibration) -> None:
    found = rw.results.difference(old, knocked)
    assert found.test is not None
    assert found.test.changed == ("left",)
    assert found.movements["left"].translation_mm == pytest.approx(10.0, abs=2.0)
    assert found.movements["left"].rotation_deg == pytest.approx(np.degrees(0.005), abs=0.1)
    assert str(found).startswith("Changed: left moved ")
    assert str(found).endswith("more than chance at 1 %.")


def test_one_frame_is_tested_by_the_sum_of_both_covariances(old: rw.Calibration, knocked: rw.Calibration) -> None:
    found = rw.results.difference(old, knocked, frames=["left"])
    xi = rw.pose_covariances.error_of(old.Y["left"], knocked.Y["left"])
    square = xi @ np.linalg.solve(old.covariance("left") + knocked.covariance("left"), xi)
    assert found.test is not None
    assert found.test.deviations**2 == pytest.approx(square, rel=0.02)  # the difference is no vector, by 0.005 rad
    assert found.test.chance == pytest.approx(chi2.sf(found.test.deviations**2, 6))


def test_what_is_free_is_named_and_not_compared(old: rw.Calibration) -> None:
    planar = calibrated(log_of(3, motion=Motion("planar")))
    found = rw.results.difference(old, planar)
    assert any(remark.startswith("NEW leaves free: translation") for remark in found.remarks)
    assert found.test is not None
    assert found.test.dimension == 23
    assert not found.has_changed


def test_the_same_answer_is_no_change(old: rw.Calibration) -> None:
    assert str(rw.results.difference(old, old)) == "Nothing changed: both are the same answer, number by number."


def test_the_same_measurements_are_not_tested(old: rw.Calibration) -> None:
    assert old.solution is not None
    with_other_noise = rw.refine(log_of(0), old.solution, rw.RefineOptions(noise="estimate"))
    found = rw.results.difference(old, result_of(old, refined=with_other_noise))
    assert found.test is None
    assert "both rest on the same measurements" in str(found)


def test_without_covariances_movements_are_all_there_is(old: rw.Calibration, knocked: rw.Calibration) -> None:
    found = rw.results.difference(result_of(old, refined=None), knocked)
    assert found.test is None
    assert "OLD has no covariances" in found.why_no_test
    assert found.movements["left"].translation_mm == pytest.approx(10.0, abs=2.0)


def test_frames_that_only_one_has_are_named(old: rw.Calibration) -> None:
    found = rw.results.difference(old, calibrated(log_of(4, sensors=("left",))))
    assert "only OLD has right" in found.remarks
    assert "right" not in found.movements


def test_the_constant_error_of_an_arm_is_no_difference(old: rw.Calibration) -> None:
    """A Expmap(c) in place of A moves the targets by Ad(X^-1) c in both logs; the covariance of each has it."""
    refined = old.refined
    assert refined is not None
    deviations = np.repeat([0.002, 0.001], 3)
    shift = np.zeros((len(refined.joint.unit), 6))
    for name, pose in refined.X.items():
        shift[refined.joint.slots[Unknown.of(name)]] = pose.inverse().AdjointMap() * deviations
    joint = dataclasses.replace(refined.joint, finite=refined.joint.finite + shift @ shift.T)
    fields = CalibrationFields((), (), (), "", "", (), constant_errors=(tuple(deviations), (0.0,) * 6))
    result = result_of(old, refined=dataclasses.replace(refined, joint=joint), calibration=fields)
    beside = without_constant_errors(result)
    assert np.allclose(beside.joint.finite, refined.joint.finite, rtol=1e-6, atol=1e-14)
    too_much = CalibrationFields((), (), (), "", "", (), constant_errors=(tuple(2.0 * deviations), (0.0,) * 6))
    assert without_constant_errors(dataclasses.replace(result, calibration=too_much)) is result.refined


def test_a_calibration_says_the_constant_error_that_its_covariance_has(old: rw.Calibration) -> None:
    assert CalibrationFields.of(old).constant_errors == ()  # the noise was given, and no arm was assumed


@pytest.mark.parametrize(
    ("carriers", "said"), [(("flange", "base"), "sensor carrier"), (("hand", "table"), "target carrier")]
)
def test_other_carriers_are_refused(
    old: rw.Calibration, same: rw.Calibration, carriers: tuple[str, str], said: str
) -> None:
    with pytest.raises(FrameError, match=f"{said}.*different rigs"):
        rw.results.difference(result_of(old, log=log_fields()), result_of(same, log=log_fields(*carriers)))


def test_other_rigs_are_refused(old: rw.Calibration) -> None:
    assert old.refined is not None
    other = dataclasses.replace(old.refined, X={"table": old.X["board"]}, Y={"head": old.Y["left"]})
    with pytest.raises(FrameError, match="no frame is in both: OLD has left, right, board, tag, NEW has head, table"):
        rw.results.difference(old, result_of(old, refined=other))


def test_exchanged_roles_are_refused(old: rw.Calibration) -> None:
    assert old.refined is not None
    turned = dataclasses.replace(old.refined, X=old.Y, Y=old.X)
    with pytest.raises(FrameError, match="a target in one of the two and a sensor in the other"):
        rw.results.difference(old, result_of(old, refined=turned))


def test_frames_that_are_not_there_are_refused(old: rw.Calibration, same: rw.Calibration) -> None:
    with pytest.raises(FrameError, match="both must have 'midle'"):
        rw.results.difference(old, same, frames=["midle"])


def test_what_is_no_calibration_is_refused(old: rw.Calibration) -> None:
    with pytest.raises(OptionError, match="a calibration to compare is a str"):
        rw.results.difference(old, "result.json")  # type: ignore[arg-type]


def test_files_and_folders_are_read(tmp_path: Path, old: rw.Calibration) -> None:
    rw.write_calibration(old, tmp_path / "result.json")
    for path in (tmp_path, tmp_path / "result.json"):
        assert str(rw.results.difference(old, rw.results.read_calibration(path))).startswith(
            "Nothing changed: both are"
        )
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileFormatError, match="has no result"):
        rw.results.read_calibration(tmp_path / "empty")


def test_known_movement() -> None:
    moved = rw.results.Movement.of(KNOCKED, KNOCKED.compose(KNOCKED))
    assert moved.translation_mm == pytest.approx(10.0)
    assert moved.rotation_deg == pytest.approx(np.degrees(0.005))


NOTHING_FREE = np.zeros((12, 0))
GROUPS = {"camera": slice(0, 6), "board": slice(6, 12)}


def covariance_of(seed: int, size: int = 12) -> np.ndarray:
    """A covariance with correlations."""
    root = np.random.default_rng(seed).standard_normal((size, size + 2))
    return root @ root.T


def compared(difference: np.ndarray, free: np.ndarray = NOTHING_FREE, freedom: float = np.inf) -> ChangeTest:
    return change_test(difference, (covariance_of(0), covariance_of(1)), free, GROUPS, (freedom, freedom))


def test_the_joint_statistic_is_the_mahalanobis_distance_of_the_difference() -> None:
    difference = np.random.default_rng(2).standard_normal(12)
    found = compared(difference)
    square = difference @ np.linalg.solve(covariance_of(0) + covariance_of(1), difference)
    assert found.deviations**2 == pytest.approx(square)
    assert found.joint_chance == pytest.approx(chi2.sf(square, 12))


def test_a_group_is_compared_by_its_own_covariance_with_its_correlations() -> None:
    difference = np.random.default_rng(2).standard_normal(12)
    own = (covariance_of(0) + covariance_of(1))[6:, 6:]
    assert compared(difference).groups["board"].deviations ** 2 == pytest.approx(
        difference[6:] @ np.linalg.solve(own, difference[6:])
    )


def test_one_group_alone_has_the_chance_of_its_own_square() -> None:
    C = covariance_of(3, 6)
    difference = np.linalg.cholesky(2.0 * C) @ np.r_[4.5, np.zeros(5)]
    found = change_test(difference, (C, C), np.zeros((6, 0)), {"camera": slice(0, 6)}, (np.inf, np.inf))
    assert found.chance == pytest.approx(chi2.sf(4.5**2, 6))
    assert found.has_changed
    assert found.changed == ("camera",)


def test_noise_that_was_estimated_makes_chances_larger() -> None:
    difference = 6.0 * np.random.default_rng(2).standard_normal(12)
    found = compared(difference, freedom=20.0)
    shares = 1.0 / found.degrees_of_freedom
    assert 1.0 / 40.0 <= shares <= 1.0 / 20.0  # Welch and Satterthwaite: between both and one of them
    assert found.joint_chance == pytest.approx(f.sf(found.deviations**2 / 12, 12, found.degrees_of_freedom))
    assert found.joint_chance > compared(difference).joint_chance


def test_a_change_along_a_free_direction_is_none() -> None:
    free = np.random.default_rng(4).standard_normal((12, 2))
    difference = np.random.default_rng(5).standard_normal(12)
    moved = difference + 100.0 * free @ [1.0, -2.0]
    assert compared(moved, free).dimension == 10
    assert compared(moved, free).deviations == pytest.approx(compared(difference, free).deviations, rel=1e-6)


def test_the_group_that_explains_everything_is_named() -> None:
    C = covariance_of(0) + covariance_of(1)
    difference = np.zeros(12)
    difference[:6] = 6.0 * np.linalg.cholesky(C[:6, :6])[:, 0]
    found = compared(difference)
    assert found.changed == ("camera",)
    assert found.groups["camera"].explains
    assert not found.groups["board"].explains


def test_chances_are_corrected_for_their_number_as_holm_does() -> None:
    found = compared(np.random.default_rng(6).standard_normal(12))
    ordered = sorted(found.groups.values(), key=lambda group: group.chance)
    assert ordered[0].corrected == pytest.approx(min(1.0, 2.0 * ordered[0].chance))
    assert ordered[1].corrected == pytest.approx(max(ordered[0].corrected, ordered[1].chance))


def test_the_alarm_is_raised_as_often_as_the_level_says() -> None:
    chance = np.random.default_rng(7)
    C = covariance_of(0) + covariance_of(1)
    drawn = (np.linalg.cholesky(C) @ chance.standard_normal((12, 16))).T
    found = [change_test(d, (C, 0.0 * C), NOTHING_FREE, GROUPS, (np.inf, np.inf), level=0.5) for d in drawn]
    assert 2 <= sum(one.has_changed for one in found) <= 14  # 8 of 16, within three deviations


@pytest.mark.parametrize("level", [0.0, 1.0, -0.1, "0.01", float("nan"), True])
def test_levels_that_are_none_are_refused(level: object) -> None:
    with pytest.raises(OptionError, match="give one between 0 and 1"):
        change_test(np.zeros(12), (covariance_of(0),) * 2, NOTHING_FREE, GROUPS, (np.inf, np.inf), level)  # type: ignore[arg-type]
