"""Result files of ``calibrate``: what it found and chose is read back, and the verdict counts it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from refinement_problems import copied, rig

import gtsam_rwhec as rw
from gtsam_rwhec.results.result_file import read_result


@pytest.fixture(scope="module")
def calibration() -> rw.Calibration:
    problem = rig().problem
    problem.sensor_carrier, problem.target_carrier = "hand", "base"
    return rw.calibrate(problem)


def test_it_is_read_back(calibration: rw.Calibration, tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    rw.write_calibration(calibration, path)
    result = read_result(path)
    assert result.judgement == calibration.judgement
    assert result.calibration is not None
    assert result.calibration.choices == calibration.choices
    assert [str(point) for point in result.calibration.points] == [str(p) for p in calibration.points.values()]
    assert result.refined is not None
    np.testing.assert_array_equal(result.refined.covariance("sensor0"), calibration.covariance("sensor0"))
    raw = json.loads(path.read_text(encoding="utf-8"))
    assert raw["verdict"] == "use"
    assert raw["verdict_reason"] == calibration.verdict_reason
    assert raw["calibration"]["choices"][0]["sentence"] == str(calibration.choices[0])
    assert {row["parent"] for row in raw["sensors"]} == {"hand"}
    assert {row["parent"] for row in raw["targets"]} == {"base"}


def test_a_finding_decides_the_verdict_and_cannot_be_taken_out(tmp_path: Path) -> None:
    problem = rig().problem
    misread = copied(problem, A=lambda pair, raw: np.linalg.inv(raw.A))
    calibration = rw.calibrate(misread)
    assert calibration.verdict is rw.Verdict.DO_NOT_USE
    assert calibration.judgement.grounds[0] is rw.Ground.MISREAD
    path = tmp_path / "result.json"
    rw.write_calibration(calibration, path)
    assert read_result(path).judgement == calibration.judgement
    raw = json.loads(path.read_text(encoding="utf-8"))
    raw["calibration"]["findings"] = []
    path.write_text(json.dumps(raw), encoding="utf-8")
    with pytest.raises(rw.errors.FileFormatError, match="its content leads to"):
        read_result(path)


def test_infinite_points_are_null_and_come_back(tmp_path: Path) -> None:
    calibration = rw.calibrate(rig(1, 1, motion="planar").problem)
    path = tmp_path / "result.json"
    rw.write_calibration(calibration, path)
    assert json.loads(path.read_text(encoding="utf-8"))["calibration"]["points"][0]["radius_mm"] is None
    fields = read_result(path).calibration
    assert fields is not None
    assert fields.points[0].radius_mm == np.inf


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
def test_a_calibration_without_an_answer_has_its_verdict_and_no_poses(tmp_path: Path) -> None:
    """Translations of B that point the other way ask for a negative scale."""

    def backwards(pair: object, raw: rw.Measurements) -> np.ndarray:
        B = raw.B.copy()
        B[:, :3, 3] *= -1.0
        return B

    problem = copied(rig(scale="shared").problem, B=backwards)
    with pytest.raises(rw.errors.ScaleError):
        rw.solve(problem)
    calibration = rw.calibrate(problem, rw.CalibrateOptions(misreadings=False, robust="none"))
    assert (calibration.solution, calibration.X, calibration.refined) == (None, {}, None)
    assert calibration.judgement.grounds[0] is rw.Ground.NO_SCALE
    assert "the scale is -" in calibration.verdict_reason
    path = tmp_path / "result.json"
    rw.write_calibration(calibration, path)
    raw = json.loads(path.read_text(encoding="utf-8"))
    assert (raw["verdict"], raw["sensors"], raw["targets"]) == ("do_not_use", [], [])
    with pytest.raises(rw.errors.FileFormatError, match="has no poses, because the calibration has no answer"):
        read_result(path)


def test_only_a_calibration_is_written(tmp_path: Path) -> None:
    with pytest.raises(rw.errors.OptionError, match="calibration is a str"):
        rw.write_calibration("best", tmp_path / "result.json")  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())
