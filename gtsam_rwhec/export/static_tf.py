"""A ROS 2 launch file that publishes the frames as static transforms."""

from __future__ import annotations

from collections.abc import Iterable

from gtsam_rwhec.export.written_poses import number, quaternion_xyzw
from gtsam_rwhec.rig.rig_frames import CalibratedFrame, RigFrames

_HEAD = '''\
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
_HEAD_WITH_LINKS = '''\
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


def static_tf_launch(frames: RigFrames) -> str:
    """The text of ``static_tf.launch.py``: every frame, with the new-style arguments (ROS 2 Humble and later).

    Of a camera with a link it publishes the link; its optical frame too, where the launch argument says so.
    """
    listed = _FRAMES.format(rows=_rows(frames.frames()))
    if not frames.links:
        return f"{_HEAD}{listed}{_LAUNCH}{_PUBLISHER}    )\n"
    launch = _LAUNCH_WITH_LINKS.format(rows=_rows(frames.optical_frames()))
    return f"{_HEAD_WITH_LINKS}{listed}{launch}{_PUBLISHER}        condition=condition,\n    )\n"


def _rows(frames: Iterable[CalibratedFrame]) -> str:
    rows = []
    for parent, child, T in frames:
        translation = ", ".join(f'"{number(value)}"' for value in T[:3, 3])
        rotation = ", ".join(f'"{number(value)}"' for value in quaternion_xyzw(T))
        rows.append(f'    (\n        "{parent}", "{child}",\n        ({translation}),\n        ({rotation}),\n    ),\n')
    return "".join(rows)
