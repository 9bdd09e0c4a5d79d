"""The motions of AX = XB: C_i X = X H_i, checked, with the numbers that the DQ paper's equations take from them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gtsam_rwhec.errors import CountError, PoseError, UnderdeterminedError
from gtsam_rwhec.geometry.poses import Array, PosesLike, QuaternionOrder, as_transforms, checked_rows
from gtsam_rwhec.handeye.cost import blocks
from gtsam_rwhec.handeye.dual_quaternions import from_rows
from gtsam_rwhec.handeye.signs import UNCERTAIN, resolve_signs

#: When all motions are smaller than this (rad, m), nothing moved.
STILL = 1e-14


@dataclass(frozen=True)
class Motions:
    """Motions of two rigidly joined frames, C_i X = X H_i (eq. 3).

    Attributes
    ----------
    C, H : (N, 4, 4) arrays
        C_i = T_cbefore_cafter and H_i = T_hbefore_hafter of the same move, metres; X = T_c_h.
    rows : (14, N) array
        With v the vector part and w the scalar part: v_C + v_H (3), v_C - v_H (3), w_C - w_H, then the same of the
        dual parts. A_i and B_i (below eq. 6) depend on nothing else. The signs of q_C and q_H agree (``signs``).
    """

    C: Array
    H: Array
    rows: Array = field(repr=False)

    def __len__(self) -> int:
        return len(self.C)


def motions_of(C: PosesLike, H: PosesLike, order: QuaternionOrder | None = None) -> Motions:
    """Check motions.

    Parameters
    ----------
    C, H : (N, 4, 4) arrays, sequences of N gtsam.Pose3, or (N, 7) arrays
        Relative poses T_before_after of the two frames, metres.
    order : "wxyz" or "xyzw", optional
        Of the quaternions in rows of 7 (quaternion, translation).

    Raises
    ------
    PoseError
        When a matrix is not a pose; the message names the argument and the motion.
    CountError
        Unequal numbers, or fewer than two motions.
    UnderdeterminedError
        Every motion is the identity.
    """
    C, H = as_transforms(C, order, "C"), as_transforms(H, order, "H")
    count = len(C)
    if count != len(H):
        raise CountError(
            f"C has {count} motions and H has {len(H)}; C_i X = X H_i pairs motion i of C with motion i of H: "
            "give as many of both"
        )
    if count < 2:
        raise CountError(
            f"{count} motion{'s' * (count != 1)} given; AX = XB needs two or more, about axes that are not parallel"
        )
    rows = np.empty((14, count))
    sums = np.empty((2, count))
    for block in blocks(count):
        _fill(C[block], H[block], block.start, rows[:, block], sums[:, block])
    if np.abs(rows[:7]).max() <= STILL:
        rows[:7] = 0.0  # rounding would pass for a rotation
    if np.abs(rows).max() <= STILL:
        raise UnderdeterminedError(
            f"all {count} motions are the identity, in C and in H: nothing moved, so X cannot be told; "
            "give relative poses between times at which the frames stood differently"
        )
    uncertain = sums[0] < UNCERTAIN
    if uncertain.any():
        resolve_signs(rows, sums, uncertain)
    return Motions(C, H, rows)


def _fill(C: Array, H: Array, first: int, rows: Array, sums: Array) -> None:
    """Fill a block's ``Motions.rows``, and the sums (2, b) of the scalar parts and of the dual scalar parts."""
    b = len(C)
    try:  # both at once, in half the calls
        checked = checked_rows(np.concatenate([C, H]), first, "C and H").rows
    except PoseError:
        checked_rows(C, first, "C")  # each alone: the error names the argument and the motion
        checked_rows(H, first, "H")
        raise
    for part, top in zip(from_rows(checked), (0, 7), strict=True):
        of_C, of_H = part[:, :b], part[:, b:]
        np.add(of_C[:3], of_H[:3], out=rows[top : top + 3])
        np.subtract(of_C, of_H, out=rows[top + 3 : top + 7])
        np.add(of_C[3], of_H[3], out=sums[top // 7])
