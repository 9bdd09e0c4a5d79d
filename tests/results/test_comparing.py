"""What changed from one calibration to the next: two logs, a camera that was knocked, and what cannot be compared."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2
from two_logs import KNOCKED, calibrated, log_of

import gtsam_rwhec as rw
from gtsam_rwhec.errors import FileFormatError, FrameError, OptionError
from gtsam_rwhec.fitting.unknowns import Unknown
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
