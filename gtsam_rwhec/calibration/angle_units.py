"""Angles in the wrong unit: what can be undone, given rotation matrices alone.

Radians that were read as degrees leave all rotations small, and nothing is lost: rotation vectors and each order of
Euler angles are stretched again. Degrees that were read as radians lose whole turns. Of a rotation vector its axis
remains: R_A a = a gives, for the axes a_i of A, the linear equations R_B P a = Q a with P = R_X' and Q = R_Y', whose
null vector is the calibration; it says which whole turns were lost. Where all axes are nearly one, it says nothing. Of
Euler angles nothing remains that equations could use. Such data are called implausible, and not named.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator

import numpy as np
from rwhec_factors.se3 import expmap, pose, so3_logmap

from gtsam_rwhec.calibration.readings import Mistake, Reading, Rows
from gtsam_rwhec.geometry.poses import Array

#: Rotations of less than half a turn in degrees that were taken for radians, about one axis: 180 / 57.3 degrees.
SMALL_RAD = np.pi / np.degrees(1.0)
#: Three Euler angles may each be as large.
SMALL_EULER_RAD = 1.8 * SMALL_RAD
#: Fewer measurements of a pair do not determine the 18 unknowns of the axes' equations well.
FEWEST = 8


def _rotations(omega: Array) -> Array:
    """Rotations (N, 3, 3) of rotation vectors (N, 3)."""
    R: Array = expmap(np.concatenate([omega, np.zeros_like(omega)], axis=1))[:, :3, :3]
    return R


def stretched(T: Array) -> Array:
    """Poses whose rotation vectors were in radians, and were divided by 57.3 as degrees are."""
    return pose(_rotations(np.degrees(so3_logmap(T[:, :3, :3]))), T[:, :3, 3])


def stretched_euler(order: tuple[int, ...]) -> Callable[[Array], Array]:
    """The same for Euler angles about three axes (0, 1, 2 for x, y, z), each about the axes as turned before."""
    i, j, k = order
    sign = 1.0 if order in ((0, 1, 2), (1, 2, 0), (2, 0, 1)) else -1.0

    def change(T: Array) -> Array:
        R = T[:, :3, :3]
        # R = R_i(a) R_j(b) R_k(c): the entry (i, k) is the sine of b, and its row and column have a and c.
        b = np.arcsin(np.clip(sign * R[:, i, k], -1.0, 1.0))
        a = np.arctan2(-sign * R[:, j, k], R[:, k, k])
        c = np.arctan2(-sign * R[:, i, j], R[:, i, i])
        axes = np.eye(3)
        turns = [_rotations(np.degrees(angle)[:, None] * axes[axis]) for angle, axis in ((a, i), (b, j), (c, k))]
        return pose(turns[0] @ turns[1] @ turns[2], T[:, :3, 3])

    return change


def unwound(T: Array, other: Array) -> Array:
    """Poses whose rotation vectors were in degrees, and were taken for radians; ``other`` are the right ones beside.

    For A it is B, and for B it is A. Poses that cannot be unwound stay as they are.
    """
    if len(T) < FEWEST:
        return T
    omega = so3_logmap(T[:, :3, :3])
    angle = np.linalg.norm(omega, axis=1)
    axis = omega / np.maximum(angle, 1e-12)[:, None]
    S = other[:, :3, :3]
    # S P a = Q a, with S the other side's rotation. Where T is A, P is R_X' and Q is R_Y'; where T is B, P is R_X and Q
    # is R_Y: 18 unknowns up to a factor.
    of_P = np.einsum("nrp,nq->nrpq", S, axis).reshape(-1, 9)
    of_Q = np.einsum("rp,nq->nrpq", np.eye(3), axis).reshape(-1, 9)
    null = np.linalg.svd(np.concatenate([of_P, -of_Q], axis=1), full_matrices=False)[2][-1].reshape(2, 3, 3)
    left, _, right = np.linalg.svd(null * np.sign(np.linalg.det(null[0])))
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
    P, Q = left @ right
    expected = np.einsum("ni,ni->n", so3_logmap(Q.T @ S @ P), axis)
    # The true angle is (angle + whole turns) degrees.
    turns = np.round((np.degrees(expected) - angle) / (2.0 * np.pi))
    return pose(_rotations(np.radians(angle + 2.0 * np.pi * turns)[:, None] * axis), T[:, :3, 3])


def readings_of_angles(A: Array, B: Array) -> Iterator[Reading]:
    """The readings that angles in the wrong unit leave to try, for poses (N, 4, 4) of all pairs."""
    for side, T in (("A", A), ("B", B)):
        largest = float(np.linalg.norm(so3_logmap(T[:, :3, :3]), axis=1).max())
        likely = f"the angles of {side} are in radians, and were read as degrees"
        if largest <= SMALL_RAD * (1.0 + 1e-6):
            cure = f"do not convert the rotation vectors of {side}: they are in radians"
            yield Reading(Mistake.ANGLE_UNIT, likely, cure, _of_side(side, _alone(stretched)), of_small_angles=True)
        if largest <= SMALL_EULER_RAD:
            for order in itertools.permutations(range(3)):
                letters = "".join("XYZ"[axis] for axis in order)
                cure = f"do not convert the Euler angles of {side}: they are in radians (intrinsic {letters})"
                change = _of_side(side, _alone(stretched_euler(order)))
                yield Reading(Mistake.ANGLE_UNIT, likely, cure, change, of_small_angles=True)
        elif largest > SMALL_RAD:
            likely = f"the rotation vectors of {side} are in degrees, and were read as radians"
            cure = f"convert the rotation vectors of {side} to radians"
            yield Reading(Mistake.ANGLE_UNIT, likely, cure, _of_side(side, unwound))


def _alone(change: Callable[[Array], Array]) -> Callable[[Array, Array], Array]:
    """A change that needs nothing of the other side."""
    return lambda T, other: change(T)


def _of_side(side: str, change: Callable[[Array, Array], Array]) -> Callable[[Array, Array], Rows]:
    return (lambda A, B: (change(A, B), B)) if side == "A" else (lambda A, B: (A, change(B, A)))
