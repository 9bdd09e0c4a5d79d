"""Unit quaternions of rotations, scalar last (xyzw), and the matrices of their products.

q and -q are one rotation. The product q (x) p turns vectors by the rotation of p, then by the rotation of q.
"""

from __future__ import annotations

import numpy as np
from rwhec_factors.se3 import Array

#: LEFT[c] and RIGHT[c] (4, 4) multiply by unit c of (i, j, k, 1), from the left and from the right.
LEFT = np.zeros((4, 4, 4))
RIGHT = np.zeros((4, 4, 4))
for _c in range(3):
    _a, _b = (_c + 1) % 3, (_c + 2) % 3
    for _table, _sign in ((LEFT, 1.0), (RIGHT, -1.0)):
        _table[_c, _b, _a], _table[_c, _a, _b] = _sign, -_sign
        _table[_c, _c, 3], _table[_c, 3, _c] = 1.0, -1.0
LEFT[3] = RIGHT[3] = np.eye(4)

_TURNED = np.einsum("cij,dkj->cdik", LEFT, RIGHT)[:, :, :3, :3]  # v -> q (x) v (x) q*
#: R[i, j] = sum of q_c q_d ROTATION[c, d, i, j] for a unit quaternion q; symmetric in c and d.
ROTATION = 0.5 * (_TURNED + _TURNED.transpose(1, 0, 2, 3))
#: 4 q q' - I is linear in R, by the same table: entry 4 c + d is row 4 c + d times vec R (column after column).
_PRODUCTS = np.ascontiguousarray(ROTATION.transpose(0, 1, 3, 2).reshape(16, 9))
_ONES = np.eye(4).reshape(16, 1)
_DIAGONAL = [0, 5, 10, 15]
_CONJUGATION = np.array([-1.0, -1.0, -1.0, 1.0])


def left(q: Array) -> Array:
    """L(q) with q (x) p = L(q) p: (..., 4) to (..., 4, 4)."""
    matrices: Array = np.einsum("...c,cij->...ij", q, LEFT)
    return matrices


def right(p: Array) -> Array:
    """R(p) with q (x) p = R(p) q: (..., 4) to (..., 4, 4)."""
    matrices: Array = np.einsum("...c,cij->...ij", p, RIGHT)
    return matrices


def conjugate(q: Array) -> Array:
    """q* = (-vector, scalar), the inverse rotation: (..., 4) to (..., 4)."""
    result: Array = q * _CONJUGATION
    return result


def of_rows(rows: Array) -> Array:
    """Unit quaternions (4, N), of either sign, of rotations vec R (9, N), column after column.

    Of the four columns of 4 q q', the column of q's largest entry is taken: it is accurate for every angle.
    """
    products = _PRODUCTS @ rows
    products += _ONES
    largest = products[_DIAGONAL].argmax(axis=0)
    q: Array = products.reshape(4, 4, -1)[:, largest, np.arange(rows.shape[1])]
    q /= np.sqrt((q * q).sum(axis=0))
    return q


def of_rotations(R: Array) -> Array:
    """Unit quaternions (N, 4), of either sign, of rotations (N, 3, 3)."""
    return of_rows(R.transpose(2, 1, 0).reshape(9, -1)).T


def to_rotations(q: Array) -> Array:
    """Rotations (..., 3, 3) of quaternions (..., 4) of any length but zero."""
    x, y, z, w = np.moveaxis(q, -1, 0)
    s = 2.0 / (w * w + x * x + y * y + z * z)
    R: Array = np.stack(
        [
            *(1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)),
            *(s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)),
            *(s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)),
        ],
        axis=-1,
    )
    return R.reshape(*q.shape[:-1], 3, 3)


def of_vectors(v: Array) -> Array:
    """Vectors (..., 3) as quaternions (..., 4) without a scalar part."""
    return np.concatenate([v, np.zeros((*v.shape[:-1], 1))], axis=-1)


def dual_parts(q: Array, t: Array) -> Array:
    """(t, 0) (x) q / 2 (N, 4), the dual parts of poses with quaternions q (N, 4) and translations t (N, 3)."""
    dual: Array = 0.5 * np.einsum("nij,nj->ni", left(of_vectors(t)), q)
    return dual
