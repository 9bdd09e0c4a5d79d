"""Unit dual quaternions q + epsilon q' of poses, as the DQ paper writes them: (vector, scalar) = xyzw (Section 2).

A pose T = (R, t) is q of R and q' = (t, 0) (x) q / 2 (eq. 2); |q| = 1, q . q' = 0, and -(q, q') is the same pose.
"""

from __future__ import annotations

import math

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import of_rows

_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


def from_rows(rows: Array) -> tuple[Array, Array]:
    """Dual quaternions of checked poses.

    Parameters
    ----------
    rows : (12, N) array
        vec R, column after column, then t in metres (``gtsam_rwhec.geometry.poses.checked_rows``).

    Returns
    -------
    q, q_dual : (4, N) arrays
        xyzw, scalar part of q not negative; q_dual has the translation's unit (m / 2).
    """
    q = of_rows(rows[:9])
    q *= np.copysign(1.0, q[3])
    half = 0.5 * rows[9:12]
    v, w = q[:3], q[3]
    q_dual = np.empty_like(q)
    q_dual[:3] = half * w + half[_NEXT] * v[_LAST] - half[_LAST] * v[_NEXT]
    q_dual[3] = -(half * v).sum(axis=0)
    return q, q_dual


def from_transforms(T: Array) -> tuple[Array, Array]:
    """Dual quaternions of poses.

    Parameters
    ----------
    T : (N, 4, 4) array
        Rotations as they should be (not checked here), translations in metres.

    Returns
    -------
    q, q_dual : (N, 4) arrays
        xyzw, scalar part of q not negative.
    """
    rows = T[:, :3, :].transpose(2, 1, 0).reshape(12, -1)
    q, q_dual = from_rows(rows)
    return q.T, q_dual.T


def to_transform(q: Array, q_dual: Array) -> Array:
    """The pose (4, 4) of one dual quaternion, both parts (4,) xyzw; q need not be of length one.

    A q_dual that is not orthogonal to q loses its part along q, which is no part of any pose.
    """
    x, y, z, w = (float(entry) for entry in q)
    a, b, c, d = (float(entry) for entry in q_dual)
    s = 2.0 / (x * x + y * y + z * z + w * w)
    if not math.isfinite(s):
        raise ValueError(f"q = {q} has no length; a rotation needs one")
    return np.array(
        [
            # t = 2 q' (x) q*, its vector part
            [1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y), s * (w * a - d * x - b * z + c * y)],
            [s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x), s * (w * b - d * y - c * x + a * z)],
            [s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y), s * (w * c - d * z - a * y + b * x)],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def times_vectors(q: Array) -> Array:
    """V (4, 3) with (v, 0) (x) q = V v, for one q (4,): three columns of R(q), which span q's complement."""
    x, y, z, w = q.tolist()
    return np.array([[w, z, -y], [-z, w, x], [y, -x, w], [-x, -y, -z]])
