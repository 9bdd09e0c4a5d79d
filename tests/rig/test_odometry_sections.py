"""Sections of sensors that know only their own motion, of clouds, and of Kalibr's targets: faults with their lines."""

from __future__ import annotations

from pathlib import Path

import pytest
from rig_texts import MINIMAL
from test_rig_reference import faults

from gtsam_rwhec.errors import RigError
from gtsam_rwhec.rig import GivenDistance, OdometryNoiseSection, parse_rig, rig_text

VEHICLE = """\
reference: lidar_front
sensors:
  lidar_front: {odometry: {topic: /front/odom}}
  lidar_rear:
    odometry: {topic: /rear/odom, noise: {rotation_deg_per_sqrt_s: 0.05, translation_mm_per_sqrt_s: 4}}
    time_offset: estimate
  camera_left: {odometry: {tf: [vo, cam], scale: estimate, noise: estimate}, frame: cam_left_optical}
  wheels: {odometry: {file: wheels.tum}}
given:
  heights_m: {lidar_front: 0.52, lidar_rear: 0.71}
  ground: {up: [0, 0, 2], below_m: 0.52}
  directions: [{sensor: wheels, of: lever_arm, in_reference: [1, 0, 0]}]
  distances:
    - {between: [lidar_front, lidar_rear], distance_m: 2.41}
"""
MIXED = MINIMAL.replace("sensors: {", "sensors: {wheels: {odometry: {topic: /odom}}, ")


def test_the_reference_carries_the_others() -> None:
    rig = parse_rig(VEHICLE, "rig.yaml")
    assert (rig.carriers.sensors, rig.carriers.targets) == ("lidar_front", "lidar_front_start")
    assert rig.carriers.poses.topic == "/front/odom"
    assert rig.calibrated == ("lidar_rear", "camera_left", "wheels")
    assert (list(rig.sensors), len(rig.odometries), rig.targets) == ([], 4, {})
    assert (rig.frame_of("lidar_front"), rig.frame_of("camera_left")) == ("lidar_front", "cam_left_optical")
    assert rig.odometries["lidar_rear"].odometry.noise == OdometryNoiseSection(
        rotation_deg_per_sqrt_s=0.05, translation_mm_per_sqrt_s=4.0
    )
    assert rig.odometries["camera_left"].odometry.noise is None
    assert rig.given.ground is not None
    assert rig.given.ground.up == (0.0, 0.0, 1.0)
    assert rig.given.distances == (GivenDistance(between=("lidar_front", "lidar_rear"), distance_m=2.41),)


@pytest.mark.parametrize("text", [VEHICLE, MIXED], ids=["vehicle", "mixed"])
def test_what_is_written_reads_back_equal_and_the_schema_takes_it(text: str) -> None:
    rig = parse_rig(text, "rig.yaml")
    assert parse_rig(rig_text(rig), "written") == rig
    assert faults(text) == faults(rig_text(rig)) == []


def test_a_reference_of_tf_names_both_frames() -> None:
    text = VEHICLE.replace("reference: lidar_front", "reference: wheels").replace("{file: wheels.tum}", "{tf: [o, w]}")
    rig = parse_rig(text.partition("given:")[0], "rig.yaml")
    assert (rig.carriers.sensors, rig.carriers.targets, rig.carriers.poses.tf) == ("w", "o", ("o", "w"))


def test_cameras_and_odometries_are_told_apart_in_a_mixed_rig() -> None:
    rig = parse_rig(MIXED, "rig.yaml")
    assert (list(rig.sensors), list(rig.odometries), rig.calibrated) == (["cam"], ["wheels"], ("wheels", "cam"))
    with pytest.raises(RigError, match=r"line 3: targets: none; give at least one target"):
        parse_rig(MIXED.replace("{tag: {type: tag, family: tag36h11, id: 3, size_m: 0.1}}", "{}"), "rig.yaml")


@pytest.mark.parametrize(
    ("right", "wrong", "line", "words"),
    [
        ("reference: lidar_front", "reference: lidar_frnt", 1, "reference: there is no sensor 'lidar_frnt'; did you"),
        ("reference: lidar_front\n", "", 1, "carriers: is missing: .* such as reference: lidar_front"),
        ("reference: lidar_front", "reference: 3", 1, "reference: 3; give the name of a sensor"),
        ("reference: lidar_front", "reference: camera_left", 1, "reference: lengths of camera_left are not known"),
        (
            "sensors:",
            "carriers: {sensors: a, targets: b, poses: {tf: [a, b]}}\nsensors:",
            1,
            "reference: lidar_front carries the sensors, and so does a of carriers",
        ),
        ("scale: estimate", "scale: guess", 7, "odometry.scale: 'guess'; give 'known' or 'estimate'"),
        ("scale: estimate", "scal: estimate", 7, r"odometry.scal: unknown key; did you mean scale\?"),
        ("/rear/odom", "/front/odom", 5, "topic /front/odom is also the odometry of sensor lidar_front"),
        ("topic: /rear/odom, ", "topic: /r, file: x, ", 5, "odometry: topic and file given; give one of topic"),
        ("{file: wheels.tum}", "3", 8, "sensors.wheels.odometry: 3; give a section with topic, tf, file, clouds"),
        ("    time_offset", "    images: /i\n    time_offset", 6, "lidar_rear.images: unknown key; known keys are"),
        ("/front/odom}}", "/front/odom}, time_offset: 0.1}", 3, "time_offset: 0.1, and its clock is the one"),
        ("lidar_rear: 0.71", "lidar_rare: 0.71", 10, "lidar_rare: there is no sensor lidar_rare .* mean lidar_rear"),
        ("below_m: 0.52", "below_m: 0.62", 10, "heights_m.lidar_front: 0.52 m above the ground, and given.ground"),
        ("{lidar_front: 0.52, lidar_rear: 0.71}\n  ground: {up: [0, 0, 2], below_m: 0.52}", "{lidar_rear: 1}", 10,
         "heights are compared with that of the reference"),
        ("lidar_rear: 0.71", "lidar_rear: -0.71", 10, "-0.71 m is below the ground, which is 0.52 m below lidar_front"),
        ("[0, 0, 2]", "[0, 0, 0]", 11, "given.ground.up: .* no direction; give three numbers"),
        ("sensor: wheels", "sensor: lidar_front", 12, "lidar_front is the reference, in whose axes"),
        ("of: lever_arm", "of: w", 12, r"given.directions\[0\].of: 'w'; give 'x', 'y', 'z' or 'lever_arm'"),
        ("distance_m: 2.41", "distance_m: 0.1", 14, "the heights of lidar_front and lidar_rear differ by 0.19 m"),
        ("distance_m: 2.41", "distance: 2.41", 14, r"distance: unknown key; did you mean distance_m\?"),
        ("[lidar_front, lidar_rear]", "[wheels, wheels]", 14, "wheels twice; name two sensors"),
        ("given:", "targets: {t: {type: tag, family: tag36h11, id: 3, size_m: 0.1}}\ngiven:", 9, "no sensor sees them"),
    ],
    ids=lambda value: str(value).split("\n")[0][:40],
)  # fmt: skip
def test_every_fault_has_its_line(right: str, wrong: str, line: int, words: str) -> None:
    assert right in VEHICLE
    with pytest.raises(RigError, match=rf"rig\.yaml, line {line}: .*{words}"):
        parse_rig(VEHICLE.replace(right, wrong, 1), "rig.yaml")


def test_given_needs_a_reference() -> None:
    with pytest.raises(RigError, match=r"line 4: given: is used with reference: NAME"):
        parse_rig(MIXED + "given: {heights_m: {wheels: 0.3}}\n", "rig.yaml")


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
