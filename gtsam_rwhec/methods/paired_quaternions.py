"""Signs of quaternions that each measurement's two rotations must share.

In q_A q_X = q_Y q_B the signs of q_X and q_Y are the answer's own, but those of each q_A and q_B are chosen, and an
equation with the wrong sign says something else. The sign chosen here is the one with which the answer of the linear
rotation system, which has no signs, satisfies the equation.
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import left, of_rotations
from gtsam_rwhec.methods.absolute import Stack, linear_rotations


def paired_quaternions(stack: Stack) -> tuple[Array, Array]:
    """q_A and q_B (N, 4) whose signs fit together: <q_A q_X, q_Y q_B> > 0 for the linear system's rotations."""
    R_X, R_Y = linear_rotations(stack)
    q_A, q_B = of_rotations(stack.A[:, :3, :3]), of_rotations(stack.B[:, :3, :3])
    q_X, q_Y = of_rotations(R_X)[stack.target], of_rotations(R_Y)[stack.sensor]
    return q_A, np.where(agreement(q_A, q_X, q_Y, q_B) < 0.0, -1.0, 1.0)[:, None] * q_B


def agreement(q_A: Array, q_X: Array, q_Y: Array, q_B: Array) -> Array:
    """<q_A q_X, q_Y q_B> (N,): the cosine of half the residual's angle, negative where the signs do not fit."""
    product: Array = np.einsum("nij,nj,nik,nk->n", left(q_A), q_X, left(q_Y), q_B)
    return product
