"""Lines that are marked TODO are found with their numbers, keys and words, and named when the file is read."""

from __future__ import annotations

import shutil
import warnings
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import yaml
from places import CELL
from rig_texts import FULL

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.errors import UnfinishedRigWarning
from gtsam_rwhec.rig import TEMPLATES, TodoLine, parse_rig, read_rig, rig_file_schema, template_text, todo_lines
from gtsam_rwhec.rig.rig_file import TemplateName


def test_marks_at_the_end_of_a_line_and_on_lines_before_it() -> None:
    text = """\
# TODO marks what only a person knows.
carriers:
  sensors: hand   # TODO exchange?
  # TODO errors of these
  # poses
  noise: {rotation_deg: 1, translation_mm: 1}

  # said for another reason
  max_gap_s: 1.0  # METODOLOGY is no mark
targets:
  tag_0: {id: 0}  # measured; TODO the family
"""
    assert todo_lines(text) == (
        TodoLine(3, "sensors", "TODO exchange?"),
        TodoLine(6, "noise", "TODO errors of these poses"),
        TodoLine(11, "tag_0", "TODO the family"),
    )
    assert str(todo_lines(text)[0]) == "line 3, sensors: TODO exchange?"


def test_a_file_that_is_read_names_its_marks_and_a_finished_one_none(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(FULL, encoding="utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        finished = read_rig(path)
    path.write_text(FULL.replace("carriers:\n", "carriers:  # TODO look again\n"), encoding="utf-8")
    with pytest.warns(UnfinishedRigWarning, match=r"rig\.yaml has lines .* TODO.*\nline 2, carriers: TODO look again"):
        assert read_rig(path) == finished
    assert issubclass(UnfinishedRigWarning, rw.errors.RwhecWarning)


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
