"""Signs of quaternions that fit together in each measurement.

In q_A q_X = q_Y q_B the signs of q_X and q_Y belong to the answer. The signs of each q_A and q_B must be chosen, and an
equation with the wrong sign is wrong. The linear rotation system has no signs. So its answer decides: each sign is
the one with which this answer satisfies the equation.
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import left, of_rotations
from gtsam_rwhec.methods.absolute import Stack, linear_rotations


def paired_quaternions(stack: Stack) -> tuple[Array, Array]:
    """q_A and q_B (N, 4) with signs that fit: <q_A q_X, q_Y q_B> > 0 for the linear system's rotations."""
    q_A, q_B = of_rotations(stack.A[:, :3, :3]), of_rotations(stack.B[:, :3, :3])
    q = of_rotations(linear_rotations(stack))
    return q_A, np.where(agreement(q_A, q[stack.target], q[stack.sensor], q_B) < 0.0, -1.0, 1.0)[:, None] * q_B


def agreement(q_A: Array, q_X: Array, q_Y: Array, q_B: Array) -> Array:
    """<q_A q_X, q_Y q_B> (N,): the cosine of half the residual's angle, negative where the signs do not fit."""
    product: Array = np.einsum("nij,nj,nik,nk->n", left(q_A), q_X, left(q_Y), q_B)
    return product
