"""Result files of refined calibrations and of ``calibrate``: poses, covariances, findings and choices come back."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from refinement_problems import copied, refined, rig

import gtsam_rwhec as rw
from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.fitting.refinement_from_poses import movements
from gtsam_rwhec.results.result_file import read_result
from gtsam_rwhec.simulate import Motion, Noise, general

NOISE = Noise(sigma_m=0.005, kappa=0.5 / np.radians(0.5) ** 2)


def with_outliers() -> rw.Problem:
    """A quarter of one pair's measurements wrong; a shared scale."""

    def wrong(pair: rw.Pair, raw: rw.Measurements) -> np.ndarray:
        B = raw.B.copy()
        if pair == ("target1", "sensor0"):
            B[::4] = B[::4] @ gtsam.Pose3.Expmap(np.full(6, 0.8)).matrix()
        return B

    return copied(general(2, 2, seed=5, noise=NOISE, scale="shared", number_of_measurements=30).problem, B=wrong)


def fixed() -> rw.Problem:
    simulation = general(2, 2, seed=5, noise=NOISE)
    simulation.problem.fix("target0", simulation.X["target0"])
    return simulation.problem


KINDS: dict[str, Callable[[], rw.Refined]] = {
    "known scale": lambda: refined(general(2, 2, seed=5, noise=NOISE).problem),
    "scales of targets": lambda: refined(
        general(3, 2, seed=5, noise=NOISE, scale="per_target", known_sizes=["target0"]).problem, noise="estimate"
    ),
    "outliers": lambda: refined(with_outliers(), noise="estimate", robust="gnc"),
    "something free": lambda: refined(general(2, 2, seed=5, noise=NOISE, motion=Motion("planar")).problem),
    "fixed frame": lambda: refined(fixed()),
    "time offsets": lambda: refined(
        general(1, 2, seed=5, noise=NOISE, motion=Motion(wobble_m=0.1)).problem, time_offsets=True
    ),
    "motions": lambda: refined(general(0, 2, seed=5, odometry=20, odometry_noise=NOISE).problem),
}


@pytest.mark.parametrize("kind", KINDS)
def test_poses_and_covariances_come_back(kind: str, tmp_path: Path) -> None:
    answer = KINDS[kind]()
    rw.write_refined(answer, tmp_path / "refined.json")
    back = rw.read_refined(tmp_path / "refined.json")
    for poses, others in ((answer.X, back.X), (answer.Y, back.Y)):
        assert list(poses) == list(others)
        for name, pose in poses.items():
            np.testing.assert_array_equal(others[name].matrix(), pose.matrix())
            np.testing.assert_allclose(back.covariance(name), answer.covariance(name), rtol=1e-12)
    np.testing.assert_allclose(back.covariance(), answer.covariance(), rtol=1e-9, atol=1e-20)
    np.testing.assert_array_equal(back.joint.finite, answer.joint.finite)
    np.testing.assert_array_equal(back.joint.free, answer.joint.free)
    for name in (
        *("scale", "scale_mode", "time_offsets_s", "noise_source", "noise", "cost", "initial_cost", "iterations"),
        *("inlier_counts", "free_directions", "names", "degrees_of_freedom"),
    ):
        assert getattr(back, name) == getattr(answer, name), name
    assert back.moved == movements(answer.solution, back.X, back.Y)  # from the certified poses in the file
    if len(answer.Y) > 1:
        pose, covariance = back.relative("sensor0", "sensor1")
        assert pose.equals(answer.relative("sensor0", "sensor1")[0], 1e-15)
        np.testing.assert_allclose(covariance, answer.relative("sensor0", "sensor1")[1], rtol=1e-9, atol=1e-20)
    assert back.contains("sensor0", answer.Y["sensor0"])


def test_the_certified_solution_is_in_the_same_file(tmp_path: Path) -> None:
    answer = KINDS["outliers"]()
    rw.write_refined(answer, tmp_path / "refined.json")
    rw.write_solution(answer.solution, tmp_path / "solution.json")
    back = rw.read_solution(tmp_path / "refined.json")
    rw.write_solution(back, tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "solution.json").read_bytes()
    raw = json.loads((tmp_path / "refined.json").read_bytes())
    assert [pose["child"] for pose in raw["certified"]["sensors"]] == list(answer.solution.Y)
    assert raw["sensors"] != raw["certified"]["sensors"]  # at the top are the poses to use, the refined ones
    assert not {"sensors", "targets"} & raw["refined"].keys()
    assert answer.inlier_counts["target1", "sensor0"] == (22, 30)


def test_infinite_is_null(tmp_path: Path) -> None:
    answer = KINDS["something free"]()
    rw.write_refined(answer, tmp_path / "refined.json")
    text = (tmp_path / "refined.json").read_text(encoding="utf-8")
    assert "Infinity" not in text
    assert "NaN" not in text
    for name, frame in json.loads(text)["refined"]["frames"].items():
        degrees, millimetres = answer.standard_deviations(name)
        for written, known in (
            (frame["standard_deviations_deg"], degrees),
            (frame["standard_deviations_mm"], millimetres),
            (np.array(frame["covariance"], dtype=object).ravel(), answer.covariance(name).ravel()),
        ):
            assert [value is None for value in written] == np.isinf(known).tolist()
        assert None in frame["standard_deviations_mm"]


def test_a_solution_that_was_not_refined_is_refused(tmp_path: Path) -> None:
    rw.write_solution(rw.solve(general(1, 1, seed=5, noise=NOISE).problem), tmp_path / "solution.json")
    with pytest.raises(FileFormatError, match=r"was not refined\. Read it with read_solution, or refine"):
        rw.read_refined(tmp_path / "solution.json")


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda raw: raw["refined"]["joint"]["finite"].pop(), "slots have 24 rows"),
        (lambda raw: raw["refined"]["joint"]["finite"][3].pop(), "$.refined.joint.finite: rows of different lengths"),
        (lambda raw: raw["refined"]["joint"]["unit"].__setitem__(3, 0.0), "$.refined.joint.unit[3]"),
        (lambda raw: raw["refined"]["joint"]["free"].pop(), "slots have 24 rows"),
        (lambda raw: raw["sensors"][0].pop("translation_m"), "$.sensors[0].translation_m"),
        (lambda raw: raw["refined"].update(speed=1), "$.refined.speed"),
        (lambda raw: raw["refined"]["noise"][1].update(degrees_of_freedom=[1.0]), "degrees_of_freedom"),
        (lambda raw: raw["refined"]["noise"][1].update(sensor="moon"), "have no pose: moon"),
        (lambda raw: raw.pop("refined"), "$.certified.sensors: unknown field"),
    ],
)
def test_damage_is_refused_with_its_place(damage: Callable[[Any], object], said: str, tmp_path: Path) -> None:
    assert_refused("known scale", damage, said, tmp_path / "refined.json")


def assert_refused(kind: str, damage: Callable[[Any], object], said: str, path: Path) -> None:
    rw.write_refined(KINDS[kind](), path)
    raw = json.loads(path.read_text(encoding="utf-8"))
    damage(raw)
    path.write_text(json.dumps(raw), encoding="utf-8")
    with pytest.raises(FileFormatError) as caught:
        rw.read_refined(path)
    assert said in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda raw: raw["scale"].pop("target1"), "but the targets are target0, target1, target2"),
        (lambda raw: raw["scale"].update(moon=1.0), "scale has target0, target1, target2, moon"),
        (lambda raw: raw["certified"]["scale"].pop("target1"), "but the targets are target0, target1, target2"),
        (lambda raw: raw["refined"]["joint"]["slots"].pop("scale:target1"), "that have no rows: scale:target1"),
    ],
)
def test_every_target_has_its_scale(damage: Callable[[Any], object], said: str, tmp_path: Path) -> None:
    assert_refused("scales of targets", damage, said, tmp_path / "refined.json")


def test_a_missing_offset_is_refused(tmp_path: Path) -> None:
    def damage(raw: Any) -> None:
        raw["refined"]["joint"]["slots"].pop("time_offset:sensor1")

    assert_refused("time offsets", damage, "that have no rows: time_offset:sensor1", tmp_path / "refined.json")


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
