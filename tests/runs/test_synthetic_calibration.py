"""A made-up recording of detections, the whole way: what comes out is what was made up."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import synthetic_logs as made
from given_commands import given

import gtsam_rwhec as rw
from gtsam_rwhec.report.advice import log_advice
from gtsam_rwhec.runs.whole_runs import calibrate_log
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
