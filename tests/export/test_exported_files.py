"""Every exported format read back by its own rules, and compared with the transforms that went in."""

from __future__ import annotations

import ast
import sys
import types
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.export import camchain_yaml, export_all, static_tf_launch, tf_yaml, urdf_xacro
from gtsam_rwhec.export.written_poses import fixed_axis_angles, number, quaternion_xyzw
from gtsam_rwhec.rig import CameraLink, RigFrames
from gtsam_rwhec.rig.camera_link import link_of_optical
from gtsam_rwhec.vision.camera import Camera
from gtsam_rwhec.vision.intrinsics_files import read_kalibr_camchain

K = np.array([[421.5, 0.0, 318.25], [0.0, 420.75, 241.125], [0.0, 0.0, 1.0]])
XACRO = {"xacro": "http://www.ros.org/wiki/xacro"}
ANGLES = st.one_of(
    st.floats(-7.0, 7.0),
    # Half turns, gimbal lock, and next to them.
    st.builds(
        lambda quarter, near: quarter * np.pi / 2 + near,
        st.integers(-2, 2),
        st.sampled_from([0.0, 1e-16, -1e-15, 1e-12, -1e-9, 1e-8, 1e-5]),
    ),
)
LENGTHS = st.one_of(st.floats(-20.0, 20.0), st.sampled_from([0.0, -0.0, 1e-5, 1.0, 5e-324]))


@st.composite
def transforms(draw: st.DrawFn) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [draw(ANGLES), draw(ANGLES), draw(ANGLES)]).as_matrix()
    T[:3, 3] = [draw(LENGTHS), draw(LENGTHS), draw(LENGTHS)]
    return T


def camera(model: str = "radtan", D: Any = (-0.28, 0.07, 1e-5, -2e-4), width: int = 640) -> Camera:
    return Camera.of(width, 480, model, K, D, "test")


def frames_of(poses: list[np.ndarray]) -> RigFrames:
    """A rig of two cameras and two targets at four poses."""
    return RigFrames(
        sensor_carrier="arm/hand",
        target_carrier="base",
        sensors={"cam_left": poses[0], "rig/cam_right": poses[1]},
        targets={"tag_0": poses[2], "board": poses[3]},
        cameras={"cam_left": camera(), "rig/cam_right": camera("equidistant", (0.01, -2e-3, 3e-4, 1e-5), 1280)},
        time_offsets_s={"rig/cam_right": 0.035},
        topics={"cam_left": "/cam_left/image", "rig/cam_right": "it's: a #topic"},
    )


POSES = st.lists(transforms(), min_size=4, max_size=4).map(frames_of)
ONE = frames_of([np.eye(4)] * 4)
EACH_POSE = [settings(max_examples=60, deadline=None), given(POSES), example(ONE)]


def on_random_poses(test: Any) -> Any:
    for decorator in reversed(EACH_POSE):
        test = decorator(test)
    return test


def expected(frames: RigFrames) -> dict[tuple[str, str], np.ndarray]:
    found = {(frames.sensor_carrier, name): T for name, T in frames.sensors.items()}
    return found | {(frames.target_carrier, name): T for name, T in frames.targets.items()}


def composed(translation: Any, xyzw: Any) -> np.ndarray:
    assert abs(np.linalg.norm(xyzw) - 1.0) < 1e-15 * 8
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(xyzw).as_matrix()
    T[:3, 3] = translation
    return T


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
    nodes: list[Any] = names["generate_launch_description"]()
    return nodes


@on_random_poses
def test_the_launch_file_publishes_every_frame(frames: RigFrames) -> None:
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

    of_yaml = {}
    for entry in yaml.safe_load(tf_yaml(frames))["transforms"]:
        at = entry["transform"]
        T = composed([at["translation"][key] for key in "xyz"], [at["rotation"][key] for key in "xyzw"])
        of_yaml[entry["header"]["frame_id"], entry["child_frame_id"]] = T
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


def test_a_launch_file_without_frames_is_python(monkeypatch: pytest.MonkeyPatch) -> None:
    text = static_tf_launch(RigFrames("hand", "base", {}, {}))
    ast.parse(text)
    assert launched(text, monkeypatch) == []


# tf YAML


@on_random_poses
def test_tf_yaml_has_every_frame(frames: RigFrames) -> None:
    message = yaml.safe_load(tf_yaml(frames))
    assert list(message) == ["transforms"]
    found = {}
    for entry in message["transforms"]:
        assert set(entry) == {"header", "child_frame_id", "transform"}
        translation, rotation = entry["transform"]["translation"], entry["transform"]["rotation"]
        T = composed([translation[key] for key in "xyz"], [rotation[key] for key in "xyzw"])
        found[entry["header"]["frame_id"], entry["child_frame_id"]] = T
    assert_same(found, expected(frames))


@pytest.mark.parametrize("name", ["no", "null", "true", "y", "e5", "On"])
def test_names_stay_names_in_yaml(name: str) -> None:
    frames = RigFrames(name, "base", {}, {"tag": np.eye(4)})
    assert yaml.safe_load(tf_yaml(frames))["transforms"][0]["child_frame_id"] == "tag"
    frames = RigFrames("hand", "base", {name: np.eye(4)}, {}, cameras={name: camera()})
    entry = yaml.safe_load(tf_yaml(frames))["transforms"][0]
    assert (entry["header"]["frame_id"], entry["child_frame_id"]) == ("hand", name)
    assert "cam0" in yaml.safe_load(camchain_yaml(frames))


def test_tf_yaml_without_frames_is_a_message() -> None:
    assert yaml.safe_load(tf_yaml(RigFrames("hand", "base", {}, {}))) == {"transforms": []}


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
    T = np.eye(4)
    T[:3, :3] = rotation_about(2, yaw) @ rotation_about(1, pitch) @ rotation_about(0, roll)
    T[:3, 3] = [float(value) for value in origin.attrib["xyz"].split()]
    return (parent.attrib["link"], child.attrib["link"]), T


# Kalibr's camchain


@on_random_poses
def test_the_camchain_has_every_camera(frames: RigFrames) -> None:
    chain = yaml.safe_load(camchain_yaml(frames))
    left, right = frames.sensors["cam_left"], frames.sensors["rig/cam_right"]
    assert list(chain) == ["cam0", "cam1"]
    for name, T in (("cam0", left), ("cam1", right)):
        # T_cam_imu brings a point of the carrier into the camera.
        np.testing.assert_allclose(np.linalg.inv(chain[name]["T_cam_imu"]), T, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(right @ np.array(chain["cam1"]["T_cn_cnm1"]), left, rtol=0.0, atol=1e-12)
    assert "T_cn_cnm1" not in chain["cam0"]
    # Kalibr's condition: the two ways to cam1 agree.
    np.testing.assert_allclose(
        np.array(chain["cam1"]["T_cn_cnm1"]) @ chain["cam0"]["T_cam_imu"],
        chain["cam1"]["T_cam_imu"],
        rtol=0.0,
        atol=1e-12,
    )


def test_the_camchain_has_kalibrs_fields(tmp_path: Path) -> None:
    text = camchain_yaml(ONE)
    chain = yaml.safe_load(text)
    assert chain["cam0"] | {"T_cam_imu": None} == {
        "camera_model": "pinhole",
        "intrinsics": [421.5, 420.75, 318.25, 241.125],
        "distortion_model": "radtan",
        "distortion_coeffs": [-0.28, 0.07, 1e-5, -2e-4],
        "resolution": [640, 480],
        "rostopic": "/cam_left/image",
        "T_cam_imu": None,
        "timeshift_cam_imu": 0.0,
        "cam_overlaps": [1],
    }
    assert chain["cam1"]["distortion_model"] == "equidistant"
    assert chain["cam1"]["distortion_coeffs"] == [0.01, -2e-3, 3e-4, 1e-5]
    assert chain["cam1"]["timeshift_cam_imu"] == 0.035
    assert chain["cam1"]["rostopic"] == "it's: a #topic"
    # And as this library reads a camchain.
    (tmp_path / "camchain.yaml").write_text(text)
    for read, given_camera in zip(
        read_kalibr_camchain(tmp_path / "camchain.yaml").values(), ONE.cameras.values(), strict=True
    ):
        np.testing.assert_array_equal(read.K, given_camera.K)
        np.testing.assert_array_equal(read.D, given_camera.D)
        assert (read.model, read.width, read.height) == (given_camera.model, given_camera.width, given_camera.height)


def test_a_pinhole_is_radtan_with_zeros() -> None:
    frames = RigFrames("hand", "base", {"cam": np.eye(4)}, {}, cameras={"cam": camera("pinhole", ())})
    cam0 = yaml.safe_load(camchain_yaml(frames))["cam0"]
    assert (cam0["distortion_model"], cam0["distortion_coeffs"]) == ("radtan", [0.0] * 4)
    assert "rostopic" not in cam0


@pytest.mark.parametrize(
    ("model", "D", "is_written"),
    [
        ("radtan", (-0.3, 0.1, 0.001, 0.0, 0.0), True),
        ("radtan", (-0.3, 0.1, 0.001, 0.0, -0.02), False),
        ("rational_polynomial", (-0.3, 0.1, 0.001, 0.0, 0.0, 0.1, 0.0, 0.0), False),
        ("rational_polynomial", (-0.3, 0.1, 0.001, 0.0, 0.0, 0.0, 0.0, 0.0), True),
    ],
)
def test_distortion_that_kalibr_lacks_is_left_out_and_said(model: str, D: tuple[float, ...], is_written: bool) -> None:
    sensors = {name: np.eye(4) for name in ("first", "lidar", "last")}
    sensors["last"] = np.diag([-1.0, -1.0, 1.0, 1.0])
    frames = RigFrames("hand", "base", sensors, {}, cameras={"first": camera(model, D), "last": camera()})
    text = camchain_yaml(frames)
    chain = yaml.safe_load(text)
    assert list(chain) == (["cam0", "cam1"] if is_written else ["cam0"])
    assert "# Left out: lidar, whose intrinsics are not known." in text
    assert ("# Left out: first, whose distortion" in text) is not is_written
    # A chain holds together across the sensor that is left out.
    np.testing.assert_array_equal(chain[list(chain)[-1]]["T_cam_imu"], sensors["last"])
    assert "T_cn_cnm1" not in chain["cam0"]


def test_a_camchain_without_cameras_is_yaml() -> None:
    assert yaml.safe_load(camchain_yaml(RigFrames("hand", "base", {"cam": np.eye(4)}, {}))) == {}


def test_overlaps_are_of_cameras_that_can_see_the_same() -> None:
    """Three in a ring: the first two look the same way, the third backwards."""
    backwards = np.diag([-1.0, 1.0, -1.0, 1.0])
    aside = np.eye(4)
    aside[0, 3] = 0.3
    sensors = {"a": np.eye(4), "b": aside, "c": backwards}
    frames = RigFrames("rig", "world", sensors, {}, cameras={name: camera() for name in sensors})
    chain = yaml.safe_load(camchain_yaml(frames))
    assert [chain[f"cam{n}"]["cam_overlaps"] for n in range(3)] == [[1], [0], []]


# All files


def test_all_files_are_written(tmp_path: Path) -> None:
    paths = export_all(ONE, tmp_path)
    assert [path.name for path in paths] == ["static_tf.launch.py", "tf.yaml", "rig.urdf.xacro", "camchain.yaml"]
    assert sorted(paths) == sorted(tmp_path.iterdir())
    assert paths[3].read_text() == camchain_yaml(ONE)


def test_a_folder_that_is_not_there_is_said(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"static_tf\.launch\.py cannot be written: No such file"):
        export_all(ONE, tmp_path / "nowhere")


def test_warnings_are_in_every_file(tmp_path: Path) -> None:
    frames = replace(
        frames_of([np.eye(4)] * 4), warnings=("Do not use: cam: 9 of its 10 measurements contradict the answer -- all",)
    )
    for path in export_all(frames, tmp_path):
        text = path.read_text(encoding="utf-8")
        assert "Do not use: cam: 9 of its 10 measurements contradict" in text
        if path.suffix == ".py":
            ast.parse(text)
        elif path.suffix == ".yaml":
            yaml.safe_load(text)
        else:
            assert ElementTree.fromstring(text.encode()).tag == "robot"
    for path in export_all(replace(frames, warnings=()), tmp_path):
        assert "Do not use" not in path.read_text(encoding="utf-8")
