"""The text of numbers, and rotations as quaternions and fixed-axis angles, for files."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from gtsam_rwhec.geometry.poses import Array


def number(value: float) -> str:
    """The fewest digits (at most 17) that are read as the same double, always with a decimal point.

    Without the point, YAML 1.1 takes 1e-05 for text and 1 for an integer.
    """
    text = repr(float(value) + 0.0)  # + 0.0: no -0.0
    mantissa, e, exponent = text.partition("e")
    return f"{mantissa}.0e{exponent}" if e and "." not in mantissa else text


def quaternion_xyzw(T: Array) -> Array:
    """The unit quaternion (4,) of a transform's rotation, as x, y, z, w, where w is not below 0."""
    quaternion: Array = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
    return quaternion


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
