"""Lines that are marked TODO are found with their numbers, keys and words, and named when the file is read."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest
from rig_texts import FULL

import gtsam_rwhec as rw
from gtsam_rwhec.errors import UnfinishedRigWarning
from gtsam_rwhec.rig import TodoLine, read_rig, todo_lines


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
