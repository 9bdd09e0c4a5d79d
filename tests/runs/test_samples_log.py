"""Samples of hand-eye tools become calibrations, with a rig file and without one."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import sample_files
from given_commands import given

import gtsam_rwhec as rw
from gtsam_rwhec.errors import LogError
from gtsam_rwhec.rig.rig_file import parse_rig
from gtsam_rwhec.runs.recorded_logs import samples_problem

pytestmark = pytest.mark.usefixtures("without_figures")

RIG = """\
carriers: {{sensors: {sensors}, targets: {targets}, poses: {{frames: [base, hand]}}}}
sensors:
  camera: {{{source}}}
targets:
  board: {{type: charuco, family: aruco_5x5_100, squares: [7, 5], square_m: 0.04, marker_m: 0.03}}
"""


def rig(on_hand: bool, source: str = "detections: /samples") -> rw.rig.Rig:
    sensors, targets = ("hand", "base") if on_hand else ("base", "hand")
    return parse_rig(RIG.format(sensors=sensors, targets=targets, source=source), "rig.yaml")


@pytest.mark.parametrize("on_hand", [True, False])
def test_the_setup_is_found_by_solving_both(tmp_path: Path, on_hand: bool) -> None:
    hands, B, X, Y = sample_files.rig_poses(on_hand)
    found = samples_problem(sample_files.moveit(tmp_path / "samples.yaml", hands, B))
    assert "read as T_base_hand, the target's as T_camera_target, with the camera" in found.said
    assert f"{'on the hand' if on_hand else 'fixed and the target on the hand'}, which fits" in found.said
    assert found.problem.sensor_carrier == ("hand" if on_hand else "base")
    solution = rw.solve(found.problem)
    np.testing.assert_allclose(solution.Y["camera"].matrix(), Y, atol=3e-3)
    np.testing.assert_allclose(solution.X["target"].matrix(), X, atol=3e-3)


def test_the_setup_that_the_file_says_or_leaves_open(tmp_path: Path) -> None:
    hands, B, _, Y = sample_files.rig_poses(on_hand=False)
    fixed = samples_problem(sample_files.easy_handeye2(tmp_path / "cell.samples", hands, B, "eye_on_base"))
    assert "read as T_hand_base" in fixed.said
    assert fixed.said.endswith("as the file says.")
    open_ = samples_problem(sample_files.easy_handeye(tmp_path / "a.yaml", np.linalg.inv(hands), B))
    assert "with a fixed camera the answer is the same, with base and hand exchanged" in open_.said
    for found in (fixed, open_):
        np.testing.assert_allclose(rw.solve(found.problem).Y["camera"].matrix(), Y, atol=3e-3)


def test_samples_that_tell_no_setup_are_refused(tmp_path: Path) -> None:
    hands, _, _, _ = sample_files.rig_poses(on_hand=True)
    other = sample_files.rig_poses(on_hand=True, seed=6)[1]
    path = sample_files.moveit(tmp_path / "samples.yaml", hands, other)
    with pytest.raises(LogError, match=r"fit about equally well .* State which in a rig file"):
        samples_problem(path)


def command(*arguments: object, status: int = 0) -> str:
    done = given(*arguments)
    assert done.exit_code == status, done.output
    return " ".join(done.output.split())


def test_one_command_from_samples_to_a_result(tmp_path: Path) -> None:
    hands, B, _, Y = sample_files.rig_poses(on_hand=True)
    path = sample_files.moveit(tmp_path / "samples.yaml", hands, B)
    said = command("calibrate", path, "-o", tmp_path / "result.json")
    assert "14 samples of MoveIt; the robot's poses were read as T_base_hand" in said
    found = rw.read_refined(tmp_path / "result.json")
    np.testing.assert_allclose(found.Y["camera"].matrix(), Y, atol=3e-3)


def test_commands_that_do_not_fit_samples(tmp_path: Path) -> None:
    hands, B, _, _ = sample_files.rig_poses(on_hand=True)
    path = sample_files.moveit(tmp_path / "samples.yaml", hands, B)
    of_a_log = tmp_path / "rig.yaml"
    of_a_log.write_text(RIG.format(sensors="hand", targets="base", source="detections: /t").replace("frames", "tf"))
    assert "--scale: not for samples" in command("calibrate", path, "--scale", "shared", status=2)
    assert "become a log with --rig FILE" in command("convert", path, "-o", tmp_path / "a.mcap", status=2)
    said = command("calibrate", path, "--rig", of_a_log, "-o", tmp_path / "out", status=2)
    assert "write poses: {frames: [base, hand]}, and detections: /samples" in said
    described = tmp_path / "samples_rig.yaml"
    described.write_text(RIG.format(sensors="hand", targets="base", source="detections: /samples"))
    said = command("convert", path, "--rig", described, "-o", tmp_path / "a.mcap")
    assert "14 samples of MoveIt" in said
    with rw.logs.open_log(tmp_path / "a.mcap") as log:
        kinds = Counter(type(record).__name__ for record in log.records())
    assert kinds == {"PoseRecord": 14, "DetectionRecord": 14}


def test_with_a_rig_file_as_any_log(tmp_path: Path) -> None:
    on_hand = False
    hands, B, X, Y = sample_files.rig_poses(on_hand)
    path = sample_files.easy_handeye2(tmp_path / "cell.samples", hands, B, "eye_on_base")
    calibrated = rw.runs.calibrate_log(path, rig(on_hand), tmp_path / "out")
    np.testing.assert_allclose(calibrated.refined.Y["camera"].matrix(), Y, atol=3e-3)
    np.testing.assert_allclose(calibrated.refined.X["board"].matrix(), X, atol=3e-3)
    assert (tmp_path / "out" / "static_tf.launch.py").exists()
    assert not list((tmp_path / "out").glob("*.images.mcap"))
    with pytest.raises(LogError, match=r"rig\.yaml, line 1: carriers: .* of a camera that is .*Exchange sensors and"):
        rw.runs.calibrate_log(path, rig(not on_hand), tmp_path / "other")
    with pytest.raises(LogError, match=r"line 3: sensors\.camera: .* no images\. Write detections: /samples"):
        rw.runs.write_samples_log(
            path, rig(on_hand, "images: a, poses: b, intrinsics: {K: [50, 50, 32, 24], size: [64, 48]}"), tmp_path / "x"
        )
    assert not (tmp_path / "x").exists()
