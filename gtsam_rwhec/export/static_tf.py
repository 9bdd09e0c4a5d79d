"""A ROS 2 launch file that publishes the frames as static transforms."""

from __future__ import annotations

from gtsam_rwhec.export.written_poses import number, quaternion_xyzw
from gtsam_rwhec.rig.calibrated_frames import RigFrames

_LAUNCH = '''\
"""Calibrated frames as static transforms, one tf2_ros static_transform_publisher each.

    ros2 launch ./static_tf.launch.py
"""

from launch import LaunchDescription
from launch_ros.actions import Node

# parent, child, translation of the child in the parent (x, y, z in metres), its rotation (qx, qy, qz, qw)
FRAMES = [
{rows}]


def generate_launch_description():
    return LaunchDescription([publisher(index, *frame) for index, frame in enumerate(FRAMES)])


def publisher(index, parent, child, translation, rotation):
    x, y, z = translation
    qx, qy, qz, qw = rotation
    return Node(
        package="tf2_ros",
        executable="static_transform_publisher",
        name=f"static_tf_{{index}}_{{child.replace('/', '_')}}",
        arguments=[
            "--x", x, "--y", y, "--z", z,
            "--qx", qx, "--qy", qy, "--qz", qz, "--qw", qw,
            "--frame-id", parent, "--child-frame-id", child,
        ],
    )
'''


def static_tf_launch(frames: RigFrames) -> str:
    """The text of ``static_tf.launch.py``: every frame, with the new-style arguments (ROS 2 Humble and later)."""
    rows = []
    for parent, child, T in frames.frames():
        translation = ", ".join(f'"{number(value)}"' for value in T[:3, 3])
        rotation = ", ".join(f'"{number(value)}"' for value in quaternion_xyzw(T))
        rows.append(f'    (\n        "{parent}", "{child}",\n        ({translation}),\n        ({rotation}),\n    ),\n')
    return _LAUNCH.format(rows="".join(rows))
