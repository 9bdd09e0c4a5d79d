"""Templates of rig files: each is read, checked and marked; two are run on data as they are."""

from __future__ import annotations

import shutil
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import yaml
from places import CELL

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.rig import TEMPLATES, parse_rig, rig_file_schema, template_text, todo_lines
from gtsam_rwhec.rig.rig_file import TemplateName


@pytest.mark.parametrize("name", TEMPLATES)
def test_each_is_a_whole_rig_file_with_marks(name: TemplateName) -> None:
    text = template_text(name)
    rig = parse_rig(text, name)
    jsonschema.validate(yaml.safe_load(text), rig_file_schema(), jsonschema.Draft7Validator)
    marked = {line.key for line in todo_lines(text)}
    assert set(rig.targets) <= marked, "the targets' sizes are marked"
    assert {"images", "detections", *rig.sensors} & marked, "where the images are is marked"
    assert "gtsam-rwhec calibrate" in text
    assert max(map(len, text.splitlines())) <= 120


@pytest.mark.slow
def test_eye_to_hand_runs_on_a_folder(workcell_camera2: Path, tmp_path: Path) -> None:
    folder = tmp_path / "cell"
    shutil.copytree(workcell_camera2, folder, ignore=shutil.ignore_patterns("*.png"))
    files = sorted((workcell_camera2 / "image").glob("*.png"))
    for i in np.linspace(2, 38, 12).astype(int):
        shutil.copy(files[i], folder / "image")
    rig = parse_rig(template_text("eye-to-hand"), "eye-to-hand.yaml", folder)
    with pytest.warns(rw.errors.LogWarning, match="poses have no image"):
        calibrated = rw.calibrate_log(folder, rig, tmp_path / "out", workers=1)
    assert calibrated.judgement.verdict is not Verdict.DO_NOT_USE
    x, y, z = calibrated.refined.Y["camera"].translation()
    assert (x, y, z) == pytest.approx((1.767, 2.062, 1.156), abs=0.01)


@pytest.mark.slow
def test_eye_in_hand_runs_on_the_demo(tmp_path: Path) -> None:
    rig = parse_rig(template_text("eye-in-hand"), "eye-in-hand.yaml", CELL)
    calibrated = rw.calibrate_log(CELL / "robot_cell.mcap", rig, tmp_path / "out", workers=1)
    assert calibrated.judgement.verdict is not Verdict.DO_NOT_USE
    assert set(calibrated.refined.Y) == {"cam_left"}
