"""Logs of detections, the whole way: what was made up comes out, and of the real data set what its CSV files give."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import synthetic_logs as made
from given_commands import given
from utias_log import rig_text, write_utias_log

import gtsam_rwhec as rw
from gtsam_rwhec.report.advice import log_advice
from gtsam_rwhec.results.result_file import read_result
from gtsam_rwhec.rig import parse_rig
from gtsam_rwhec.runs.cleaning_stage import clean_log
from gtsam_rwhec.runs.detection_stage import detect_log
from gtsam_rwhec.runs.whole_runs import calibrate_log, solve_into
from gtsam_rwhec.simulate import frame_distance

pytestmark = pytest.mark.usefixtures("without_figures")


def test_truth_comes_out(tmp_path: Path) -> None:
    log = made.write(tmp_path / "raw.mcap", made.recording())
    calibrated = calibrate_log(log, made.rig(), tmp_path / "out")
    assert calibrated.refined.solution.certificate.status.value == "certified"
    for frames, truth in ((calibrated.refined.Y, made.Y), (calibrated.refined.X, made.X)):
        assert set(frames) == set(truth)
        for name, found in frames.items():
            off = frame_distance(found.matrix(), truth[name])
            assert off.translation_mm < 1.0
            assert off.rotation_deg < 0.1


def test_a_wrong_size_and_a_late_clock_come_out(tmp_path: Path) -> None:
    messages = made.recording(12.0, true_size={"tag_1": 0.95}, offsets_s={"cam_1": 0.04})
    text = made.rig_text(sizes="sizes: check", cam_1="detections: /cam_1/tags\n    time_offset: estimate")
    calibrated = made.solved(tmp_path, messages, text)
    sizes = {size.target: size for size in calibrated.log.sizes}
    assert [name for name, size in sizes.items() if size.is_free] == ["tag_1"]
    assert np.isclose(sizes["tag_1"].scale, 1 / 0.95, rtol=3e-3)
    assert abs(calibrated.refined.time_offsets_s["cam_1"] - 0.04) < 2e-3


def test_a_stated_size_that_the_motion_contradicts_is_no_success(tmp_path: Path) -> None:
    """All tags are printed at half the size that the rig file states, so no measurement contradicts another."""
    messages = made.recording(6.0, true_size=dict.fromkeys(made.TAGS, 0.5))
    calibrated = made.solved(tmp_path, messages, made.rig_text(sizes="sizes: known"))
    assert calibrated.judgement.verdict is rw.Verdict.DO_NOT_USE
    said = str(calibrated.judgement)
    assert said.startswith("Do not use these poses: lengths in B are ")
    assert "the stated size of tag_0, tag_1, tag_2 does not fit the motion" in said
    (advice,) = (line for line in log_advice(calibrated.log) if line.startswith("The stated size of tag_0 is "))
    assert 99.0 < float(advice.split(" is ")[1].split(" % too large")[0]) < 101.0


def test_what_contradicts_is_named_with_its_exit_status_and_no_file_for_others_is_written(tmp_path: Path) -> None:
    log = made.write(tmp_path / "raw.mcap", made.recording(6.0, offsets_s={"cam_1": 0.3}))
    (tmp_path / "rig.yaml").write_text(made.rig_text(sizes="sizes: known"), encoding="utf-8")
    done = given("calibrate", log, "--rig", tmp_path / "rig.yaml", "-o", tmp_path / "out")
    assert done.exit_code == 6, done.output
    words = "Do not use these poses: the time offset of cam_1 is 0 s in the rig file, but its rotations "
    assert " ".join(done.stdout.split()).startswith(words)
    grounds = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))["verdict_grounds"]
    assert set(grounds) & {"late_clock", "contradicted"}
    written = sorted(path.name for path in (tmp_path / "out").iterdir() if not path.name.startswith("."))
    assert written == ["calibration.mcap", "evidence.json", "report.html", "result.json"]
    assert "Written to " in done.stderr
    assert "tf.yaml" not in done.stderr.split("Not written, as the poses are not to be used: ")[0]


SIGMA_M, ROTATION_DEG = 0.005, 0.5


@pytest.mark.slow
def test_the_same_cost_and_poses_as_from_csv(utias_folder: Path, tmp_path: Path) -> None:
    problem = rw.read_csv(utias_folder, sigma=SIGMA_M, kappa=1.0 / (2.0 * np.radians(ROTATION_DEG) ** 2))
    expected = rw.solve(problem)
    refined = rw.refine(problem, expected)
    write_utias_log(utias_folder, tmp_path / "utias.mcap")
    rig = parse_rig(rig_text(problem.targets, ROTATION_DEG, 1e3 * SIGMA_M), "rig")
    # Stage by stage, without the pictures and pages of a whole run.
    detect_log(tmp_path / "utias.mcap", rig, tmp_path / "detected.mcap")
    clean_log(tmp_path / "detected.mcap", tmp_path / "cleaned.mcap")
    found = solve_into(tmp_path / "cleaned.mcap", None, tmp_path / "out").refined
    solution = found.solution
    said = read_result(tmp_path / "out" / "result.json").log
    assert said is not None
    assert sum(track.used for track in said.outliers) == problem.number_of_measurements == 3230
    assert abs(solution.cost - expected.cost) <= 1e-12 * expected.cost
    assert abs(found.cost - refined.cost) <= 1e-9 * refined.cost
    for answer, wanted in ((solution.X, expected.X), (solution.Y, expected.Y)):
        for name, pose in wanted.items():
            np.testing.assert_allclose(answer[name].matrix(), pose.matrix(), rtol=0.0, atol=1e-12)
    for name, pose in (refined.X | refined.Y).items():
        np.testing.assert_allclose((found.X | found.Y)[name].matrix(), pose.matrix(), rtol=0.0, atol=1e-7)
