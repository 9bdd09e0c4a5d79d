"""Unit quaternions of many rotations, scalar first, and the signs that each measurement's two must share.

A rotation has two quaternions, q and -q. In q_A q_X = q_Y q_B the signs of q_X and q_Y are the answer's own, but those
of each q_A and q_B are chosen, and an equation with the wrong one says something else. Here the sign is that with
which the linear rotation system's answer, which knows no signs, satisfies the equation.
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods.absolute import Stack, linear_rotations

#: L[c] and R[c] (4, 4): left and right multiplication by the c-th unit of (1, i, j, k).
LEFT = np.array(
    [
        [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, -1], [0, 0, 1, 0]],
        [[0, 0, -1, 0], [0, 0, 0, 1], [1, 0, 0, 0], [0, -1, 0, 0]],
        [[0, 0, 0, -1], [0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 0]],
    ],
    dtype=np.float64,
)
RIGHT = np.array(
    [
        [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1], [0, 0, -1, 0]],
        [[0, 0, -1, 0], [0, 0, 0, -1], [1, 0, 0, 0], [0, 1, 0, 0]],
        [[0, 0, 0, -1], [0, 0, 1, 0], [0, -1, 0, 0], [1, 0, 0, 0]],
    ],
    dtype=np.float64,
)


def left(q: Array) -> Array:
    """L(q) (..., 4, 4) with q p = L(q) p."""
    matrix: Array = np.einsum("...c,cij->...ij", q, LEFT)
    return matrix


def right(q: Array) -> Array:
    """R(q) (..., 4, 4) with p q = R(q) p."""
    matrix: Array = np.einsum("...c,cij->...ij", q, RIGHT)
    return matrix


def of_rotations(R: Array) -> Array:
    """(N, 4) unit quaternions of rotations (N, 3, 3), of either sign.

    The columns of 4 q q' are linear in R; the longest of them is accurate for every angle.
    """
    m = np.einsum("nij->ijn", R)
    outer = np.empty((4, 4, len(R)))  # 4 q q'
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    outer[0, 0] = 1.0 + trace
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        outer[1 + i, 1 + i] = 1.0 + 2.0 * m[i, i] - trace
        outer[0, 1 + i] = outer[1 + i, 0] = m[k, j] - m[j, k]
        outer[1 + j, 1 + k] = outer[1 + k, 1 + j] = m[j, k] + m[k, j]
    longest = np.einsum("iin->in", outer).argmax(axis=0)
    columns = outer[:, longest, np.arange(len(R))].T
    q: Array = columns / np.linalg.norm(columns, axis=1, keepdims=True)
    return q


def to_rotation(q: Array) -> Array:
    """(3, 3) of a quaternion of any length but zero."""
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def paired_quaternions(stack: Stack) -> tuple[Array, Array]:
    """q_A and q_B (N, 4) whose signs fit together: <q_A q_X, q_Y q_B> > 0 for the linear system's rotations."""
    R_X, R_Y = linear_rotations(stack)
    q_A, q_B = of_rotations(stack.A[:, :3, :3]), of_rotations(stack.B[:, :3, :3])
    q_X, q_Y = of_rotations(R_X)[stack.target], of_rotations(R_Y)[stack.sensor]
    product = np.einsum("nij,nj,nik,nk->n", left(q_A), q_X, left(q_Y), q_B)
    return q_A, np.where(product < 0.0, -1.0, 1.0)[:, None] * q_B
