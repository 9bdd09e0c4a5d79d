"""The choice between a plane's two poses, over a whole track.

A far or nearly frontal plane looks almost the same in two poses, mirror images of each other about the line of sight.
The reprojection errors of one image hardly distinguish them. A track gives more information: between two images the
target turns relative to the camera by the same angle as the target carrier relative to the sensor carrier, for any
extrinsics (A_i^-1 A_j and B_i B_j^-1 are conjugate). A wrong choice changes that angle. Dynamic programming finds the
most likely choice of the whole track, a chain with two states for each image; the cost of the best chain through the
other state says how sure each choice is. Where the carriers' poses are known in enough images, one extrinsic rotation
for all images decides better than the angles between neighbours (`choose_by_agreement`).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array

#: Time offsets and arm errors give the angle between two images this standard deviation (rad). Corner noise adds to it.
SIGMA_TURN_RAD = float(np.radians(3.0))
#: A target's angular velocity against the camera has this standard deviation (rad/s) where carriers' poses are unknown.
SIGMA_RATE_RAD_S = float(np.radians(60.0))
#: Two images are not compared if they are further apart in time than this (seconds).
LONGEST_LINK_S = 3.0
#: The comparison of two images costs at most this (log-likelihood), so that it cannot outweigh the others.
MOST_OF_A_LINK = 8.0
#: One image costs at most this (log-likelihood), so that it cannot outweigh the others.
MOST_OF_AN_IMAGE = 30.0
#: Two candidates are one pose if their rotations differ by less than this (rad).
SAME_RAD = float(np.radians(0.2))


@dataclass(frozen=True, eq=False)
class Choice:
    """The candidates chosen in n images of a track."""

    which: np.ndarray  #: (n,): the chosen candidate, 0 or 1
    #: (n,): by how much the chosen track's log-likelihood exceeds that of the best track with this image's other
    #: candidate; infinite where neither agrees with the others
    margin: Array


def choose_over_time(
    stamps_ns: np.ndarray,
    T: Array,
    squared_px: Array,
    covariance: Array,
    corner_px: float,
    carrier: Array | None = None,
) -> Choice:
    """Choose one candidate for each image of a track.

    Parameters
    ----------
    stamps_ns : (n,) integers
        Increasing.
    T : (n, 2, 4, 4) array
        Candidates T_camera_target; the second is nan where there is only one.
    squared_px : (n, 2) array
        Sums of squared reprojection errors.
    covariance : (n, 2, 6, 6) array
        Covariances of the candidates.
    corner_px : float
        Standard deviation of a corner along each axis, pixels.
    carrier : (n, 4, 4) array, optional
        A = T_sensorcarrier_targetcarrier at the stamps; nan where it is not known.
    """
    n = len(stamps_ns)
    image = np.nan_to_num(0.5 * squared_px / corner_px**2, nan=np.inf)
    if n == 0:
        return Choice(np.zeros(0, dtype=int), np.zeros(0))
    image = np.minimum(image - image.min(axis=1, keepdims=True), MOST_OF_AN_IMAGE)
    image[~np.isfinite(T).all(axis=(2, 3))] = np.inf
    link = _links(stamps_ns, T, covariance, carrier)
    # forward[i, a]: cost of the best chain up to image i in state a; backward[i, a]: of the best chain after it.
    forward, backward = image.copy(), np.zeros((n, 2))
    for i in range(1, n):
        forward[i] += (forward[i - 1][:, None] + link[i - 1]).min(axis=0)
    for i in range(n - 2, -1, -1):
        backward[i] = (link[i] + (image[i + 1] + backward[i + 1])[None, :]).min(axis=1)
    through = forward + backward
    which = np.argmin(through, axis=1)
    with np.errstate(invalid="ignore"):
        margin = np.abs(through[:, 1] - through[:, 0])
    known = np.zeros(n, dtype=bool) if carrier is None else np.asarray(np.isfinite(carrier).all(axis=(1, 2)))
    known &= np.isfinite(image).any(axis=1)
    if carrier is not None and known.sum() >= LEAST_IMAGES:
        of_rotation = np.nan_to_num(covariance[known, :, :3, :3]) + SIGMA_TURN_RAD**2 * np.eye(3)
        which[known], margin[known] = choose_by_agreement(
            T[known], carrier[known], of_rotation, image[known], which[known], most=MOST_OF_A_LINK
        )
    with np.errstate(invalid="ignore"):
        R = T[..., :3, :3]
        apart = np.linalg.norm(se3.so3_logmap(np.nan_to_num(np.swapaxes(R[:, 0], 1, 2) @ R[:, 1])), axis=1)
    margin[(apart < SAME_RAD) | ~np.isfinite(T[:, 1]).all(axis=(1, 2))] = np.inf
    return Choice(which, margin)


def _links(stamps_ns: np.ndarray, T: Array, covariance: Array, carrier: Array | None) -> Array:
    """Costs (n - 1, 2, 2) of each pair of successive states: how far their angle is from the carriers' angle."""
    seconds = np.diff(stamps_ns) * 1e-9
    R = np.nan_to_num(T[..., :3, :3])
    between = R[:-1, :, None] @ np.swapaxes(R[1:, None], -1, -2)  # B_i B_j^-1
    angle = np.linalg.norm(se3.so3_logmap(between.reshape(-1, 3, 3)), axis=1).reshape(-1, 2, 2)
    of_pose = np.nan_to_num(np.trace(covariance[..., :3, :3], axis1=-2, axis2=-1)) / 3.0
    variance = of_pose[:-1, :, None] + of_pose[1:, None] + SIGMA_TURN_RAD**2
    off = angle
    spread = variance + (SIGMA_RATE_RAD_S * seconds[:, None, None]) ** 2
    if carrier is not None:
        C = carrier[:, :3, :3]
        known = np.asarray(np.isfinite(C).all(axis=(1, 2)))
        turned = np.linalg.norm(se3.so3_logmap(np.nan_to_num(np.swapaxes(C[:-1], 1, 2) @ C[1:])), axis=1)
        both = (known[:-1] & known[1:])[:, None, None]
        off = np.where(both, angle - turned[:, None, None], angle)
        spread = np.where(both, variance, spread)
    cost: Array = np.minimum(0.5 * off**2 / spread, MOST_OF_A_LINK)
    cost[seconds > LONGEST_LINK_S] = 0.0
    return cost


#: A track needs this number of images: with fewer images, R_X and R_Y agree with too many choices.
LEAST_IMAGES = 12
#: There are at most this many rounds of choices.
ROUNDS = 10
#: Each round of choices solves for R_X and R_Y in turns this many times.
TURNS = 4
#: Each round of choices makes this many steps of Gauss-Newton on R_X and R_Y.
STEPS = 4
#: All choices are tried for this number of images, whose carriers' rotations are far apart.
FEW = 4
#: This number of the best choices become starts.
BEST = 3
#: Two images are compared for a first R_Y if their indices differ by one of these.
LAGS = (1, 2, 4, 8, 16, 32)
#: A translation's standard deviation is this share of the distance. The tag's size, clocks and corner noise add to it.
SIGMA_SHARE = 0.03
#: Two turns can be one turn, seen by the carriers and by the camera, if their angles differ by less than this (rad).
ALIKE_RAD = float(np.radians(6.0))


@dataclass(frozen=True, eq=False)
class _Track:
    """R_A (n, 3, 3) and t_A (n, 3) of n images, with the candidates R_B (n, 2, 3, 3) and t_B (n, 2, 3).

    `information` (n, 2, 3, 3) is the inverse covariance of a candidate's rotation (rad^-2, right perturbation), `image`
    (n, 2) the cost of a candidate in its own image, and `most` the largest cost of a disagreement.
    """

    R_A: Array
    t_A: Array
    R_B: Array
    t_B: Array
    information: Array
    image: Array
    most: float


@dataclass(frozen=True, eq=False)
class _Answer:
    """Choices (n,), the costs of both candidates (n, 2), and the total cost of the choices."""

    which: np.ndarray
    cost: Array
    total: float


def choose_by_agreement(
    T: Array, carrier: Array, covariance: Array, image: Array, which: np.ndarray, *, most: float
) -> tuple[np.ndarray, Array]:
    """Return choices (n,) and margins (n,) as in `ambiguity.Choice`.

    T (n, 2, 4, 4) are the candidates T_camera_target, `carrier` (n, 4, 4) is T_sensorcarrier_targetcarrier, and `which`
    (n,) is a first choice. `covariance` (n, 2, 3, 3) is of each candidate's rotation (rad^2, right perturbation), with
    the errors of clocks and carriers. `image` (n, 2) is the cost of each candidate in its own image (negative
    log-likelihood), infinite where a candidate is missing; `most` limits the cost of an image that disagrees.
    """
    B = np.nan_to_num(T)
    information = np.linalg.inv(covariance)
    track = _Track(carrier[:, :3, :3], carrier[:, :3, 3], B[..., :3, :3], B[..., :3, 3], information, image, most)
    each, there = np.arange(len(which)), np.isfinite(image)

    def settled(start: np.ndarray) -> _Answer:
        return _settled(track, np.where(there[each, start], start, 1 - start))

    answers = [settled(start) for start in (which, 1 - which, np.argmin(image, axis=1), *_starts(track))]
    answers.append(settled(1 - min(answers, key=lambda answer: answer.total).which))
    best = min(answers, key=lambda answer: answer.total)
    margin = np.abs(best.cost[:, 1] - best.cost[:, 0])
    for other in answers:
        differs = other.which != best.which
        margin[differs] = np.minimum(margin[differs], other.total - best.total)
    margin[agrees_with_none(best.cost, image, most)] = np.inf
    return best.which, margin


def agrees_with_none(cost: Array, image: Array, most: float) -> np.ndarray:
    """Images (n,) of which no candidate (n, c) agrees with the others, of costs with those in the image alone.

    They are not ambiguous: they contradict the others, and what looks for outliers must see them.
    """
    with np.errstate(invalid="ignore"):
        return np.asarray((~np.isfinite(image) | (cost - image > most - 1e-9)).all(axis=1))


def _starts(track: _Track) -> list[np.ndarray]:
    """First choices (n,): the best combination of candidates in a few images; in the others, those that fit it."""
    few = _apart(track.R_A)
    found: list[tuple[float, np.ndarray]] = []
    for picked in itertools.product((0, 1), repeat=len(few)):
        R_B = track.R_B[few, np.array(picked)]
        first = first_rotation(track.R_A[few], R_B)
        R_X, R_Y = extrinsic_rotations(track.R_A[few], R_B, np.ones(len(few)), np.eye(3), first)
        cost = track.image + _disagreement(track, R_X, R_Y)
        found.append((float(cost.min(axis=1).sum()), np.argmin(cost, axis=1)))
    return [which for _, which in sorted(found, key=lambda item: item[0])[:BEST]]


def _apart(R: Array) -> np.ndarray:
    """Choose `FEW` of the rotations (n, 3, 3) that are far apart, and return their indices."""
    chosen = [0]
    nearest = np.full(len(R), np.inf)
    for _ in range(FEW):
        cosine = 0.5 * (np.einsum("nij,ij->n", R, R[chosen[-1]]) - 1.0)
        nearest = np.minimum(nearest, np.arccos(np.clip(cosine, -1.0, 1.0)))
        chosen.append(int(np.argmax(nearest)))
    return np.array(chosen[1:])


def _disagreement(track: _Track, R_X: Array, R_Y: Array) -> Array:
    """Costs (n, 2) of the candidates' rotations, for given rotations of the extrinsics."""
    off = rotations_off(track.R_A, track.R_B, R_X, R_Y)
    cost: Array = np.minimum(0.5 * np.einsum("nci,ncij,ncj->nc", off, track.information, off), track.most)
    return cost


def _settled(track: _Track, which: np.ndarray) -> _Answer:
    n = len(which)
    each = np.arange(n)
    weight: Array = np.ones(n)
    R_X: Array = np.eye(3)
    R_Y, cost = first_rotation(track.R_A, track.R_B[each, which]), track.image
    for _ in range(ROUNDS):
        R_X, R_Y = extrinsic_rotations(track.R_A, track.R_B[each, which], weight, R_X, R_Y)
        disagreement = _disagreement(track, R_X, R_Y)
        cost = track.image + disagreement
        before, which = which, np.argmin(cost, axis=1)
        # Images with the largest cost do not count: they may show another tag with this id, or a clock may have jumped.
        sure = np.trace(track.information[each, which], axis1=1, axis2=2)
        weight = np.where(disagreement[each, which] < track.most, sure, 0.0)
        if not weight.any():
            weight = np.ones(n)
        if np.array_equal(before, which):
            break
    return _Answer(which, cost, float(cost[each, which].sum()) + _translations(track, R_Y, which))


def rotations_off(R_A: Array, R_B: Array, R_X: Array, R_Y: Array) -> Array:
    """The rotation vectors (n, c, 3) from the predicted R_Y' R_A R_X to R_B (n, c, 3, 3), in the target's frame."""
    predicted = R_Y.T @ R_A @ R_X
    return se3.so3_logmap((predicted[:, None].swapaxes(-1, -2) @ R_B).reshape(-1, 3, 3)).reshape(*R_B.shape[:2], 3)


def extrinsic_rotations(R_A: Array, R_B: Array, weight: Array, R_X: Array, R_Y: Array) -> tuple[Array, Array]:
    """Solve R_A R_X = R_Y R_B for R_X and R_Y, by weighted least squares from a first R_Y."""
    w = weight[:, None, None]
    for _ in range(TURNS):
        R_X = se3.so3_nearest((w * (R_A.swapaxes(1, 2) @ R_Y @ R_B)).sum(axis=0))
        R_Y = se3.so3_nearest((w * (R_A @ R_X @ R_B.swapaxes(1, 2))).sum(axis=0))
    root = np.sqrt(weight)
    for _ in range(STEPS):
        off = rotations_off(R_A, R_B[:, None], R_X, R_Y)[:, 0]
        # R_X Exp(x), R_Y Exp(y): the prediction P turns by x - P' y. Turns about a single axis leave x and y partly
        # free: lstsq takes the step of minimum norm.
        P = R_Y.T @ R_A @ R_X
        J = np.concatenate([np.broadcast_to(np.eye(3), P.shape), -P.swapaxes(1, 2)], axis=2)
        rows, right = (root[:, None, None] * J).reshape(-1, 6), (root[:, None] * off).ravel()
        step = np.linalg.lstsq(rows, right, rcond=1e-6)[0]
        R_X, R_Y = (
            R @ se3.expmap(np.append(v, np.zeros(3))[None])[0, :3, :3] for R, v in ((R_X, step[:3]), (R_Y, step[3:]))
        )
    return R_X, R_Y


def first_rotation(R_A: Array, R_B: Array) -> Array:
    """R_Y that turns the axes of the target's motions onto the carriers': R_A R_A' = R_Y R_B R_B' R_Y'."""
    M = np.zeros((3, 3))
    for lag in LAGS:
        if lag < len(R_A):
            a, b = (se3.so3_logmap(R[:-lag] @ R[lag:].swapaxes(1, 2)) for R in (R_A, R_B))
            alike = np.abs(np.linalg.norm(a, axis=1) - np.linalg.norm(b, axis=1)) < ALIKE_RAD
            M += a[alike].T @ b[alike]
    return se3.so3_nearest(M)


def _translations(track: _Track, R_Y: Array, which: np.ndarray) -> float:
    """Cost of R_A t_X + t_A = R_Y t_B scale + t_Y with the best t_X, t_Y and scale."""
    n = len(which)
    turned = track.t_B[np.arange(n), which] @ R_Y.T
    matrix: Array = np.concatenate([track.R_A, np.broadcast_to(-np.eye(3), (n, 3, 3)), -turned[..., None]], axis=2)
    sigma = SIGMA_SHARE * np.linalg.norm(turned, axis=1) + 1e-9
    weight, cost = 1.0 / sigma, np.zeros(n)
    for _ in range(4):
        rows = (weight[:, None, None] * matrix).reshape(-1, 7)
        x = np.linalg.lstsq(rows, -(weight[:, None] * track.t_A).ravel(), rcond=None)[0]
        squared = ((matrix @ x + track.t_A) ** 2).sum(axis=1) / sigma**2
        cost = np.minimum(0.5 * squared, track.most)
        weight = 1.0 / (sigma * np.maximum(1.0, np.sqrt(squared) / 2.0))
    return float(cost.sum())
