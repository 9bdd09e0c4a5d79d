"""Sensors with clouds and objects in rig files: what is read, and each fault with its line."""

from __future__ import annotations

import pytest

from gtsam_rwhec.errors import RigError
from gtsam_rwhec.rig import parse_rig, rig_text

TEXT = """\
carriers: {sensors: flange, targets: base, poses: {frames: [base, flange], columns: [rx, ry, rz, tx, ty, tz]}}
sensors:
  scanner: {clouds: "*.pcd", poses: poses.txt, unit_m: 0.001}
  camera: {images: images, poses: poses.txt, intrinsics: camera.yaml}
targets:
  heap: {type: object}
  tag: {type: tag, family: tag36h11, id: 1, size_m: 0.1}
"""
DEPTH = "depth: {clouds: depth, poses: poses.txt, intrinsics: {K: [300.0, 300.0, 99.5, 99.5], size: [200, 200]}}"
SCANNER = 'scanner: {clouds: "*.pcd", poses: poses.txt, unit_m: 0.001}'


def test_clouds_and_images_may_stand_in_one_file() -> None:
    rig = parse_rig(TEXT, "rig.yaml")
    assert (rig.object, list(rig.printed), [target.name for target in rig.target_list]) == ("heap", ["tag"], ["tag"])
    assert rig.carriers.poses.stated.columns == "rx ry rz tx ty tz"
    assert parse_rig(rig_text(rig), "again") == rig
    assert parse_rig(TEXT.replace(SCANNER, DEPTH), "rig.yaml").sensors["depth"].clouds == "depth"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("  heap: {type: object}\n", "", r"line 3: sensors\.scanner\.clouds: clouds, and no target that they show"),
        ("heap: {type: object}", "heap: {type: object}\n  pile: {type: object}", r"line 7: targets\.pile: clouds"),
        ("heap: {type: object}", "heap: {type: object, size_m: 1.0}", r"line 6: targets\.heap\.size_m"),
        ("images: images", "images: images, unit_m: 0.001", r"line 4: .*unit_m is the unit of clouds"),
        ("unit_m: 0.001", "unit_m: -1.0", r"line 3: .*must be above 0"),
        ("unit_m: 0.001", "time_offset: estimate", r"line 3: .*a clock is not estimated from clouds"),
        (SCANNER, f"{SCANNER}\n  {DEPTH}", r"line 4: sensors\.depth\.clouds: scanner has clouds too"),
        (SCANNER, DEPTH.replace("clouds: depth, ", ""), r"line 3: .*nothing given; give one of images"),
        (SCANNER, f"{DEPTH[: DEPTH.index('{K')]}estimate}}", r"line 3: .*a board"),
        ("frames: [base, flange]", "tf: [base, flange]", r"columns: only for poses in files"),
    ],
)  # fmt: skip
def test_each_fault_has_its_line(old: str, new: str, words: str) -> None:
    assert old in TEXT
    with pytest.raises(RigError, match=words):
        parse_rig(TEXT.replace(old, new), "rig.yaml")


def test_an_object_needs_clouds() -> None:
    text = "".join(line for line in TEXT.splitlines(keepends=True) if "clouds" not in line)
    with pytest.raises(RigError, match=r"line 5: targets\.heap: an object is seen in clouds"):
        parse_rig(text, "rig.yaml")
