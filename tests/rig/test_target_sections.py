"""A target of the rig file may be Kalibr's file."""

from __future__ import annotations

from pathlib import Path

import pytest

from gtsam_rwhec.errors import RigError
from gtsam_rwhec.rig import parse_rig, rig_text

RIG = """\
carriers: {sensors: hand, targets: base, poses: {tf: [base, hand]}}
sensors:
  camera: {detections: /tags}
targets:
  board: {kalibr: target.yaml}
"""
FILES = {
    "aprilgrid": (
        "target_type: 'aprilgrid' #gridtype\ntagCols: 6\ntagRows: 5\ntagSize: 0.088\ntagSpacing: 0.3\n",
        "{type: aprilgrid, family: tag36h11, tags: [6, 5], tag_m: 0.088, spacing: 0.3}",
    ),
    "checkerboard": (
        "target_type: 'checkerboard'\ntargetCols: 6\ntargetRows: 7\nrowSpacingMeters: 0.06\ncolSpacingMeters: 0.06\n",
        "{type: checkerboard, inner_corners: [6, 7], square_m: 0.06}",
    ),
    "asymmetric": (
        "target_type: 'circlegrid'\ntargetCols: 4\ntargetRows: 11\nspacingMeters: 0.02\nasymmetricGrid: True\n",
        "{type: circle_grid, circles: [4, 11], spacing_m: 0.02, asymmetric: true}",
    ),
    "circlegrid": (
        "target_type: 'circlegrid'\ntargetCols: 6\ntargetRows: 7\nspacingMeters: 0.02\nasymmetricGrid: False\n",
        "{type: circle_grid, circles: [6, 7], spacing_m: 0.02}",
    ),
}


@pytest.mark.parametrize("kind", sorted(FILES))
def test_each_target_of_kalibr(tmp_path: Path, kind: str) -> None:
    text, section = FILES[kind]
    (tmp_path / "target.yaml").write_text(text)
    found = parse_rig(RIG, "rig.yaml", tmp_path)
    expected = parse_rig(RIG.replace("{kalibr: target.yaml}", section), "rig.yaml")
    assert found.target_list == expected.target_list
    assert rig_text(found) == rig_text(expected)  # a log has the section, and needs no file


@pytest.mark.parametrize(
    ("kind", "old", "new", "words"),
    [
        ("aprilgrid", "'aprilgrid'", "'dots'", "line 1: target_type: 'dots'; Kalibr's targets are aprilgrid, checker"),
        ("aprilgrid", "tagCols: 6\n", "", "tagCols: is missing"),
        ("aprilgrid", "tagSize: 0.088", "tagSize: wide", "line 4: tagSize: 'wide'; a number was expected"),
        ("checkerboard", "colSpacingMeters: 0.06", "colSpacingMeters: 0.05", "squares that are no squares"),
        ("circlegrid", "False", "2", "line 5: asymmetricGrid: 2; give True or False"),
        ("aprilgrid", "tagCols: 6", "tagCols: 6.5", "rig.yaml, line 5: targets.board.tags"),
    ],
)  # fmt: skip
def test_what_is_no_target(tmp_path: Path, kind: str, old: str, new: str, words: str) -> None:
    (tmp_path / "target.yaml").write_text(FILES[kind][0].replace(old, new))
    with pytest.raises(RigError) as caught:
        parse_rig(RIG, "rig.yaml", tmp_path)
    assert words in str(caught.value)
    assert str(caught.value).startswith("rig.yaml, line 5: targets.board")


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(RigError, match=r"rig\.yaml, line 5: targets\.board\.kalibr: .*none\.yaml cannot be read"):
        parse_rig(RIG.replace("target.yaml", "none.yaml"), "rig.yaml", tmp_path)
    with pytest.raises(RigError, match="give the path of Kalibr's file, and no other key"):
        parse_rig(RIG.replace("target.yaml", "target.yaml, size_m: 3"), "rig.yaml", tmp_path)
