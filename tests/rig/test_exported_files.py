"""Every exported format of frames read back by its own rules; names and numbers that would break one are refused."""

from __future__ import annotations

import ast
import sys
import types
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from exported_rigs import ONE, camera, frames_of, on_random_poses, transforms
from hypothesis import example, given, settings
from hypothesis import strategies as st
from rwhec_factors import se3
from scipy.spatial.transform import Rotation

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.intrinsics_files import read_colmap_cameras
from gtsam_rwhec.errors import FileFormatError, FrameError, PoseError, StampError
from gtsam_rwhec.rig import CameraLink, RigFrames, camchain_yaml, export_all, static_tf_launch, tf_yaml, urdf_xacro
from gtsam_rwhec.rig.exported_files import fixed_axis_angles, number, quaternion_xyzw
from gtsam_rwhec.rig.sections import link_of_optical

XACRO = {"xacro": "http://www.ros.org/wiki/xacro"}


def expected(frames: RigFrames) -> dict[tuple[str, str], np.ndarray]:
    found = {(frames.sensor_carrier, name): T for name, T in frames.sensors.items()}
    return found | {(frames.target_carrier, name): T for name, T in frames.targets.items()}


def composed(translation: Any, xyzw: Any) -> np.ndarray:
    assert abs(np.linalg.norm(xyzw) - 1.0) < 1e-15 * 8
    return se3.pose(Rotation.from_quat(xyzw).as_matrix(), translation)


def assert_same(found: dict[Any, np.ndarray], wanted: dict[Any, np.ndarray]) -> None:
    assert list(found) == list(wanted)
    for key, T in wanted.items():
        np.testing.assert_allclose(found[key], T, rtol=0.0, atol=1e-12)
        np.testing.assert_array_equal(found[key][:3, 3], T[:3, 3])


@given(st.floats(allow_nan=False, allow_infinity=False))
@example(1e-5)
@example(1e22)
@example(-0.0)
def test_numbers_are_the_same_doubles_again(value: float) -> None:
    text = number(value)
    assert float(text) == value
    read = yaml.safe_load(text)
    assert isinstance(read, float)
    assert read == value
    assert not text.startswith("-0.0") or value < 0.0


@settings(max_examples=300, deadline=None)
@given(transforms())
def test_rotations_are_the_same_again(T: np.ndarray) -> None:
    roll, pitch, yaw = fixed_axis_angles(T)
    fixed_axes = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
    np.testing.assert_allclose(fixed_axes, T[:3, :3], rtol=0.0, atol=4e-15)
    assert abs(pitch) <= np.pi / 2
    xyzw = quaternion_xyzw(T)
    np.testing.assert_allclose(Rotation.from_quat(xyzw).as_matrix(), T[:3, :3], rtol=0.0, atol=4e-15)
    assert xyzw[3] >= 0.0


# ROS 2 launch file


class Node:
    def __init__(self, **fields: Any) -> None:
        self.fields = fields


def launched(text: str, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What generate_launch_description gives, with modules in place of ROS's."""
    contents: dict[str, dict[str, Any]] = {
        "launch": {"LaunchDescription": list},
        "launch.actions": {"DeclareLaunchArgument": lambda name, default_value: (name, default_value)},
        "launch.conditions": {"IfCondition": lambda value: ("if", value)},
        "launch.substitutions": {"LaunchConfiguration": lambda name: ("argument", name)},
        "launch_ros": {},
        "launch_ros.actions": {"Node": Node},
    }
    for name, content in contents.items():
        module = types.ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    names: dict[str, Any] = {}
    exec(compile(text, "static_tf.launch.py", "exec"), names)
    return names["generate_launch_description"]()


@on_random_poses
def test_the_launch_file_and_tf_yaml_have_every_frame(frames: RigFrames) -> None:
    assert_same(of_tf_yaml(frames), expected(frames))
    with pytest.MonkeyPatch.context() as monkeypatch:
        nodes = launched(static_tf_launch(frames), monkeypatch)
    found = {}
    for node in nodes:
        assert node.fields["package"] == "tf2_ros"
        assert node.fields["executable"] == "static_transform_publisher"
        names, T = transform_of(node)
        found[names] = T
    assert_same(found, expected(frames))


def transform_of(node: Node) -> tuple[tuple[str, str], np.ndarray]:
    """What a static_transform_publisher publishes: parent and child, and T_parent_child."""
    arguments = node.fields["arguments"]
    assert all(isinstance(argument, str) for argument in arguments)
    assert arguments[0::2] == [
        "--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw", "--frame-id", "--child-frame-id",
    ]  # fmt: skip
    values = dict(zip(arguments[0::2], arguments[1::2], strict=True))
    T = composed(*([float(values[f"--{key}"]) for key in keys] for keys in (["x", "y", "z"], ["qx", "qy", "qz", "qw"])))
    return (values["--frame-id"], values["--child-frame-id"]), T


REALSENSE = [0.0, 0.015, -0.002, -0.5, 0.5, -0.5, 0.5]
LINKS = {
    "cam_left": CameraLink("camera_link", link_of_optical()),
    "rig/cam_right": CameraLink("right/camera_link", link_of_optical(REALSENSE)),
}


def with_optical_frames(found: dict[tuple[str, str], np.ndarray], frames: RigFrames) -> dict[str, np.ndarray]:
    """The poses of the optical frames, by the links' poses and T_link_optical, as the drivers print it."""
    return {
        name: found[frames.sensor_carrier, link.name] @ composed(given[:3], given[3:])
        for (name, link), given in zip(
            frames.links.items(), ([0.0, 0.0, 0.0, -0.5, 0.5, -0.5, 0.5], REALSENSE), strict=True
        )
    }


def test_a_link_is_that_of_rep_103() -> None:
    """What the camera has in front of it, to its right and below it is on the link's x, -y and -z."""
    np.testing.assert_array_equal(link_of_optical()[:3, :3] @ [2.0, 3.0, 5.0], [5.0, -2.0, -3.0])
    np.testing.assert_allclose(link_of_optical(REALSENSE)[:3, :3], link_of_optical()[:3, :3], atol=1e-15)
    with pytest.raises(ValueError, match=r"has the length 0\.7071; give \[x, y, z, qx, qy, qz, qw\]"):
        link_of_optical([0.0, 0.0, 0.0, 0.5, 0.5, 0.0, 0.0])


@on_random_poses
def test_links_take_the_place_of_optical_frames_and_compose_to_them(frames: RigFrames) -> None:
    frames = replace(frames, links=LINKS)
    published = expected(frames)
    wanted = {name: published.pop((frames.sensor_carrier, name)) for name in frames.sensors}
    with pytest.MonkeyPatch.context() as monkeypatch:
        nodes = launched(static_tf_launch(frames), monkeypatch)
    assert nodes[0] == ("optical_frames", "false")
    transforms = {of: T for of, T in map(transform_of, nodes[1:])}
    assert len(transforms) == len(nodes) - 1
    children = [child for _, child in transforms]
    assert len(set(children)) == len(children)  # no frame has two parents
    for name, T in with_optical_frames(transforms, frames).items():
        np.testing.assert_allclose(T, wanted[name], rtol=0.0, atol=1e-12)
    # What the launch argument adds is what the drivers publish.
    added = {child: node for (_, child), node in zip(transforms, nodes[1:], strict=True) if node.fields["condition"]}
    assert set(added) == set(frames.sensors)
    for name, link in frames.links.items():
        np.testing.assert_allclose(transforms[link.name, name], link.T_link_optical, rtol=0.0, atol=1e-12)
    for of, T in published.items():
        np.testing.assert_allclose(transforms[of], T, rtol=0.0, atol=1e-12)

    of_yaml = of_tf_yaml(frames)
    assert set(of_yaml) == {of for of in transforms if of[1] not in added}
    for name, T in with_optical_frames(of_yaml, frames).items():
        np.testing.assert_allclose(T, wanted[name], rtol=0.0, atol=1e-12)

    (macro,) = ElementTree.fromstring(urdf_xacro(frames)).findall("xacro:macro", XACRO)
    assert macro.get("params") == f"parent:={frames.sensor_carrier} optical_frames:=false"
    joints = {of: T for of, T in map(joint_of, macro.findall("joint"))}
    assert set(joints) == {("${parent}", link.name) for link in frames.links.values()}
    (optional,) = macro.findall("xacro:if", XACRO)
    assert optional.get("value") == "${optical_frames}"
    for of, T in map(joint_of, optional.findall("joint")):
        np.testing.assert_allclose(joints["${parent}", of[0]] @ T, wanted[of[1]], rtol=0.0, atol=1e-12)
    assert camchain_yaml(frames) == camchain_yaml(replace(frames, links={}))  # Kalibr knows optical frames alone


def test_nodes_of_the_launch_file_have_names_that_ros_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = replace(ONE, targets={"a/b": np.eye(4), "a_b": np.eye(4)})
    names = [node.fields["name"] for node in launched(static_tf_launch(frames), monkeypatch)]
    assert len(set(names)) == 4
    assert all(name.isidentifier() and name.isascii() for name in names)


# tf YAML


def of_tf_yaml(frames: RigFrames) -> dict[tuple[str, str], np.ndarray]:
    message = yaml.safe_load(tf_yaml(frames))
    assert list(message) == ["transforms"]
    found = {}
    for entry in message["transforms"]:
        assert set(entry) == {"header", "child_frame_id", "transform"}
        translation, rotation = entry["transform"]["translation"], entry["transform"]["rotation"]
        T = composed([translation[key] for key in "xyz"], [rotation[key] for key in "xyzw"])
        found[entry["header"]["frame_id"], entry["child_frame_id"]] = T
    return found


@pytest.mark.parametrize("name", ["no", "null", "true", "y", "e5", "On"])
def test_names_stay_names_in_yaml(name: str) -> None:
    frames = RigFrames(name, "base", {}, {"tag": np.eye(4)})
    assert yaml.safe_load(tf_yaml(frames))["transforms"][0]["child_frame_id"] == "tag"
    frames = RigFrames("hand", "base", {name: np.eye(4)}, {}, cameras={name: camera()})
    entry = yaml.safe_load(tf_yaml(frames))["transforms"][0]
    assert (entry["header"]["frame_id"], entry["child_frame_id"]) == ("hand", name)
    assert "cam0" in yaml.safe_load(camchain_yaml(frames))


# URDF


def rotation_about(axis: int, angle: float) -> np.ndarray:
    R = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R[i, i] = R[j, j] = np.cos(angle)
    R[j, i], R[i, j] = np.sin(angle), -np.sin(angle)
    return R


@on_random_poses
def test_urdf_joints_compose_to_the_sensors(frames: RigFrames) -> None:
    robot = ElementTree.fromstring(urdf_xacro(frames))
    (macro,) = robot.findall("xacro:macro", XACRO)
    assert macro.get("params") == f"parent:={frames.sensor_carrier}"
    assert [link.get("name") for link in macro.findall("link")] == list(frames.sensors)
    found = {}
    for joint in macro.findall("joint"):
        (parent, child), T = joint_of(joint)
        assert parent == "${parent}"
        found[child] = T
    assert_same(found, dict(frames.sensors))
    joints = [joint.get("name") for joint in macro.findall("joint")]
    assert len(set(joints)) == len(frames.sensors)


def joint_of(joint: ElementTree.Element) -> tuple[tuple[str, str], np.ndarray]:
    """A fixed joint: its parent and child, and T_parent_child."""
    assert joint.get("type") == "fixed"
    parent, child, origin = joint.find("parent"), joint.find("child"), joint.find("origin")
    assert parent is not None
    assert child is not None
    assert origin is not None
    roll, pitch, yaw = (float(angle) for angle in origin.attrib["rpy"].split())
    T = se3.pose(
        rotation_about(2, yaw) @ rotation_about(1, pitch) @ rotation_about(0, roll),
        [float(value) for value in origin.attrib["xyz"].split()],
    )
    return (parent.attrib["link"], child.attrib["link"]), T


# All files


def test_all_files_are_written(tmp_path: Path) -> None:
    paths = export_all(ONE, tmp_path)
    assert [path.relative_to(tmp_path).as_posix() for path in paths] == [
        "static_tf.launch.py", "tf.yaml", "rig.urdf.xacro", "camchain.yaml", "cameras.opencv.yaml", "cameras.txt",
        "camera_info/cam_left.yaml", "camera_info/rig_cam_right.yaml",
    ]  # fmt: skip
    assert sorted(paths) == sorted(path for path in tmp_path.rglob("*") if path.is_file())
    assert paths[3].read_text() == camchain_yaml(ONE)


def test_a_folder_that_is_not_there_is_said(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"static_tf\.launch\.py cannot be written: No such file"):
        export_all(ONE, tmp_path / "nowhere")
    (tmp_path / "camera_info").write_text("mine", encoding="utf-8")
    with pytest.raises(FileFormatError, match=r"camera_info cannot be made a folder: File exists"):
        export_all(ONE, tmp_path)


def test_warnings_are_in_every_file(tmp_path: Path) -> None:
    frames = replace(
        frames_of([np.eye(4)] * 4), warnings=("Do not use: cam: 9 of its 10 measurements contradict the answer -- all",)
    )
    for path in export_all(frames, tmp_path):
        text = path.read_text(encoding="utf-8")
        assert "Do not use: cam: 9 of its 10 measurements contradict" in text
        if path.suffix == ".py":
            ast.parse(text)
        elif path.name == "cameras.opencv.yaml":
            assert not cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ).getNode("cameras").empty()
        elif path.suffix == ".yaml":
            yaml.safe_load(text)
        elif path.suffix == ".txt":
            assert set(read_colmap_cameras(path)) == {"1", "2"}
        else:
            assert ElementTree.fromstring(text.encode()).tag == "robot"
    for path in export_all(replace(frames, warnings=()), tmp_path):
        assert "Do not use" not in path.read_text(encoding="utf-8")


CAMERA = Camera.of(640, 480, "pinhole", [[400.0, 0.0, 320.0], [0.0, 400.0, 240.0], [0.0, 0.0, 1.0]], (), "test")


def frames(**changes: Any) -> RigFrames:
    fields: dict[str, Any] = {
        "sensor_carrier": "hand",
        "target_carrier": "base",
        "sensors": {"cam": np.eye(4)},
        "targets": {"tag": np.eye(4)},
    }
    return RigFrames(**(fields | changes))


@pytest.mark.parametrize(
    "name",
    [
        "", "a b", 'a"', "a'", "a\n", "a\\", "../a", "a/../b", "/a", "a/", "a//b", "${a}", "$(find a)", "<a>", "a&b",
        "a:", "#a", "{a}", "0", "_a", "a-b", "ä", "a\x00", 3,
    ],
)  # fmt: skip
@pytest.mark.parametrize("place", ["sensor_carrier", "target_carrier", "sensors", "targets"])
def test_names_that_break_files_are_refused(name: Any, place: str) -> None:
    with pytest.raises(FrameError, match="cannot be the name of an exported frame"):
        frames(**{place: name if place.endswith("carrier") else {name: np.eye(4)}})


@pytest.mark.parametrize(
    "changes",
    [
        {"target_carrier": "hand"},
        {"sensors": {"hand": np.eye(4)}},
        {"targets": {"hand": np.eye(4)}},
        {"sensors": {"base": np.eye(4)}},
        {"targets": {"cam": np.eye(4)}},
    ],
)
def test_a_name_is_that_of_one_frame(changes: dict[str, Any]) -> None:
    with pytest.raises(FrameError, match="the name of two frames"):
        frames(**changes)


@pytest.mark.parametrize("what", ["cameras", "time_offsets_s", "topics"])
def test_only_sensors_have_cameras_offsets_and_topics(what: str) -> None:
    value = {"cameras": CAMERA, "time_offsets_s": 0.0, "topics": "/image"}[what]
    assert getattr(frames(**{what: {"cam": value}}), what) == {"cam": value}
    with pytest.raises(FrameError, match=f"{what} has 'tag', which is not a sensor; the sensors are cam"):
        frames(**{what: {"tag": value}})


@pytest.mark.parametrize("topic", ["", "/a\n/b", "/a\x00", "\ud800", "a\u2028b"])
def test_topics_are_a_line_of_text(topic: str) -> None:
    with pytest.raises(FrameError, match="the topic of cam is"):
        frames(topics={"cam": topic})


@pytest.mark.parametrize("offset", [np.nan, np.inf])
def test_time_offsets_are_finite(offset: float) -> None:
    with pytest.raises(StampError, match="the time offset of cam"):
        frames(time_offsets_s={"cam": offset})


@pytest.mark.parametrize(
    "T",
    [np.full((4, 4), np.nan), np.eye(3), 2.0 * np.eye(4), np.diag([1.0, 1.0, -1.0, 1.0]), np.stack([np.eye(4)] * 2)],
)
def test_poses_are_poses(T: np.ndarray) -> None:
    with pytest.raises(PoseError, match="the pose of tag in base"):
        frames(targets={"tag": T})


def test_what_was_checked_stays() -> None:
    T = np.eye(4)
    held = frames(sensors={"cam": T})
    T[0, 3] = np.nan
    assert held.sensors["cam"][0, 3] == 0.0
    assert [(frame.parent, frame.child) for frame in held.frames()] == [("hand", "cam"), ("base", "tag")]
