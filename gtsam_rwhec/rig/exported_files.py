"""All exported files of a calibration in one folder; and its frames as texts: ROS 2's launch file, tf, URDF, Python."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.whole_files import write_atomically
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.rig.exported_cameras import (
    FIRST_LINES,
    camchain_yaml,
    camera_info_yaml,
    colmap_cameras_txt,
    comment,
    opencv_yaml,
)
from gtsam_rwhec.rig.rig_frames import CalibratedFrame, RigFrames
from gtsam_rwhec.rig.section_types import number

_LAUNCH_HEAD = '''\
"""Calibrated frames as static transforms, one tf2_ros static_transform_publisher each.

    ros2 launch ./static_tf.launch.py
"""

from launch import LaunchDescription
'''
_FRAMES = """\
from launch_ros.actions import Node

# parent, child, translation of the child in the parent (x, y, z in metres), its rotation (qx, qy, qz, qw)
FRAMES = [
{rows}]
"""
_LAUNCH = """

def generate_launch_description():
    return LaunchDescription([publisher(index, *frame) for index, frame in enumerate(FRAMES)])


def publisher(index, parent, child, translation, rotation):
"""
_LAUNCH_HEAD_WITH_LINKS = '''\
"""Calibrated frames as static transforms, one tf2_ros static_transform_publisher each.

    ros2 launch ./static_tf.launch.py                        where the cameras' drivers publish their optical frames
    ros2 launch ./static_tf.launch.py optical_frames:=true   where nothing else does
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
'''
_LAUNCH_WITH_LINKS = """
# The optical frames of the cameras on their links, as their drivers publish them.
OPTICAL_FRAMES = [
{rows}]


def generate_launch_description():
    wanted = IfCondition(LaunchConfiguration("optical_frames"))
    return LaunchDescription(
        [DeclareLaunchArgument("optical_frames", default_value="false")]
        + [publisher(index, *frame) for index, frame in enumerate(FRAMES)]
        + [publisher(len(FRAMES) + index, *frame, condition=wanted) for index, frame in enumerate(OPTICAL_FRAMES)]
    )


def publisher(index, parent, child, translation, rotation, condition=None):
"""
_PUBLISHER = """\
    x, y, z = translation
    qx, qy, qz, qw = rotation
    return Node(
        package="tf2_ros",
        executable="static_transform_publisher",
        name=f"static_tf_{index}_{child.replace('/', '_')}",
        arguments=[
            "--x", x, "--y", y, "--z", z,
            "--qx", qx, "--qy", qy, "--qz", qz, "--qw", qw,
            "--frame-id", parent, "--child-frame-id", child,
        ],
"""
_TF_HEAD = """\
# Calibrated frames in the form of a tf2_msgs/TFMessage: the pose of child_frame_id in header.frame_id, as metres and a
# unit quaternion.
"""
_PYTHON_HEAD = """\
# Calibrated frames: T_PARENT_CHILD is the pose of the frame CHILD in the frame PARENT, in metres.
# p_parent = T @ p_child for points [x, y, z, 1].
import numpy as np

POSES = {  # (parent, child): T_parent_child
"""
_PYTHON_TAIL = """\
}

# For GTSAM:
# import gtsam
# poses = {names: gtsam.Pose3(T) for names, T in POSES.items()}
"""
_XACRO = """\
<?xml version="1.0"?>
<!--
  Calibrated sensors, each a link and a fixed joint. The robot's description, which has the link {parent}, needs:

    <xacro:include filename="rig.urdf.xacro"/>
    <xacro:calibrated_sensors/>                         on {parent}
    <xacro:calibrated_sensors parent="another_link"/>   on another link of the same frame
{how}-->
<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:macro name="calibrated_sensors" params="parent:={parent}{params}">
{sensors}  </xacro:macro>
</robot>
"""
_WITHOUT_LINKS = "\n  A camera's link is its optical frame: z forward, x right, y down.\n"
_WITH_LINKS = """\
    <xacro:calibrated_sensors optical_frames="true"/>   with the optical frames of {links}

  {links}: the frame of the camera's body, whose optical frame its driver publishes. Without the driver, and without
  a description of the camera that has these links, let the macro write the optical frames. A camera without such a
  link is at its optical frame: z forward, x right, y down.
"""


def static_tf_launch(frames: RigFrames) -> str:
    """The text of ``static_tf.launch.py``: every frame, with the new-style arguments (ROS 2 Humble and later).

    For a camera with a link it publishes the link, and also the optical frame if the launch argument says so.
    """
    listed = _FRAMES.format(rows=_rows(frames.frames()))
    if not frames.links:
        return f"{_LAUNCH_HEAD}{listed}{_LAUNCH}{_PUBLISHER}    )\n"
    launch = _LAUNCH_WITH_LINKS.format(rows=_rows(frames.optical_frames()))
    return f"{_LAUNCH_HEAD_WITH_LINKS}{listed}{launch}{_PUBLISHER}        condition=condition,\n    )\n"


def _rows(frames: Iterable[CalibratedFrame]) -> str:
    rows = []
    for parent, child, T in frames:
        translation = ", ".join(f'"{number(value)}"' for value in T[:3, 3])
        rotation = ", ".join(f'"{number(value)}"' for value in quaternion_xyzw(T))
        rows.append(f'    (\n        "{parent}", "{child}",\n        ({translation}),\n        ({rotation}),\n    ),\n')
    return "".join(rows)


def tf_yaml(frames: RigFrames) -> str:
    """The text of ``tf.yaml``: ``transforms``, a list of geometry_msgs/TransformStamped without stamps."""
    entries = []
    for parent, child, T in frames.frames():
        x, y, z = (number(value) for value in T[:3, 3])
        qx, qy, qz, qw = (number(value) for value in quaternion_xyzw(T))
        entries.append(
            f"  - header: {{frame_id: '{parent}'}}\n"
            f"    child_frame_id: '{child}'\n"
            "    transform:\n"
            f"      translation: {{x: {x}, y: {y}, z: {z}}}\n"
            f"      rotation: {{x: {qx}, y: {qy}, z: {qz}, w: {qw}}}\n"
        )
    return f"{_TF_HEAD}transforms:\n{''.join(entries)}" if entries else f"{_TF_HEAD}transforms: []\n"


def python_poses(frames: RigFrames) -> str:
    """The text of a Python snippet with every frame: the doubles of the calibration, to the last bit."""
    entries = []
    for parent, child, T in frames.frames():
        rows = "".join(f"        [{', '.join(number(value) for value in row)}],\n" for row in T)
        entries.append(f"    ({parent!r}, {child!r}): np.array([\n{rows}    ]),\n")
    return _PYTHON_HEAD + "".join(entries) + _PYTHON_TAIL


def urdf_xacro(frames: RigFrames) -> str:
    """The text of ``rig.urdf.xacro``: the macro ``calibrated_sensors``, on the sensors' carrier by default.

    For a camera with a link it has the link, and also the optical frame if the macro's parameter says so.
    """
    parent = frames.sensor_carrier
    sensors = [_joint(frame, "${parent}") for frame in frames.sensor_frames()]
    how, params = _WITHOUT_LINKS, ""
    if frames.links:
        how = _WITH_LINKS.format(links=", ".join(link.name for link in frames.links.values()))
        params = " optical_frames:=false"
        optical = [_joint(frame, frame.parent) for frame in frames.optical_frames()]
        sensors += ['    <xacro:if value="${optical_frames}">\n', *optical, "    </xacro:if>\n"]
    return _XACRO.format(parent=parent, how=how, params=params, sensors="".join(sensors))


def _joint(frame: CalibratedFrame, parent: str) -> str:
    """A frame as a link and the fixed joint to its parent's link."""
    name, T = frame.child, frame.T_parent_child
    xyz = " ".join(number(value) for value in T[:3, 3])
    rpy = " ".join(number(value) for value in fixed_axis_angles(T))
    return (
        f'    <link name="{name}"/>\n'
        f'    <joint name="{name}_joint" type="fixed">\n'
        f'      <parent link="{parent}"/>\n'
        f'      <child link="{name}"/>\n'
        f'      <origin xyz="{xyz}" rpy="{rpy}"/>\n'
        "    </joint>\n"
    )


def quaternion_xyzw(T: Array) -> Array:
    """The unit quaternion (4,) of a transform's rotation, as x, y, z, w, where w is not below 0."""
    return Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)


def fixed_axis_angles(T: Array) -> tuple[float, float, float]:
    """Roll, pitch, yaw in radians with R = Rz(yaw) Ry(pitch) Rx(roll): URDF's rpy.

    Near pitch = +-90 degrees, R determines only the sum or the difference of yaw and roll. Yaw is computed first, then
    pitch and roll from Rz(yaw)' R = Ry(pitch) Rx(roll): the three angles always compose to R.
    """
    R = T[:3, :3]
    yaw = np.arctan2(R[1, 0], R[0, 0])
    c, s = np.cos(yaw), np.sin(yaw)
    pitch = np.arctan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
    roll = np.arctan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return float(roll), float(pitch), float(yaw)


#: These functions give the text of each file, by its name.
FILES: dict[str, Callable[[RigFrames], str]] = {
    "static_tf.launch.py": static_tf_launch,
    "tf.yaml": tf_yaml,
    "rig.urdf.xacro": urdf_xacro,
    "camchain.yaml": camchain_yaml,
    "cameras.opencv.yaml": opencv_yaml,
    "cameras.txt": colmap_cameras_txt,
}
#: These functions give the texts with poses for people to copy, by the text's name.
COPIED = {name: FILES[name] for name in ("static_tf.launch.py", "rig.urdf.xacro", "tf.yaml")}
COPIED["poses.py"] = python_poses
#: These functions give the texts of a folder's files, by the files' names: one for each camera.
FOLDERS: dict[str, Callable[[RigFrames], dict[str, str]]] = {"camera_info": camera_info_yaml}
#: Files in these folders have this ending.
SUFFIX = ".yaml"


def export_all(frames: RigFrames, folder: str | Path) -> list[Path]:
    """Write the files of `FILES`, and ``camera_info/NAME.yaml`` for each camera.

    `folder` must exist; files of these names in it are replaced. Returns the written files.

    Raises
    ------
    FileFormatError
        A file cannot be written; the message says why.
    """
    # All texts come first: if one of them fails, no file is written.
    remarks = _remarks(frames)
    texts = {Path(folder) / name: _with_head(text(frames), remarks, name) for name, text in FILES.items()}
    of_cameras = {
        Path(folder) / inside / name: _with_head(text, remarks, name)
        for inside, made in FOLDERS.items()
        for name, text in made(frames).items()
    }
    for path, text in texts.items():
        write_atomically(path, text.encode())
    for path, text in of_cameras.items():
        try:
            path.parent.mkdir(exist_ok=True)
        except OSError as error:
            raise FileFormatError(f"{path.parent} cannot be made a folder: {error.strerror or error}.") from error
        write_atomically(path, text.encode())
    return [*texts, *of_cameras]


def copied_texts(frames: RigFrames) -> dict[str, str]:
    """The texts of `COPIED`, by name, with the warnings in the head of each."""
    return {name: _with_head(text(frames), _remarks(frames), name) for name, text in COPIED.items()}


def _remarks(frames: RigFrames) -> tuple[str, ...]:
    """The remarks at the head of every file."""
    return (*frames.warnings, *(f"Left out, because it has no answer: {why}" for why in frames.left_out.values()))


def _with_head(text: str, remarks: tuple[str, ...], name: str) -> str:
    """The text with remarks as comments at its beginning."""
    if not remarks:
        return text
    if name.endswith(".xacro"):
        declaration, rest = text.split("\n", 1)  # the first line of XML is its declaration
        joined = re.sub("-(?=-)", "- ", "\n".join(map(comment, remarks)))  # XML's comments hold no "--"
        return f"{declaration}\n<!--\n{joined}\n-->\n{rest}"
    before = FIRST_LINES if text.startswith(FIRST_LINES) else ""
    return before + "".join(f"# {comment(remark)}\n" for remark in remarks) + text.removeprefix(before)
