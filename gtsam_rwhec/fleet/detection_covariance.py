"""The covariance of an answer from moments under the covariances of its measurements, which moments do not hold.

Moments weigh a measurement's rotation alike about all axes, and its translation along all. A tag's pose is known far
better in the image than along the ray, and its turn about the ray far better than its tilt. The answer is that of the
weights W; its covariance is H^-1 (sum J' W C W J) H^-1 with H = sum J' W J and C the covariance of each measurement.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from rwhec_factors.batch import BatchResiduals

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Measurements, Pair
from gtsam_rwhec.problem.problem import Problem


def with_covariances_of_detections(found: Calibration, problem: Problem, covariances: dict[Pair, Array]) -> Calibration:
    """The calibration with the covariance that its measurements' own covariances give.

    Parameters
    ----------
    found : Calibration
        Solved from the moments of ``problem``.
    problem : Problem
        With raw measurements.
    covariances : dict of (target, sensor) to (N, 6, 6) array
        Of B's right perturbation [omega (rad), v (m)], up to one factor, which the residuals tell. Of every pair; else
        the calibration stays as it is.
    """
    refined = found.refined
    if refined is None or not covariances or set(covariances) != set(problem.pairs) or len(refined.joint.slots) == 0:
        return found
    joint = refined.joint
    size = len(joint.unit)
    H, M, best = (np.zeros((size, size)) for _ in range(3))
    squares, count = 0.0, 0
    for pair in problem.pairs:
        raw, C = problem.measurements(*pair), covariances[pair]
        at, J, residual = rows_of_pair(refined, pair, raw.A, raw.B)
        WJ = weights_of_pair(refined, pair, raw)[:, :, None] * J
        H[np.ix_(at, at)] += np.einsum("nij,nik->jk", J, WJ, optimize=True)
        M[np.ix_(at, at)] += np.einsum("nij,nik->jk", WJ, C @ WJ, optimize=True)
        inverse = np.linalg.inv(C)
        best[np.ix_(at, at)] += np.einsum("nij,nik->jk", J, inverse @ J, optimize=True)
        squares += float(np.einsum("ni,nij,nj->", residual, inverse, residual, optimize=True))
        count += 6 * len(C)
    unit = joint.unit
    H, M, best = (matrix * unit[:, None] * unit for matrix in (H, M, best))
    Q = np.eye(size) if not joint.free.shape[1] else np.linalg.svd(joint.free)[0][:, joint.free.shape[1] :]
    known = Q @ np.linalg.solve(Q.T @ H @ Q, Q.T)
    finite = known @ M @ known
    # The residuals of an answer that is not the best have more than their share: with P = J H^-1 J' W their squares
    # are 6 N - 2 tr P + tr(C^-1 P C P') on average.
    finite *= squares / max(count - 2.0 * Q.shape[1] + float((best * finite).sum()), 1.0)
    finite = 0.5 * (finite + finite.T) * unit[:, None] * unit
    return replace(found, refined=replace(refined, joint=JointCovariance(joint.slots, finite, joint.free, unit)))


def rows_of_pair(refined: RefinedPoses, pair: Pair, A: Array, B: Array) -> tuple[np.ndarray, Array, Array]:
    """The places (k,) of a pair's unknowns, its residuals' derivatives (N, 6, k) by them, and the residuals (N, 6)."""
    slots = refined.joint.slots
    scale = refined.scale if isinstance(refined.scale, float) else refined.scale.get(pair.target, 1.0)
    X, Y = refined.X[pair.target].matrix(), refined.Y[pair.sensor].matrix()
    found = BatchResiduals(A, B).linearize(X, Y, scale)
    derivatives = (
        (Unknown(UnknownKind.FRAME, pair.target), found.target),
        (Unknown(UnknownKind.FRAME, pair.sensor), found.sensor),
        (Unknown(UnknownKind.SCALE, pair.target), found.scale[:, :, None]),
    )
    there = [(slots[unknown], derivative) for unknown, derivative in derivatives if unknown in slots]
    places = np.concatenate([np.arange(place.start, place.stop) for place, _ in there])
    return places, np.concatenate([derivative for _, derivative in there], axis=2), found.residual


def weights_of_pair(refined: RefinedPoses, pair: Pair, raw: Measurements) -> Array:
    """The weights (N, 6) with which moments count: alike, or by each measurement's own mean variances."""
    noise = refined.noise[pair]
    given = np.einsum("nii->ni", raw.covariance_of_B()).reshape(-1, 2, 3).mean(axis=2)
    relative = np.median(given, axis=0) / given
    return np.repeat(relative / np.array([noise.rotation_rad**2, noise.translation_m**2]), 3, axis=1)
