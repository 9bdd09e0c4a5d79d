"""Files that earlier versions wrote (stored, and written by the code of that time) are read with their own meaning."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.verdict import Finding, Judgement
from gtsam_rwhec.report import certificate_sentence
from gtsam_rwhec.results.agreement import check_log, check_verdict
from gtsam_rwhec.results.result_file import read_result
from gtsam_rwhec.solver.certificate import Basis, Cause

GOLDEN = Path(__file__).parents[1] / "golden"


def stored(version: int) -> tuple[Path, dict[str, Any]]:
    path = GOLDEN / f"result_version_{version}.json"
    raw: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    assert raw["format_version"] == version
    return path, raw


def changed(raw: dict[str, Any], folder: Path) -> Path:
    path = folder / "changed.json"
    path.write_text(json.dumps(raw), encoding="utf-8")
    return path


def assert_poses(poses: dict[str, Any], rows: list[dict[str, Any]]) -> None:
    assert list(poses) == [row["child"] for row in rows]
    for row in rows:
        np.testing.assert_array_equal(poses[row["child"]].translation(), row["translation_m"])
        np.testing.assert_array_equal(poses[row["child"]].rotation().matrix(), row["rotation_matrix"])


def number(scale: dict[str, Any]) -> float | dict[str, float]:
    value: float | dict[str, float] = scale["by_frame"] if scale["value"] is None else scale["value"]
    return value


@pytest.mark.parametrize("version", [1, 2, 3])
def test_the_poses_at_the_top_were_the_certified_ones(version: int) -> None:
    path, raw = stored(version)
    solution = rw.read_solution(path)
    assert_poses(solution.X, raw["targets"])
    assert_poses(solution.Y, raw["sensors"])
    assert solution.scale == number(raw["scale"])
    assert solution.cost == raw["cost"]
    assert solution.certificate.status == raw["certificate"]["status"]
    assert solution.certificate.lower_bound == raw["certificate"]["lower_bound"]
    assert solution.identifiability.weakest == raw["identifiability"]["weakest"]
    assert [str(d) for d in solution.identifiability.free_directions] == raw["identifiability"]["free_directions"]
    for row in raw["pairs"]:
        pair = row["target"], row["sensor"]
        assert solution.residuals[pair].translation_rms_m == row["translation_rms_m"]
        assert solution.identifiability.pairs[pair].is_unique == row["is_unique"]
        assert solution.identifiability.pairs[pair].weakest == row["weakest"]


@pytest.mark.parametrize("version", [2, 3])
def test_the_refined_poses_stood_under_refined(version: int) -> None:
    path, raw = stored(version)
    refined, fields = rw.read_refined(path), raw["refined"]
    assert_poses(refined.X, fields["targets"])
    assert_poses(refined.Y, fields["sensors"])
    assert refined.scale == number(fields["scale"])
    assert refined.scale_mode == fields["scale"]["mode"]
    assert refined.cost == fields["cost"]
    assert refined.time_offsets_s == fields["time_offsets_s"]
    for frame in fields["frames"]:
        np.testing.assert_allclose(
            refined.covariance(frame["name"]), np.array(frame["covariance"], dtype=float), rtol=1e-12
        )
        degrees, millimetres = refined.standard_deviations(frame["name"])
        np.testing.assert_allclose(degrees, frame["standard_deviations_deg"], rtol=1e-12)
        np.testing.assert_allclose(millimetres, frame["standard_deviations_mm"], rtol=1e-12)
        assert refined.moved[frame["name"]].translation_mm == frame["moved_mm"]
    for row in fields["pairs"]:
        pair = row["target"], row["sensor"]
        degrees = tuple(math.inf if value is None else value for value in row["redundancy"])
        noise = refined.noise[pair]
        assert (noise.rotation_rad, noise.translation_m, noise.degrees_of_freedom) == (
            row["noise_rad"],
            row["noise_m"],
            degrees,
        )
        assert refined.inlier_counts.get(pair) == (None if row["inliers"] is None else tuple(row["inliers"]))


def test_version_3_has_what_became_of_the_log() -> None:
    path, raw = stored(3)
    log = read_result(path).log
    assert log is not None
    assert log.sensor_carrier == raw["log"]["sensor_carrier"] == "base"
    assert [track.used for track in log.outliers] == [track["used"] for track in raw["log"]["outliers"]]


def test_version_3_counted_outliers_by_reason_and_only_named_contradicted_frames(tmp_path: Path) -> None:
    _, raw = stored(3)
    first = raw["log"]["outliers"][0]
    first["removed"] = {"outlier (robust estimation)": 2 * first["used"]}
    raw["log"]["contradicted"] = [first["sensor"]]
    (tmp_path / "result.json").write_text(json.dumps(raw), encoding="utf-8")
    log = read_result(tmp_path / "result.json").log
    assert log is not None
    assert log.outliers[0].left_out == 2 * first["used"]
    assert (log.contradicted[0].frame, log.contradicted[0].left_out) == (first["sensor"], 2 * first["used"])


@pytest.mark.parametrize("contradicted", [["cam_front"], ["nobody"], []])
def test_contradicted_frames_must_be_those_of_the_counts(contradicted: list[str], tmp_path: Path) -> None:
    _, raw = stored(3)
    side = raw["log"]["outliers"][1]
    side["removed"] = {"outlier (robust estimation)": 2 * side["used"]}
    raw["log"]["contradicted"] = contradicted
    (tmp_path / "result.json").write_text(json.dumps(raw), encoding="utf-8")
    said = (
        rf"\$\.log\.contradicted: must be cam_side, by \$\.log\.outliers \(found {', '.join(contradicted) or 'none'}\)"
    )
    with pytest.raises(rw.errors.FileFormatError, match=said):
        rw.read_solution(tmp_path / "result.json")


def test_the_first_files_of_version_3_did_not_name_contradicted_frames(tmp_path: Path) -> None:
    _, raw = stored(3)
    side = raw["log"]["outliers"][1]
    side["removed"] = {"outlier (robust estimation)": 2 * side["used"]}
    del raw["log"]["contradicted"]
    (tmp_path / "result.json").write_text(json.dumps(raw), encoding="utf-8")
    log = read_result(tmp_path / "result.json").log
    assert log is not None
    assert [counts.frame for counts in log.contradicted] == ["cam_side"]


def test_up_to_version_5_nearly_half_was_not_enough(tmp_path: Path) -> None:
    _, raw = stored(3)
    for row in raw["log"]["outliers"]:
        row["removed"] = {"outlier (robust estimation)": row["used"] - 1}
    (tmp_path / "result.json").write_text(json.dumps(raw), encoding="utf-8")
    log = read_result(tmp_path / "result.json").log
    assert log is not None
    assert log.contradicted == ()
    check_log(log, 5)
    with pytest.raises(ValueError, match=r"must be tag_7, cam_front, cam_side, by .* \(found none\)"):
        check_log(log, 6)


def test_the_bound_of_version_4_was_of_the_reduced_form() -> None:
    path, raw = stored(4)
    result, fields = read_result(path), raw["certified"]
    assert "basis" not in fields["certificate"]
    assert "region" not in fields["certificate"]
    assert "origin_m" not in fields["certificate"]["objective"]
    certificates = [result.solution.certificate, *(part.certificate for part in result.solution.parts)]
    assert len(certificates) == 2
    for certificate in certificates:
        assert certificate.basis is Basis.REDUCED_FORM
        assert certificate.region is None
        assert certificate.status == fields["certificate"]["status"] == "certified"
        assert certificate.lower_bound == fields["certificate"]["lower_bound"]
        assert (certificate.objective.form, certificate.objective.origin_m) == ("inverse", None)
    assert certificate_sentence(certificates[0]).endswith("whose rounding is not in it.")
    assert result.refined is not None
    assert_poses(result.refined.X, raw["targets"])
    assert_poses(result.refined.Y, raw["sensors"])
    assert_poses(result.solution.X, fields["targets"])
    assert_poses(result.solution.Y, fields["sensors"])
    assert result.refined.scale == raw["scale"]
    assert result.solution.scale == fields["scale"]
    for name, frame in raw["refined"]["frames"].items():
        np.testing.assert_allclose(result.refined.covariance(name), frame["covariance"], rtol=1e-12)


def test_the_verdict_of_version_4_is_checked(tmp_path: Path) -> None:
    _, raw = stored(4)
    assert raw["verdict"] == "use"
    with pytest.raises(rw.errors.FileFormatError, match=r"of version 4 .*\$\.verdict: the file says 'care'"):
        read_result(changed({**raw, "verdict": "care"}, tmp_path))


def test_version_5_had_not_what_calibrate_found(tmp_path: Path) -> None:
    path, raw = stored(5)
    result = read_result(path)
    assert result.calibration is None
    assert result.judgement.verdict is rw.Verdict.USE
    assert result.refined is not None
    assert_poses(result.refined.Y, raw["sensors"])
    assert result.solution.certificate.lower_bound == raw["certified"]["certificate"]["lower_bound"]
    del raw["certified"]["certificate"]["region"]
    with pytest.raises(rw.errors.FileFormatError, match=r"certificate\.region: is missing"):
        read_result(changed(raw, tmp_path))


def test_version_6_had_nothing_from_corners(tmp_path: Path) -> None:
    path, raw = stored(6)
    result = read_result(path)
    assert result.judgement.verdict is rw.Verdict.USE
    assert result.calibration is not None
    assert result.refined is not None
    assert_poses(result.refined.Y, raw["sensors"])
    assert result.refined.reprojection is None
    assert result.refined.intrinsics == {}
    assert result.refined.names == tuple(raw["refined"]["joint"]["slots"])
    for name, frame in raw["refined"]["frames"].items():
        np.testing.assert_allclose(result.refined.covariance(name), frame["covariance"], rtol=1e-12)
    without_answer = {"verdict": "do_not_use", "verdict_reason": "no scale fits"}
    del raw["certified"]
    with pytest.raises(rw.errors.FileFormatError, match="has no poses, because the calibration has no answer: no scal"):
        read_result(changed({**raw, **without_answer}, tmp_path))


def test_version_7_has_what_corners_said() -> None:
    path, raw = stored(7)
    refined = rw.read_refined(path)
    assert refined.reprojection is not None
    assert refined.reprojection.rms_px == raw["refined"]["reprojection"]["rms_px"]
    assert list(refined.intrinsics) == list(raw["refined"]["intrinsics"]) == ["cam_0", "cam_1"]
    for name, fields in raw["refined"]["intrinsics"].items():
        intrinsics = refined.intrinsics[name]
        assert list(intrinsics.values) == fields["values"]
        assert np.diagonal(intrinsics.camera.K)[:2].tolist() == fields["values"][:2]
        np.testing.assert_allclose(
            np.sqrt(np.diagonal(refined.covariance(f"intrinsics:{name}"))), fields["standard_deviations"], rtol=1e-12
        )
    assert refined.intrinsics["cam_0"].stated_deviations == (math.inf,) * 8


@pytest.mark.parametrize(
    ("stated", "grounds", "now"),
    [
        (rw.Verdict.CARE, (rw.Ground.SIZE_DOUBTED,), rw.Ground.SIZE_DOUBTED),
        (rw.Verdict.CARE, (rw.Ground.NOT_CERTIFIED,), rw.Ground.NOT_CERTIFIED),
        (rw.Verdict.DO_NOT_USE, (rw.Ground.CONTRADICTED,), rw.Ground.TARGET_CONTRADICTED),
        (rw.Verdict.USE, (), rw.Ground.NO_ANSWER),
    ],
)
def test_up_to_version_5_the_verdict_had_another_rule(
    stated: rw.Verdict, grounds: tuple[rw.Ground, ...], now: rw.Ground
) -> None:
    found = Judgement.of([Finding(now, "a fact")], "")
    check_verdict(stated, grounds, found, 5)
    with pytest.raises(ValueError, match=rf"\$\.verdict: the file says '{stated.value}'"):
        check_verdict(stated, grounds, found, 6)
    with pytest.raises(ValueError, match="its content leads to"):
        check_verdict(
            rw.Verdict.DO_NOT_USE if stated is not rw.Verdict.DO_NOT_USE else rw.Verdict.USE, grounds, found, 5
        )


def test_version_4_told_when_digits_were_lost(tmp_path: Path) -> None:
    """No new certificate has this cause. A file with it is read, and written again as it was."""
    path = GOLDEN / "result_version_4_digits_lost.json"
    solution = rw.read_solution(path)
    assert solution.certificate.cause is Cause.DIGITS_LOST
    assert solution.certificate.status is rw.Status.GAP
    assert (
        solution.certificate.reason
        in json.loads(path.read_text(encoding="utf-8"))["certified"]["certificate"]["sentence"]
    )
    rw.write_solution(solution, tmp_path / "again.json")
    again = rw.read_solution(tmp_path / "again.json")
    assert again.certificate == solution.certificate
    assert again.certificate.basis is Basis.REDUCED_FORM


def test_version_1_was_not_refined() -> None:
    with pytest.raises(rw.errors.FileFormatError, match="was not refined"):
        rw.read_refined(stored(1)[0])


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda raw: raw.pop("pairs"), r"\$\.pairs: Field required"),
        (lambda raw: raw["certificate"].pop("cost"), r"\$\.certified\.certificate\.cost: Field required"),
        (lambda raw: raw["sensors"][0].update(child=7), r"\$\.certified\.sensors\[0\]\.child"),
        (lambda raw: raw.update(extra=1), "extra"),
        (lambda raw: raw.update(refined=3), r"\$\.refined: .*\(found 3\)"),
        (lambda raw: raw.update(refined=[]), r"\$\.refined: .*\(found \[\]\)"),
        (lambda raw: raw.update(refined="xx"), r"\$\.refined: .*\(found 'xx'\)"),
        (lambda raw: raw.update(parts=3), r"\$\.parts: .*\(found 3\)"),
        (lambda raw: raw.update(certificate="xx"), r"\$\.certificate: .*\(found 'xx'\)"),
        (lambda raw: raw["pairs"].__setitem__(0, 3), r"\$\.pairs\[0\]: .*\(found 3\)"),
        (lambda raw: raw["refined"].update(scale=3), r"\$\.refined\.scale: .*\(found 3\)"),
        (lambda raw: raw["refined"]["frames"][0].pop("name"), r"\$\.refined\.frames\[0\]\.name: Field required"),
        (lambda raw: raw["refined"]["joint"]["unknowns"][0].update(rows="6"), r"joint\.unknowns\[0\]\.rows: .*'6'"),
        (lambda raw: raw["refined"]["joint"].update(finite=3), r"\$\.refined\.joint\.finite: .*\(found 3\)"),
        (
            lambda raw: raw["refined"]["joint"]["finite"].pop(0),
            r"\$\.refined\.joint\.finite: row 0 must have 1 .*found 2",
        ),
        (lambda raw: raw["refined"]["joint"]["finite"].pop(), r"\$\.refined\.joint: slots have 19 rows"),
        (
            lambda raw: raw["refined"]["joint"]["free"].append([0.0]),
            r"joint: free\[0\] must have 19 numbers \(found 1\)",
        ),
    ],
)
def test_damage_is_refused_with_the_version(damage: Any, said: str, tmp_path: Path) -> None:
    _, raw = stored(2)
    damage(raw)
    (tmp_path / "damaged.json").write_text(json.dumps(raw), encoding="utf-8")
    with pytest.raises(rw.errors.FileFormatError, match=f"not a valid result of version 2.*{said}"):
        rw.read_solution(tmp_path / "damaged.json")
