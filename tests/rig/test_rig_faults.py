"""Every fault that a rig file can have, with its line."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from counted_calls import counted_calls
from rig_texts import FULL, MINIMAL

from gtsam_rwhec.errors import RigError
from gtsam_rwhec.rig import parse_rig
from gtsam_rwhec.rig.rig_file import MOST_FAULTS

# What stands in place of what, the line that the message has, and its words.
FAULTS = [
    ("  sensors: hand", "  sensers: hand", 2, "carriers.sensors: is missing: the frame that carries the sensors"),
    ("  sensors: hand", "  sensers: hand", 3, "carriers.sensers: unknown key; did you mean sensors?"),
    ("sizes: check", "sizes: right", 29, "sizes: 'right'; give 'known', 'check' or 'estimate'"),
    ("[base, hand]", "[base, arm]", 5, "carriers.poses.tf: poses of arm in base are not poses of the carriers;"),
    ("[base, hand]", "base", 5, "carriers.poses.tf: 'base'; give two frames, [parent, child]"),
    ("[base, hand]", "[base, /hand]", 5, "'/hand' cannot be a frame's name: a name has first a letter,"),
    ("{tf: [base, hand]}", "{topic: /pose}", 5, "carriers.poses: name the frames of the poses of /pose: parent:"),
    ("{tf: [base, hand]}", "{}", 5, "carriers.poses: nothing given; give one of tf: [parent, child], topic: ..."),
    ("{tf: [base, hand]}", "{tf: [base, hand], child: hand}", 5, "tf names both frames already; leave parent"),
    ("targets: base", "targets: hand", 4, "carriers.targets: 'hand' also carries the sensors; name two different"),
    ("max_gap_s: 0.3", "max_gap_s: 0", 6, "carriers.max_gap_s: 0 must be above 0"),
    ("max_gap_s: 0.3", "max_gap_s: .inf", 6, "carriers.max_gap_s: inf; give a finite number"),
    ("rotation_deg: 0.02, ", "", 7, "is missing: standard deviation about each axis, degrees, such as"),
    ("cam_left:", "2cam:", 9, "sensors.2cam: '2cam' cannot be a frame's name: a name has first a letter, then"),
    ("cam_left:", "c" * 101 + ":", 9, "at most 100 characters"),
    ("cam_left:", "hand:", 9, "sensors.hand: 'hand' is already the name of the sensors' carrier; each frame needs"),
    ("cam_left:", "tag_0:", 25, "targets.tag_0: 'tag_0' is already the name of sensor tag_0; each frame needs its"),
    ("frame: cam_left_optical", "frame: cam_right", 14, "'cam_right' is already the name of the frame"),
    ("images: /cam_left/image", "images: 3", 10, "sensors.cam_left.images: 3; give text (in quotes if it looks like"),
    ("images: /cam_left/image", 'images: "/a\\e"', 10, "sensors.cam_left.images: '/a\\x1b' has unprintable"),
    ("images: /cam_right/image", "images: /cam_left/image", 15, "sensors.cam_right.images: /cam_left/image is also"),
    ("detections: /tag_detections", "detections: /t\n    images: /i", 22, "sensors.driver: images and detections"),
    ("detections: /tag_detections", "images: /i", 22, "sensors.driver: images without intrinsics; give FILE,"),
    ("{topic: /cam_left/camera_info}", "{topic: /c, camera: cam0}", 11, "sensors.cam_left.intrinsics: camera goes"),
    ("{topic: /cam_left/camera_info}", "{estimate: any, stated: nominal}", 11, "stated: nominal, and they are to be"),
    ("{topic: /cam_left/camera_info}", "{estimate: any, size: [640, 480]}", 11, "estimate and numbers given"),
    ("{topic: /cam_left/camera_info}", "{estimate: omni}", 11, "'omni'; give 'any', 'pinhole', 'radtan',"),
    ("detections: /tag", "intrinsics: estimate\n    detections: /tag", 22, "intrinsics: estimate needs images"),
    ("      width: 640\n", "", 16, "sensors.cam_right.intrinsics: size: [width, height] missing"),
    ("width: 640", "width: 0", 16, "sensors.cam_right.intrinsics: these numbers: the image size is 0 x 480 pixels"),
    ("model: equidistant", "model: omni", 16, "sensors.cam_right.intrinsics: these numbers: distortion model 'omni'"),
    ("K: [300, 300.5, 320, 240]", "K: [3, 3, 320, 240]", 16, "sensors.cam_right.intrinsics: these numbers: fx = 3"),
    ("D: [0.01, 0, 1e-4, -0.0]", "D: 0", 21, "sensors.cam_right.intrinsics.D: 0; give a list, [..., ...]"),
    ("time_offset: estimate", "time_offset: guess", 12, "sensors.cam_left.time_offset: 'guess'; give seconds, or the"),
    ("size_m: 0.12", "size_m: 120", 25, "targets.tag_0.size_m: 120 m is 10 m or more; if it is in millimetres,"),
    ("size_m: 0.12", "size_m: 0", 25, "targets.tag_0.size_m: 0 is not a length; give metres, above 0"),
    ("size_m: 0.12", "size_mm: 120", 25, "is missing: side of the black square, m, such as size_m: 0.12"),
    ("size_m: 0.12", "size_mm: 120", 25, "targets.tag_0.size_mm: unknown key; did you mean size_m?"),
    ("type: tag,", "type: aruco,", 25, "targets.tag_0.type: 'aruco'; give one of tag, charuco, aprilgrid,"),
    ("type: tag,", "", 25, "is missing: give one of tag, charuco, aprilgrid, tag_grid, bundle, checkerboard"),
    ("family: tag36h11, id: 0", "family: 36h11, id: 0", 25, "targets.tag_0: there is no family '36h11'; there are"),
    ("id: 0,", "id: 587,", 25, "targets.tag_0: ids 587 to 587 are not in tag36h11: 0 to 586"),
    ("id: 0,", "id: 10,", 27, "targets.grid: tags 10 of tag36h11 also belong to target tag_0: the targets look"),
    ("marker_m: 0.03075", "marker_m: 0.05", 26, "targets.board: marker_m = 0.05 must be less than square_m ="),
    ("inner_corners: [9, 6]", "inner_corners: [9000000000, 6]", 28, "targets.chess: 9000000000 columns and 6 rows;"),
    ("spacing: 0.3", "spacing: 30", 27, "targets.grid: spacing = 30.0; give gap / tag size, above 0 and at most 10"),
    (
        "sizes: check",
        "  chess_b: {type: checkerboard, inner_corners: [6, 9], square_m: 1}",
        29,
        "the boards look the same",
    ),
    ("sizes: check", "  t: {type: tag, family: aruco_5x5_50, id: 16, size_m: 1}", 29, "also belong to target board"),
    (
        "sizes: check",
        "  g: {type: tag_grid, family: tag36h11, tags: [2, 1], tag_m: 1, gap_m: 1, ids: [200, 12]}",
        29,
        "tags 12 of tag36h11 also belong to target grid",
    ),
    (
        "sizes: check",
        "  b: {type: bundle, family: tag36h11, layout: [{id: 0, size: 1}]}",
        29,
        "tags 0 of tag36h11 also belong to target tag_0",
    ),
    (
        "sizes: check",
        "  b: {type: bundle, family: tag36h11, layout: [{id: 300, siz: 1}]}",
        29,
        "targets.b.layout[0].siz: unknown key; did you mean size?",
    ),
    ("noise: estimate", "noise:", 30, "corner_px, such as noise: {corner_px: 0.1}"),
    ("noise: estimate", "noise: {rotation_deg: 1}", 30, "noise: rotation_deg given; give rotation_deg and"),
    ("min_side_px: 18", "min_side_px: big", 31, "detection.min_side_px: DetectionOptions.min_side_px='big'; give a"),
    ("thin: false", "thin: no", 38, "cleaning.thin: 'no'; give true or false"),
    ("robust: gnc", "robust: ransac", 39, "cleaning.robust: 'ransac'; give 'none', 'huber', 'cauchy', 'tukey',"),
    ("sizes: check", "targets: {}", 29, "targets is there twice, first in line 24; keep one."),
]


@pytest.mark.parametrize(("old", "new", "line", "words"), FAULTS)
def test_every_fault_has_its_line(old: str, new: str, line: int, words: str) -> None:
    assert old in FULL
    with pytest.raises(RigError) as caught:
        parse_rig(FULL.replace(old, new, 1), "my/rig.yaml")
    faults = str(caught.value).split("\n")
    assert any(fault.startswith(f"my/rig.yaml, line {line}: ") and words in fault for fault in faults), faults
    assert all(fault.startswith("my/rig.yaml, line ") for fault in faults)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "rig.yaml is empty"),
        ("3", "line 1: 3 in place of the sections"),
        ("- a\n- b", "line 1: ['a', 'b'] in place of the sections"),
        ("a: [", "line 1: not YAML"),
        ("\nsensors: &x {}", "line 2: the anchor &x"),
        ("sensors: !!python/name:os.system {}", "the tag '!!python/name:os.system'"),
        (MINIMAL.replace("{cam: {detections: /tags}}", "{}"), "line 2: sensors: none; give at least one"),
        (MINIMAL.replace("{cam: {detections: /tags}}", ""), "line 2: sensors: empty; give a section"),
        (MINIMAL.replace("cam: {detections", "images: {detection"), "sensors.images.detection: unknown key; did"),
        (MINIMAL.replace("{cam: {detections: /tags}}", "{cam: }"), "line 2: sensors.cam: empty; give a section with"),
        (MINIMAL.replace("{tag: {type: tag, family: tag36h11, id: 3, size_m: 0.1}}", "{}"), "line 3: targets: none"),
        (MINIMAL.replace("{type: tag, family: tag36h11, id: 3, size_m: 0.1}", "3"), "line 3: targets.tag: 3; give a"),
        ("sizes: known", "line 1: carriers: is missing: the frames that carry the sensors"),
    ],
)
def test_files_that_are_none(text: str, words: str) -> None:
    with pytest.raises(RigError) as caught:
        parse_rig(text, "rig.yaml")
    assert words in str(caught.value)


def test_all_faults_are_listed_by_line_and_counted() -> None:
    text = FULL.replace("size_m: 0.12", "size_m: 120").replace("sensors: hand", "sensors: 3").replace("thin:", "thick:")
    with pytest.raises(RigError) as caught:
        parse_rig(text, "f")
    lines = [fault.split(":")[0] for fault in str(caught.value).split("\n")]
    assert lines == ["f, line 3", "f, line 25", "f, line 38", "f, line 38"][:3]
    with pytest.raises(RigError) as caught:
        parse_rig("\n".join(f"key{i}: 1" for i in range(30)), "f")
    assert str(caught.value).split("\n")[20:] == ["and 13 more faults"]


def refused(text: str) -> str:
    with pytest.raises(RigError) as caught:
        parse_rig(text, "f")
    return str(caught.value)


def tags(count: int) -> str:
    lines = "".join(f"  t{i}: {{type: tag, family: tag36h11, id: {i % 100}, size_m: 0.1}}\n" for i in range(count))
    return MINIMAL.rpartition("targets:")[0] + "targets:\n" + lines


def unknown_keys(count: int) -> str:
    return MINIMAL + "".join(f"extra{i}: 1\n" for i in range(count))


@pytest.mark.parametrize(
    ("text", "fault", "calls"),
    [(tags, "tags 0 of tag36h11 also belong to target t0", 1800), (unknown_keys, "extra0: unknown key", 400)],
)
def test_thousands_of_faults_take_work_in_proportion(text: Callable[[int], str], fault: str, calls: int) -> None:
    said, counted = counted_calls(lambda: refused(text(600)))
    assert fault in said
    assert len(said.split("\n")) == MOST_FAULTS + 1
    assert counted < 600 * calls
