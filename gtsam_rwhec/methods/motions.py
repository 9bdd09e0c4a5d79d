"""The motions of AX = XB, C_i X = X H_i: checked, with signs of quaternions that agree, and their weights.

The DQ paper's cost depends on the signs of q_C and q_H, and the paper does not say how to choose them. L(q_C) - R(q_H)
is small for one relative sign only: both quaternions get a scalar part that is not negative. Near half a turn the
scalar part is noise about 0; there the sign is taken that agrees with the rotation from the other motions.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gtsam_rwhec.errors import CountError, NoiseError, OptionError, PoseError, UnderdeterminedError
from gtsam_rwhec.files.terminal_text import brief, counted
from gtsam_rwhec.geometry.poses import Array, PosesLike, QuaternionOrder, as_transforms, checked_rows
from gtsam_rwhec.geometry.quaternions import left, right
from gtsam_rwhec.geometry.real_numbers import is_between, real_array
from gtsam_rwhec.methods.dq_saddle import minimum
from gtsam_rwhec.methods.dual_quaternion_cost import DualQuaternionCost, E, blocks, from_rows, motion_moments, residuals

#: Squares and sums of weights above this, or below its inverse, overflow or underflow in double precision.
LARGEST = 1e100


def check_alpha(alpha: float | str) -> float:
    """Alpha as a float; an OptionError when it is not a positive number from 1 / LARGEST to LARGEST."""
    if not is_between(alpha, 1.0 / LARGEST, LARGEST):
        raise OptionError(
            f"alpha={brief(alpha)} is not a positive number from {1.0 / LARGEST:g} to {LARGEST:g}; it weighs "
            "translation residuals (1/m) against rotation residuals, about sigma_rotation / sigma_translation; "
            "'estimate' finds it from the residuals"
        )
    return float(alpha)


def _numbers(given: ArrayLike, what: str) -> Array:
    try:
        return real_array(given)
    except ValueError as error:
        raise NoiseError(f"{what} cannot be read as numbers ({error}); give an array of real numbers") from error


def check_weights(weights: ArrayLike | None, count: int) -> Array | None:
    """Weights as an array (N,), or None.

    Raises CountError when there is not one for each motion, and NoiseError for weights that are negative or not finite,
    or fewer than two that are not zero.
    """
    if weights is None:
        return None
    array = _numbers(weights, "weights")
    if array.shape != (count,):
        raise CountError(f"weights have shape {array.shape}; give one number for each of the {count} motions")
    bad = np.flatnonzero(~((array >= 0.0) & (array <= LARGEST)))
    if bad.size:
        raise NoiseError(
            f"weight {bad[0]} is {array[bad[0]]}; give a finite number from 0 (the motion is left out) to {LARGEST:g}"
        )
    if np.count_nonzero(array) < 2:
        raise NoiseError(f"{np.count_nonzero(array)} of {count} weights are not zero; AX = XB needs two motions")
    return array


def check_covariances(covariances: ArrayLike | None, count: int) -> Array | None:
    """Covariances (N, 8, 8), or (8, 8) for all motions, of (A q, B q + A q'); returns (N or 1, 8, 8), or None.

    Raises CountError for a wrong shape, NoiseError for covariances that are not symmetric, or not positive definite.
    """
    if covariances is None:
        return None
    array = _numbers(covariances, "covariances")
    if array.shape == (8, 8):
        array = array[None]
    if array.shape[1:] != (8, 8) or len(array) not in (1, count):
        raise CountError(
            f"covariances have shape {array.shape}; give (8, 8), or ({count}, 8, 8): one for each motion, of the "
            "residual (A q, B q + A q')"
        )
    asymmetry = np.abs(array - array.transpose(0, 2, 1)).max(axis=(1, 2))
    bad = np.flatnonzero(~(asymmetry <= 1e-9 * np.abs(array).max(axis=(1, 2))))
    if bad.size:
        raise NoiseError(
            f"covariance {bad[0]} is not finite and symmetric (off by {asymmetry[bad[0]]:.3g}); give finite numbers, "
            "the same on both sides of the diagonal"
        )
    smallest = np.linalg.eigvalsh(array)[:, 0]
    bad = np.flatnonzero(smallest <= 0.0)
    if bad.size:
        raise NoiseError(
            f"covariance {bad[0]} is not positive definite (smallest eigenvalue {smallest[bad[0]]:.3g}); add the "
            "variance that its most certain direction really has"
        )
    return array


#: If the sum of the scalar parts is below this, the sign is uncertain: noise of 11 degrees could change it.
UNCERTAIN = 0.2
#: The other motions determine the rotation when M's second eigenvalue is this many times its first.
DETERMINED = 9.0
#: Rounds in which signs and rotation are found from each other.
ROUNDS = 3


def flipped(rows: Array, sums: Array) -> Array:
    """``Motions.rows`` (14, n) with the sign of q_H and of its dual changed; ``sums`` (2, n) of the scalar parts."""
    result = np.empty_like(rows)
    for top in (0, 7):
        result[top : top + 3], result[top + 3 : top + 6] = rows[top + 3 : top + 6], rows[top : top + 3]
    result[6], result[13] = sums
    return result


def resolve_signs(rows: Array, sums: Array, uncertain: NDArray[np.bool_]) -> None:
    """Choose, in place, the signs of the motions ``uncertain`` (N,), whose scalar parts do not determine the sign.

    ``rows`` (14, N) are ``Motions.rows``, whose scalar parts are not negative; ``sums`` (2, N) are the sums of the
    scalar parts of q_C and q_H, and of their duals.
    """
    same = rows[:, uncertain]
    other = flipped(same, sums[:, uncertain])
    known = motion_moments(rows).AA - motion_moments(same).AA
    values, vectors = np.linalg.eigh(known)
    determined = values[1] > DETERMINED * values[0] + 1e-12 * values[3]
    trials = []
    for rotation in [vectors[:, 0]] if determined else _candidate_rotations(rows):
        for _ in range(ROUNDS):
            trial = np.where(_squares(other, rotation) < _squares(same, rotation), other, same)
            rotation = np.linalg.eigh(known + motion_moments(trial).AA)[1][:, 0]
        trials.append(trial)
    if len(trials) > 1:
        trials.sort(key=lambda trial: _cost(np.concatenate([rows[:, ~uncertain], trial], axis=1)))
    rows[:, uncertain] = trials[0]


def _squares(rows: Array, q: Array) -> Array:
    """|A q|^2 (n,) of motions (14, n)."""
    result: Array = (residuals(rows, q, np.zeros(4))[:4] ** 2).sum(axis=0)
    return result


def _cost(rows: Array) -> float:
    """The smallest cost of motions (14, n), with translations weighed as much as rotations."""
    moments = motion_moments(rows)
    lengths = np.trace(moments.BB)
    alpha = float(np.sqrt(np.trace(moments.AA) / lengths)) if lengths > 0.0 else 1.0
    return float(minimum(moments.cost(alpha)).values[0])


def _candidate_rotations(rows: Array) -> list[Array]:
    """Rotations that turn the axes of two motions of H onto their axes in C, with either sign of each axis."""
    C, H = 0.5 * (rows[:3] + rows[3:6]), 0.5 * (rows[:3] - rows[3:6])
    first = int((H * H).sum(axis=0).argmax())
    second = int((np.cross(H[:, first], H.T) ** 2).sum(axis=1).argmax())
    starts = []
    for i in (1.0, -1.0):
        for j in (1.0, -1.0):
            # q_C (x) q = q (x) q_H for both motions, without the scalar parts: vectors are turned onto vectors.
            M = np.zeros((4, 4))
            for index, sign in ((first, i), (second, j)):
                A = left(np.append(C[:, index], 0.0)) - right(np.append(sign * H[:, index], 0.0))
                M += A.T @ A
            starts += list(np.linalg.eigh(M)[1].T[:2])
    return starts


#: If all motions are smaller than this (rad, m), nothing moved.
STILL = 1e-14


@dataclass(frozen=True)
class Motions:
    """Motions of two rigidly joined frames, C_i X = X H_i (eq. 3)."""

    #: (N, 4, 4): C_i = T_cbefore_cafter and H_i = T_hbefore_hafter of the same move, metres; X = T_c_h
    C: Array
    H: Array
    #: (14, N): with v the vector part and w the scalar part: v_C + v_H (3), v_C - v_H (3), w_C - w_H, then the same of
    #: the dual parts. A_i and B_i (below eq. 6) depend on nothing else. The signs of q_C and q_H agree (``signs``).
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
            f"{counted(count, 'motion')} given; AX = XB needs two or more, about axes that are not parallel"
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


def covariance_cost(motions: Motions, covariances: Array) -> DualQuaternionCost:
    """The cost with a covariance (N or 1, 8, 8) of (A q, B q + A q') inside the norm (Section 3.1), without alpha."""
    total = np.zeros((8, 8))
    for block in blocks(len(motions), matrices=8):
        rows = motions.rows[:, block]
        J = np.zeros((rows.shape[1], 8, 8))
        J[:, :4, :4] = J[:, 4:, 4:] = np.einsum("kn,kij->nij", rows[:7], E)
        J[:, 4:, :4] = np.einsum("kn,kij->nij", rows[7:], E)
        information = np.linalg.inv(covariances if len(covariances) == 1 else covariances[block])
        total += np.einsum("nji,njk->ik", J, information @ J)
    total = 0.5 * (total + total.T)
    return DualQuaternionCost(total[:4, :4], total[4:, 4:], total[:4, 4:], len(motions))


def cost_of(
    motions: Motions, alpha: float = 1.0, weights: ArrayLike | None = None, covariances: ArrayLike | None = None
) -> DualQuaternionCost:
    """The cost (8) of motions.

    Parameters
    ----------
    alpha : float
        Positive, 1/m; not used with ``covariances``.
    weights : (N,) array, optional
        Factor of each motion's terms.
    covariances : (N, 8, 8) or (8, 8) array, optional
        Of the residuals (A q, B q + A q'), in place of alpha and weights.

    Raises
    ------
    OptionError, CountError, NoiseError
        For an alpha, weights or covariances that cannot be used.
    """
    if weights is not None and covariances is not None:
        raise OptionError("weights and covariances are both given; put the weights into the covariances")
    w, checked = check_weights(weights, len(motions)), check_covariances(covariances, len(motions))
    if checked is not None:
        return covariance_cost(motions, checked)
    return motion_moments(motions.rows, w).cost(check_alpha(alpha))


def squared_residuals(motions: Motions, q: Array, q_dual: Array, weights: Array | None = None) -> tuple[float, float]:
    """The weighted sums of |A q|^2 and |B q + A q'|^2 over the motions. As sums of squares, they lose no digits."""
    by_row = np.zeros(8)
    for block in blocks(len(motions)):
        squares = residuals(motions.rows[:, block], q, q_dual) ** 2
        by_row += squares.sum(axis=1) if weights is None else squares @ weights[block]
    return float(by_row[:4].sum()), float(by_row[4:].sum())


def squared_mahalanobis(motions: Motions, q: Array, q_dual: Array, covariances: Array) -> float:
    """The sum of e' covariance^-1 e over the motions, with e their residuals (8,)."""
    e = residuals(motions.rows, q, q_dual).T
    whitened = np.linalg.solve(covariances, e[:, :, None])[:, :, 0]
    return float((e * whitened).sum())
