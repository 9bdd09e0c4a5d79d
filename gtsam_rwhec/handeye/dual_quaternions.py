"""Unit dual quaternions q + epsilon q' of poses, in the DQ paper's order (vector, scalar) = xyzw (Section 2).

A pose T = (R, t) has q, the quaternion of R, and q' = (t, 0) (x) q / 2 (eq. 2). So |q| = 1 and q . q' = 0, and
-(q, q') is the same pose.
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import of_rows, to_rotations

_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


def from_rows(rows: Array) -> tuple[Array, Array]:
    """Dual quaternions of poses (12, N): vec R, column after column, then t in metres (``poses.checked_rows``).

    q and q_dual are (4, N), xyzw. The scalar part of q is not negative; q_dual has the unit m / 2.
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
    """Dual quaternions q, q_dual (N, 4) of poses (N, 4, 4) as in ``from_rows``. The poses are not checked."""
    q, q_dual = from_rows(T[:, :3, :].transpose(2, 1, 0).reshape(12, -1))
    return q.T, q_dual.T


def to_transform(q: Array, q_dual: Array) -> Array:
    """The pose (4, 4) of one dual quaternion, parts (4,) xyzw, of any length but zero.

    The part of q_dual along q is left out: no pose has it. Raises ValueError when q is zero or not finite.
    """
    square = float(q @ q)
    if not 0.0 < square < np.inf:
        raise ValueError(f"q = {q} has no length; a rotation needs one")
    T = np.eye(4)
    T[:3, :3] = to_rotations(q)
    T[:3, 3] = (2.0 / square) * (times_vectors(q).T @ q_dual)  # q' = V t / 2 and V'V = |q|^2
    return T


def times_vectors(q: Array) -> Array:
    """V (4, 3) with (v, 0) (x) q = V v for one q (4,): three columns of R(q), which span q's complement."""
    x, y, z, w = q.tolist()
    return np.array([[w, z, -y], [-z, w, x], [y, -x, w], [-x, -y, -z]])
