"""Unit dual quaternions q + epsilon q' of poses, as the DQ paper writes them: (vector, scalar) = xyzw (Section 2).

A pose T = (R, t) is q of R and q' = (t, 0) (x) q / 2 (eq. 2); |q| = 1, q . q' = 0, and -(q, q') is the same pose.
"""

from __future__ import annotations

import math

import numpy as np

from gtsam_rwhec.geometry.poses import Array

#: 4 q q' from the rotation: row 4 i + j of ``_PRODUCTS`` dotted with vec R (column after column) is 4 q_i q_j, up to
#: the 1 that the diagonal has besides.
_PRODUCTS = np.zeros((16, 9))
for _i, _j, _plus, _minus in (
    (0, 0, (0,), (4, 8)),
    (1, 1, (4,), (0, 8)),
    (2, 2, (8,), (0, 4)),
    (3, 3, (0, 4, 8), ()),
    (0, 1, (1, 3), ()),
    (0, 2, (2, 6), ()),
    (1, 2, (5, 7), ()),
    (0, 3, (5,), (7,)),
    (1, 3, (6,), (2,)),
    (2, 3, (1,), (3,)),
):
    for _row in (4 * _i + _j, 4 * _j + _i):
        _PRODUCTS[_row, list(_plus)] = 1.0
        _PRODUCTS[_row, list(_minus)] = -1.0
_ONES = np.eye(4).reshape(16, 1)
_DIAGONAL = [0, 5, 10, 15]
_NEXT, _LAST = [1, 2, 0], [2, 0, 1]
#: left(q) and right(q) are linear in q: entry [i, j, k] is what q_k adds to row i, column j.
_LEFT = np.zeros((4, 4, 4))
_RIGHT = np.zeros((4, 4, 4))
for _k in range(3):
    _a, _b = (_k + 1) % 3, (_k + 2) % 3
    for _table, _sign in ((_LEFT, 1.0), (_RIGHT, -1.0)):
        _table[_b, _a, _k], _table[_a, _b, _k] = _sign, -_sign  # +-[q]x
        _table[_k, 3, _k], _table[3, _k, _k] = 1.0, -1.0
for _table in (_LEFT, _RIGHT):
    _table[range(4), range(4), 3] = 1.0


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
    products = _PRODUCTS @ rows[:9]
    products += _ONES
    # Of the four columns of 4 q q', that of the largest entry of q: never a small difference of large numbers.
    largest = products[_DIAGONAL].argmax(axis=0)
    q = products.reshape(4, 4, -1)[:, largest, np.arange(rows.shape[1])]
    q *= np.copysign(1.0, q[3]) / np.sqrt((q * q).sum(axis=0))
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


def left(q: Array) -> Array:
    """L(q) with q (x) p = L(q) p (below eq. 5): (..., 4) to (..., 4, 4)."""
    matrices: Array = np.moveaxis(_LEFT @ np.moveaxis(q, -1, 0).reshape(4, -1), -1, 0)
    return matrices.reshape((*q.shape[:-1], 4, 4))


def right(p: Array) -> Array:
    """R(p) with q (x) p = R(p) q (below eq. 5): (..., 4) to (..., 4, 4)."""
    matrices: Array = np.moveaxis(_RIGHT @ np.moveaxis(p, -1, 0).reshape(4, -1), -1, 0)
    return matrices.reshape((*p.shape[:-1], 4, 4))


def times_vectors(q: Array) -> Array:
    """V (4, 3) with (v, 0) (x) q = V v, for one q (4,): three columns of R(q), which span q's complement."""
    x, y, z, w = q.tolist()
    return np.array([[w, z, -y], [-z, w, x], [y, -x, w], [-x, -y, -z]])


def conjugate(q: Array) -> Array:
    """q* = (-vector, scalar); of a dual quaternion, taken of both parts. (..., 4) to (..., 4)."""
    result: Array = q * np.array([-1.0, -1.0, -1.0, 1.0])
    return result
