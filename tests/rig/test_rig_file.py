"""Rig files: all that one can say, every fault with its line, lines marked TODO; what is written reads back equal."""

from __future__ import annotations

import re
import shutil
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import Any, get_args

import jsonschema
import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from places import CELL, REPOSITORY
from rig_texts import FULL, MINIMAL

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.cameras.targets import AprilGrid, Charuco, Checkerboard, Tag
from gtsam_rwhec.detect.detections import DetectionOptions
from gtsam_rwhec.errors import RigError, UnfinishedRigWarning
from gtsam_rwhec.fitting.fit_options import Robust
from gtsam_rwhec.rig import (
    TEMPLATES,
    AprilGridTarget,
    BundleTarget,
    Carriers,
    CharucoTarget,
    CheckerboardTarget,
    Cleaning,
    DetectionNoise,
    Intrinsics,
    Link,
    PoseAccuracy,
    PoseNoise,
    PoseSource,
    Rig,
    Sensor,
    TagGridTarget,
    TagTarget,
    TodoLine,
    parse_rig,
    read_rig,
    rig_file_schema,
    rig_text,
    template_text,
    todo_lines,
)
from gtsam_rwhec.rig.rig_file import TemplateName
from gtsam_rwhec.rig.target_sections import BundleTagPlace


def test_everything_is_read(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(FULL)
    rig = read_rig(path)
    assert rig.folder == tmp_path
    assert rig.carriers == Carriers(
        sensors="hand", targets="base", poses=PoseSource(tf=("base", "hand")), max_gap_s=0.3,
        noise=PoseNoise(rotation_deg=0.02, translation_mm=0.2),
    )  # fmt: skip
    assert list(rig.sensors) == ["cam_left", "cam_right", "driver"]
    assert rig.sensors["cam_left"] == Sensor(
        images="/cam_left/image", intrinsics=Intrinsics(topic="/cam_left/camera_info"), time_offset="estimate",
        frame="cam_left_optical",
    )  # fmt: skip
    right = rig.sensors["cam_right"].intrinsics
    assert right is not None
    assert right.K == (300.0, 300.5, 320.0, 240.0)
    assert right.D == (0.01, 0.0, 1e-4, 0.0)
    assert (rig.frame_of("cam_left"), rig.frame_of("driver")) == ("cam_left_optical", "driver")
    assert rig.target_list == (
        Tag("tag_0", "tag36h11", 0, 0.12),
        Charuco("board", "aruco_5x5_100", 7, 5, 0.041, 0.03075),
        AprilGrid("grid", "tag36h11", 6, 6, 0.088, 0.3, 10),
        Checkerboard("chess", 9, 6, 0.03),
    )
    assert (rig.sizes, rig.noise) == ("check", "estimate")
    assert rig.detection == {"min_side_px": 18, "max_reprojection_px": 2.0}
    assert rig.cleaning == Cleaning(max_translation_m_s=0.5, thin=False)


def test_the_link_of_a_camera_is_a_name_or_a_section_and_is_no_other_frame() -> None:
    section = "{frame: camera_link, T_link_optical: [0.0, 0.015, 0.0, -0.5, 0.5, -0.5, 0.5]}"
    for link, T in (("camera_link", None), (section, (0.0, 0.015, 0.0, -0.5, 0.5, -0.5, 0.5))):
        rig = parse_rig(MINIMAL.replace("/tags}", f"/tags, link: {link}}}"), "rig.yaml")
        assert rig.sensors["cam"].link == Link(frame="camera_link", T_link_optical=T)
        assert parse_rig(rig_text(rig), "rig.yaml") == rig
    for wrong, words in (
        ("hand", r"sensors\.cam\.link: 'hand' is already the name of the sensors' carrier"),
        ("cam", r"sensors\.cam\.link: 'cam' is already the name of sensor cam"),
        (section.replace("-0.5, 0.5, -0.5", "0.5, -0.5, 0.9"), r"link: the quaternion .* has the length 1\.2"),
        (section.replace("0.015, ", ""), r"T_link_optical: .*; give \[x, y, z, qx, qy, qz, qw\], metres"),
    ):
        with pytest.raises(RigError, match=words):
            parse_rig(MINIMAL.replace("/tags}", f"/tags, link: {wrong}}}"), "rig.yaml")


def test_what_is_left_out() -> None:
    rig = parse_rig(MINIMAL, "rig.yaml")
    assert rig.carriers.max_gap_s == 0.2
    assert rig.carriers.noise is None
    assert rig.carriers.arm is True
    text = FULL.replace("  noise: {rot", "  accuracy: {rotation_deg: 0.05, translation_mm: 0.5}\n  noise: {rot", 1)
    assert parse_rig(text, "f").carriers.accuracy == PoseAccuracy(rotation_deg=0.05, translation_mm=0.5)
    assert parse_rig(text, "f").carriers.arm == rw.ArmAccuracy(np.radians(0.05), 5e-4)
    assert rig.sensors["cam"] == Sensor(detections="/tags", time_offset=0.0)
    assert (rig.sizes, rig.noise, rig.detection, rig.cleaning) == ("check", "estimate", {}, Cleaning())
    assert Cleaning().model_dump() == {
        "min_rotation_deg": 0.5, "min_translation_mm": 3.0, "max_rotation_deg_s": None, "max_translation_m_s": None,
        "consensus": True, "thin": True, "robust": "gnc",
    }  # fmt: skip
    assert rig.folder == Path()


@pytest.mark.parametrize("noise", [{"corner_px": 0.3}, {"rotation_deg": 1.0, "translation_mm": 2.0}])
def test_noise_given(noise: dict[str, float]) -> None:
    assert parse_rig(FULL.replace("noise: estimate", f"noise: {noise}"), "rig.yaml").noise == DetectionNoise(**noise)


def test_poses_of_a_topic_in_either_direction() -> None:
    for parent, child in (("base", "hand"), ("hand", "base")):
        text = FULL.replace("{tf: [base, hand]}", f"{{topic: /pose, parent: {parent}, child: {child}}}")
        source = parse_rig(text, "rig.yaml").carriers.poses
        assert source == PoseSource(topic="/pose", parent=parent, child=child)
        assert source.parent_and_child == (parent, child)
    assert parse_rig(FULL.replace("[base, hand]", "[hand, base]"), "f").carriers.poses.parent_and_child == (
        "hand",
        "base",
    )


@pytest.mark.parametrize(
    "source",
    ["file: left.yaml", "kalibr: camchain.yaml, camera: cam0", "topic: /camera_info", "K: [9, 9, 4, 4], size: [9, 9]"],
)
def test_every_form_of_intrinsics_says_where_they_come_from(source: str) -> None:
    def stated(intrinsics: str) -> str:
        rig = parse_rig(MINIMAL.replace("detections: /tags", f"images: /image, intrinsics: {intrinsics}"), "rig.yaml")
        assert parse_rig(rig_text(rig), "rig.yaml") == rig
        return rig.sensors["cam"].stated

    assert stated(f"{{{source}}}") == "nominal"
    assert stated(f"{{{source}, stated: nominal}}") == "nominal"
    assert stated(f"{{{source}, stated: calibration}}") == "calibration"
    assert stated("left.yaml") == "nominal"
    assert parse_rig(MINIMAL, "rig.yaml").sensors["cam"].stated == "unknown"  # a driver's detections
    with pytest.raises(
        RigError, match=r"line 2: sensors.cam.intrinsics.stated: 'factory'; give 'exact', 'calibration' or"
    ):
        stated(f"{{{source}, stated: factory}}")


def test_intrinsics_may_be_estimated() -> None:
    def sensor(intrinsics: str) -> Sensor:
        rig = parse_rig(MINIMAL.replace("detections: /tags", f"images: /image, intrinsics: {intrinsics}"), "rig.yaml")
        assert parse_rig(rig_text(rig), "rig.yaml") == rig
        return rig.sensors["cam"]

    assert sensor("estimate").intrinsics == Intrinsics(estimate="any")
    assert sensor("estimate").stated == "unknown"
    assert sensor("{estimate: equidistant}").intrinsics == Intrinsics(estimate="equidistant")
    assert sensor("{file: estimate}").stated == "nominal"  # a file of this name


def test_lists_that_are_kept_elsewhere_too() -> None:
    assert get_args(Cleaning.model_fields["robust"].annotation) == get_args(Robust)
    options = asdict(DetectionOptions())
    text = MINIMAL + f"detection: {{{', '.join(f'{key}: {value}' for key, value in options.items())}}}"
    assert parse_rig(text, "f").detection == options


NAMES = st.from_regex(r"[a-z][a-zA-Z0-9_]{0,5}(/[A-Za-z0-9_]{1,4})?", fullmatch=True)
#: What str.isprintable() takes.
PRINTABLE = st.characters(exclude_categories=("C", "Zl", "Zp", "Zs"), include_characters=" ")
TOPICS = st.text(PRINTABLE, min_size=1, max_size=12) | st.sampled_from(["/a/b", "no", "a: b", "1e3", "# x"])
POSITIVE = st.floats(1e-300, 1e300)
LENGTHS = st.floats(1e-9, 9.99)
INTRINSICS = st.one_of(
    st.builds(
        lambda topic, stated: Intrinsics(topic=topic, stated=stated),
        TOPICS, st.sampled_from([None, "calibration", "nominal"]),
    ),
    st.builds(lambda path, camera: Intrinsics(kalibr=path, camera=camera), TOPICS, TOPICS),
    st.builds(lambda path: Intrinsics(file=path), TOPICS),
    st.builds(
        lambda f, c, D: Intrinsics(model="radtan", width=640, height=480, K=(f, f, *c), D=D),
        st.floats(100, 900), st.tuples(st.floats(0, 640), st.floats(0, 480)),
        st.lists(st.floats(-1, 1), min_size=5, max_size=5).map(tuple).filter(any),
    ),
)  # fmt: skip

ESTIMATED = st.builds(
    lambda lens: Intrinsics(estimate=lens), st.sampled_from(["any", "pinhole", "radtan", "equidistant"])
)


@st.composite
def rigs(draw: st.DrawFn) -> Rig:
    names = iter(draw(st.lists(NAMES, min_size=14, max_size=14, unique=True)))
    topics = iter(draw(st.lists(TOPICS, min_size=6, max_size=6, unique=True)))
    hand, base = next(names), next(names)
    tf = draw(st.permutations((hand, base)))
    poses = PoseSource(tf=(tf[0], tf[1])) if draw(st.booleans()) else PoseSource(
        topic=next(topics), parent=tf[0], child=tf[1]
    )  # fmt: skip
    noise = st.builds(PoseNoise, rotation_deg=POSITIVE, translation_mm=POSITIVE)
    carriers = Carriers(
        sensors=hand,
        targets=base,
        poses=poses,
        max_gap_s=draw(POSITIVE),
        noise=draw(st.none() | noise),
        accuracy=draw(st.none() | st.builds(PoseAccuracy, rotation_deg=POSITIVE, translation_mm=POSITIVE)),
    )
    sensors = {}
    for _ in range(draw(st.integers(1, 3))):
        source: dict[str, Any] = {draw(st.sampled_from(["images", "detections"])): next(topics)}
        intrinsics = draw(INTRINSICS | ESTIMATED if "images" in source else st.none() | INTRINSICS)
        offset = draw(st.just("estimate") | st.floats(-1e9, 1e9))
        frame = next(names) if draw(st.booleans()) else None
        sensors[next(names)] = Sensor(**source, intrinsics=intrinsics, time_offset=offset, frame=frame)
    targets = {
        next(names): TagTarget(type="tag", family="tag36h11", id=draw(st.integers(0, 99)), size_m=draw(LENGTHS)),
        next(names): CharucoTarget(
            type="charuco", family="aruco_5x5_100", squares=(5, 3), square_m=1.0, marker_m=draw(st.floats(0.1, 0.9))
        ),
        next(names): AprilGridTarget(
            type="aprilgrid", family="tag36h11", tags=(3, 2), tag_m=draw(LENGTHS), spacing=0.3, first_id=100
        ),
        next(names): CheckerboardTarget(type="checkerboard", inner_corners=(5, 4), square_m=draw(LENGTHS)),
        next(names): TagGridTarget(
            type="tag_grid", family="aruco_4x4_50", tags=(2, 1), tag_m=draw(LENGTHS), gap_m=0.01,
            ids=draw(st.none() | st.just((7, 3))),
        ),
        next(names): BundleTarget(
            type="bundle", family="tag25h9", layout=(BundleTagPlace(id=1, size=draw(LENGTHS), z=draw(LENGTHS)),)
        ),
    }  # fmt: skip
    some = draw(st.sets(st.sampled_from(sorted(targets)), min_size=1))
    return Rig(
        carriers=carriers,
        sensors=sensors,
        targets={name: target for name, target in targets.items() if name in some},
        sizes=draw(st.sampled_from(["known", "check", "estimate"])),
        noise=draw(
            st.sampled_from(
                ["estimate", DetectionNoise(corner_px=0.3), DetectionNoise(rotation_deg=1e-7, translation_mm=1.0)]
            )
        ),
        detection=draw(st.dictionaries(st.sampled_from(["min_side_px", "max_blur_px"]), st.floats(1e-300, 1e300))),
        cleaning=Cleaning(
            min_rotation_deg=draw(POSITIVE), max_translation_m_s=draw(st.none() | POSITIVE), thin=draw(st.booleans())
        ),
    )


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(rigs())
def test_what_is_written_reads_back_equal(rig: Rig) -> None:
    text = rig_text(rig)
    again = parse_rig(text, "rig.yaml")
    assert again == rig
    assert list(again.targets) == list(rig.targets)
    assert rig_text(again) == text
    # Other readers of YAML see the same: here PyYAML, which is of YAML 1.1.
    seen = yaml.safe_load(text)
    assert seen["carriers"]["max_gap_s"] == rig.carriers.max_gap_s
    assert [s.get("images", s.get("detections")) for s in seen["sensors"].values()] == [
        s.images or s.detections for s in rig.sensors.values()
    ]


@settings(max_examples=150, deadline=None)
@given(st.binary(max_size=60) | st.text(st.sampled_from("carsen:o \n-{}[],&*!'\"1.te"), max_size=80).map(str.encode))
def test_random_files(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "random.yaml"
    path.write_bytes(content)
    with pytest.raises(RigError, match=r"random\.yaml"):
        read_rig(path)


WORDS = [
    "", "null", "[]", "{}", "-1", "0", "1e400", ".nan", "true", "'", '"', "{", "}", "[", "]", ":", "\n", "  ", "\t",
    "hand", "base", "tag", "estimate", "99999999999999999999", "\ud800", "\x00", "é", "- ", "? ", "<<", "!!int ",
    "&a ", "*a", "[key]", "type", "noise: ", "{tag: {tag: 1}}",
]  # fmt: skip


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_mutated_files(data: st.DataObject) -> None:
    text = FULL
    for _ in range(data.draw(st.integers(1, 4))):
        # A whole word, as a rule: then what is wrong gets as far as the schema.
        start = data.draw(st.integers(0, len(text) - 1))
        end = min(len(text), start + data.draw(st.integers(0, 12)))
        if data.draw(st.booleans()):
            while start > 0 and text[start - 1].isalnum():
                start -= 1
            end = start + 1
            while end < len(text) and text[end].isalnum():
                end += 1
        text = text[:start] + data.draw(st.sampled_from(WORDS)) + text[end:]
    try:
        rig = parse_rig(text, "rig.yaml")
    except RigError:
        return
    assert parse_rig(rig_text(rig), "again") == rig


def test_the_targets_of_the_page_on_logs_are_read() -> None:
    page = (REPOSITORY / "docs" / "from_a_log.md").read_text(encoding="utf-8")
    targets = re.search(r"```yaml\n(targets:.*?)```", page, re.DOTALL)
    assert targets is not None
    rig = yaml.safe_load((CELL / "rig.yaml").read_text(encoding="utf-8")) | yaml.safe_load(targets[1])
    kinds = {type(target).__name__ for target in parse_rig(yaml.safe_dump(rig), "the page").target_list}
    assert kinds == {"Tag", "Charuco", "AprilGrid", "TagGrid", "Bundle", "Checkerboard", "CircleGrid"}


CAMERAS = """\
carriers: {sensors: base, targets: hand, poses: {frames: [base, hand]}}
sensors:
  left: {images: left, poses: poses, intrinsics: {K: [9, 9, 4, 4], size: [9, 9], stated: exact}}
  right: {images: right, poses: poses, intrinsics: {shared: left}}
targets:
  board: {type: checkerboard, inner_corners: [3, 4], square_m: 0.05}
"""


def test_a_camera_that_is_shared_is_stated_as_the_other_one() -> None:
    rig = parse_rig(CAMERAS, "rig.yaml")
    assert rig.shared == (("left", "right"),)
    assert rig.stated_of("right") == rig.stated_of("left") == "exact"
    assert parse_rig(rig_text(rig), "rig.yaml") == rig


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("shared: left", "shared: middle", "line 4: sensors.right.intrinsics.shared: middle is no sensor of this file"),
        ("shared: left", "shared: right", "right states no intrinsics of its own; these sensors do: left"),
        ("shared: left", "shared: left, stated: nominal", "stated: nominal, and left has the intrinsics; say it there"),
        ("shared: left", "shared: left, file: a.yaml", "give one of"),
        ("stated: exact", "model: radtan", "line 3: sensors.left.intrinsics: model: radtan, and D has 0 numbers; give"),
        ("stated: exact", "model: equidistant, D: [0.1]", "equidistant, and D has 1 numbers; give all"),
    ],
)
def test_shared_cameras_that_are_none(old: str, new: str, words: str) -> None:
    with pytest.raises(RigError) as caught:
        parse_rig(CAMERAS.replace(old, new), "rig.yaml")
    assert words in str(caught.value)


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
    with warnings.catch_warnings(action="error"):
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
    assert set(rig.printed) <= marked, "the targets' sizes are marked"
    assert {"images", "clouds", "detections", *rig.sensors} & marked, "where the images are is marked"
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
