"""The frames as a Python snippet: a dictionary of 4 x 4 matrices, and the same as gtsam.Pose3."""

from __future__ import annotations

from gtsam_rwhec.export.written_poses import number
from gtsam_rwhec.rig.rig_frames import RigFrames

_HEAD = """\
# Calibrated frames: T_PARENT_CHILD is the pose of the frame CHILD in the frame PARENT, in metres.
# p_parent = T @ p_child for points [x, y, z, 1].
import numpy as np

POSES = {  # (parent, child): T_parent_child
"""
_TAIL = """\
}

# For GTSAM:
# import gtsam
# poses = {names: gtsam.Pose3(T) for names, T in POSES.items()}
"""


def python_poses(frames: RigFrames) -> str:
    """The text of a Python snippet with every frame: the doubles of the calibration, to the last bit."""
    entries = []
    for parent, child, T in frames.frames():
        rows = "".join(f"        [{', '.join(number(value) for value in row)}],\n" for row in T)
        entries.append(f"    ({parent!r}, {child!r}): np.array([\n{rows}    ]),\n")
    return _HEAD + "".join(entries) + _TAIL
