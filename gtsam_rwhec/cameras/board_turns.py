"""The orientation of boards that look the same after a half or quarter turn: checkerboards and grids of circles.

One image does not show it. Over a track the motion does: A_i R_X = R_Y B_i R_z(w_i) in every image, with one R_X, one
R_Y and the turn w_i of each image. The turn of the first image stays free: it only defines the target's frame, which
all images of all sensors must share.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.cameras.plane_ambiguity import (
    LAGS,
    MOST_OF_A_LINK,
    MOST_OF_AN_IMAGE,
    SIGMA_TURN_RAD,
    agrees_with_none,
    extrinsic_rotations,
    first_rotation,
    rotations_off,
)
from gtsam_rwhec.geometry.poses import Array

#: With fewer images R_X and R_Y agree with too many turns.
LEAST_IMAGES = 5
#: This number of images, spread over the track, are compared with all others for first turns.
STARTS = 6
#: There are at most this many rounds of R_X, R_Y and turns.
ROUNDS = 10


@dataclass(frozen=True, eq=False)
class Turns:
    """The turns of n images of a track."""

    which: np.ndarray  #: (n,): turns about the board's z, in steps of 2 pi / ways
    #: (n,): by how much the track's log-likelihood exceeds that with another turn of this image; infinite where no turn
    #: agrees with the others
    margin: Array
    #: (n, 3, 3): rotations of the carriers and of the turned board, of the images whose carriers' poses are known
    R_A: Array
    R_B: Array


def turns_about_z(ways: int) -> Array:
    """Rotations (ways, 3, 3) about z, by 0 and by multiples of 2 pi / ways."""
    angle = 2.0 * np.pi * np.arange(ways) / ways
    turns = np.tile(np.eye(3), (ways, 1, 1))
    turns[:, 0, 0], turns[:, 0, 1] = np.cos(angle), -np.sin(angle)
    turns[:, 1, 0], turns[:, 1, 1] = np.sin(angle), np.cos(angle)
    return turns


def choose_turns(T: Array, covariance: Array, squared_px: Array, corner_px: float, carrier: Array, ways: int) -> Turns:
    """Choose the turn of each image of a track.

    Parameters
    ----------
    T : (n, 2, 4, 4) array
        A plane's candidates T_camera_target; the second is nan where there is only one.
    covariance : (n, 2, 6, 6) array
        Covariances of the candidates, right perturbation.
    squared_px : (n, 2) array
        Sums of squared reprojection errors of the candidates, px^2.
    corner_px : float
        Standard deviation of a corner along each axis, pixels.
    carrier : (n, 4, 4) array
        T_sensorcarrier_targetcarrier; nan where it is not known: the margin is then 0.
    ways : int
        The board looks the same after 1 / ways of a turn.
    """
    n = len(T)
    which, margin = np.zeros(n, dtype=int), np.zeros(n)
    known = np.asarray(np.isfinite(carrier).all(axis=(1, 2)) & np.isfinite(T[:, 0]).all(axis=(1, 2)))
    R_A, there = carrier[known, :3, :3], np.asarray(np.isfinite(T[known]).all(axis=(2, 3)))
    if known.sum() < LEAST_IMAGES:
        return Turns(which, margin, R_A[:0], R_A[:0])
    # (m, 2 ways, 3, 3): the turns of the first candidate, then those of the second.
    R = np.nan_to_num(T[known, :, None, :3, :3]) @ turns_about_z(ways)
    R_B = R.reshape(len(R), 2 * ways, 3, 3)
    of_pose = np.nan_to_num(np.trace(covariance[known, :, :3, :3], axis1=-2, axis2=-1)) / 3.0 + SIGMA_TURN_RAD**2
    variance = of_pose.repeat(ways, axis=1)
    image = np.where(there, 0.5 * squared_px[known] / corner_px**2, np.inf)
    image = np.minimum(image - image.min(axis=1, keepdims=True), MOST_OF_AN_IMAGE).repeat(ways, axis=1)
    answers = []
    for start in np.unique(np.linspace(0, len(R_A) - 1, STARTS).astype(int)):
        for candidate in range(2):
            if there[start, candidate]:
                answers.append(_settled(R_A, R_B, variance, image, start, candidate * ways, ways))
    best_cost, best = min(answers, key=lambda answer: float(answer[0].min(axis=1).sum()))
    total = float(best_cost.min(axis=1).sum())
    by_turn = best_cost.reshape(-1, 2, ways).min(axis=1)
    sure = np.partition(by_turn, 1, axis=1)
    sure = sure[:, 1] - sure[:, 0]
    for cost, chosen in answers:  # the same turns, counted from another one, are the same answer
        shift = np.bincount((chosen - best) % ways, minlength=ways).argmax()
        differs = (chosen - best - shift) % ways != 0
        sure[differs] = np.minimum(sure[differs], float(cost.min(axis=1).sum()) - total)
    sure[agrees_with_none(best_cost, image, MOST_OF_A_LINK)] = np.inf
    which[known], margin[known] = (best - best[0]) % ways, sure
    picked = R_B[np.arange(len(R_B)), np.argmin(best_cost, axis=1)] @ turns_about_z(ways)[-best[0] % ways]
    return Turns(which, margin, R_A, picked)


def _settled(
    R_A: Array, R_B: Array, variance: Array, image: Array, start: int, first: int, ways: int
) -> tuple[Array, np.ndarray]:
    """Costs (m, 2 ways) of all turns of both candidates, and the turns (m,), from image `start` with choice `first`."""
    each = np.arange(len(R_A))
    turned = se3.so3_logmap(R_A[start].T @ R_A)
    between = se3.so3_logmap((R_B[start, first].T @ R_B).reshape(-1, 3, 3)).reshape(*R_B.shape[:2], 3)
    off = np.linalg.norm(between, axis=2) - np.linalg.norm(turned, axis=1)[:, None]
    disagreement = np.minimum(0.5 * off**2 / variance, MOST_OF_A_LINK)
    disagreement[start] = np.where(np.arange(off.shape[1]) == first, 0.0, MOST_OF_A_LINK)
    cost = image + disagreement
    choice = np.argmin(cost, axis=1)
    R_X: Array = np.eye(3)
    R_Y = first_rotation(R_A, R_B[each, choice])
    for _ in range(ROUNDS):
        agrees = disagreement[each, choice] < MOST_OF_A_LINK
        if not agrees.any():
            break
        weight = np.where(agrees, 1.0 / variance[each, choice], 0.0)
        R_X, R_Y = extrinsic_rotations(R_A, R_B[each, choice], weight, R_X, R_Y)
        squared = (rotations_off(R_A, R_B, R_X, R_Y) ** 2).sum(axis=2)
        disagreement = np.minimum(0.5 * squared / variance, MOST_OF_A_LINK)
        cost = image + disagreement
        before, choice = choice, np.argmin(cost, axis=1)
        if np.array_equal(before, choice):
            break
    return cost, choice % ways


def turn_between(first: Turns, second: Turns, ways: int) -> tuple[int, float]:
    """The turn that gives the second sensor's target the first one's frame, and how much better it fits than others.

    Between images of one sensor, A_i^-1 A_j = X B_i^-1 B_j X^-1: R_X rotates the board's turn axes into the carriers'
    axes, and R_X is the same for all sensors.
    """
    of_first, of_other = (_axes(turns.R_A, turns.R_B) for turns in (first, second))
    if not (len(of_first[0]) and len(of_other[0])):
        return 0, 0.0
    a, b = (np.concatenate(parts) for parts in zip(of_first, of_other, strict=True))
    of_second = np.arange(len(a)) >= len(of_first[0])
    costs = []
    for turn in turns_about_z(ways):
        turned = np.where(of_second[:, None], b @ turn, b)  # R_z' b
        R_X = se3.so3_nearest(a.T @ turned)
        squared = ((a - turned @ R_X.T) ** 2).sum(axis=1)
        # Neighbours share images: their sum counts as one pair for each image.
        each = np.minimum(0.25 * squared / SIGMA_TURN_RAD**2, MOST_OF_A_LINK)
        costs.append(float(each.sum()) * min(1.0, (len(first.R_A) + len(second.R_A)) / max(len(a), 1)))
    order = np.argsort(costs)
    return int(order[0]), costs[order[1]] - costs[order[0]]


def _axes(R_A: Array, R_B: Array) -> tuple[Array, Array]:
    """Rotation vectors (p, 3) of the carriers and of the board between images that are `LAGS` apart."""
    pairs = [(R_A[:-lag], R_A[lag:], R_B[:-lag], R_B[lag:]) for lag in LAGS if lag < len(R_A)]
    if not pairs:
        return np.zeros((0, 3)), np.zeros((0, 3))
    A_i, A_j, B_i, B_j = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    return se3.so3_logmap(A_i.swapaxes(1, 2) @ A_j), se3.so3_logmap(B_i.swapaxes(1, 2) @ B_j)
