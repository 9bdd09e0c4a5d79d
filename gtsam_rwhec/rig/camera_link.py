"""The frame of a camera's body, often ``camera_link``; the camera's driver has the transform to the optical frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import to_rotations

#: REP 103: a link's x is forward, y left, z up; an optical frame's z is forward, x right, y down. T_link_optical's R.
R_LINK_OPTICAL = ((0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0))
#: The length of a quaternion may differ from 1 by this: drivers print three digits.
UNIT_LENGTH = 5e-3


def link_of_optical(numbers: Sequence[float] | None = None) -> Array:
    """T_link_optical (4, 4), metres: of x, y, z, qx, qy, qz, qw, as ``tf2_echo`` prints them; else that of REP 103.

    Raises `ValueError` if the quaternion is not of length 1.
    """
    T = np.eye(4)
    if numbers is None:
        T[:3, :3] = R_LINK_OPTICAL
        return T
    given = np.asarray(numbers, dtype=float)
    length = float(np.linalg.norm(given[3:]))
    if abs(length - 1.0) > UNIT_LENGTH:
        words = f"the quaternion {given[3:].tolist()} has the length {length:.4g}"
        raise ValueError(f"{words}; give [x, y, z, qx, qy, qz, qw], metres and a unit quaternion")
    T[:3, :3] = to_rotations(given[None, 3:] / length)[0]
    T[:3, 3] = given[:3]
    return T
