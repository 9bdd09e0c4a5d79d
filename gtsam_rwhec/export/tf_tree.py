"""The frames as YAML, in the form of ROS's tf2_msgs/TFMessage."""

from __future__ import annotations

from gtsam_rwhec.export.written_poses import number, quaternion_xyzw
from gtsam_rwhec.rig.rig_frames import RigFrames

_HEAD = """\
# Calibrated frames in the form of a tf2_msgs/TFMessage: the pose of child_frame_id in header.frame_id, as metres and a
# unit quaternion.
"""


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
    return f"{_HEAD}transforms:\n{''.join(entries)}" if entries else f"{_HEAD}transforms: []\n"
