"""Problems with some of the measurements of another problem, or with other weights, and the same knowledge.

A frame that loses its last measurement is not in the new problem (``Problem.with_measurements``).
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import CountError, NoiseError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.accumulation import Accumulator, Row
from gtsam_rwhec.problem.corners import candidates_of_each
from gtsam_rwhec.problem.directions import aligned, common_slides, scaled, slides_of
from gtsam_rwhec.problem.knowledge import scale_at
from gtsam_rwhec.problem.many_measurements import KeptMeasurements
from gtsam_rwhec.problem.measurements import ByPair, Measurements, Pair
from gtsam_rwhec.problem.moment_stack import MomentStack
from gtsam_rwhec.problem.moments import Gauge
from gtsam_rwhec.problem.problem import Problem


class VarianceFactors(NamedTuple):
    """Factors of the stated variances of B's rotations and translations; 1 means that the noise is as stated."""

    rotation: float
    translation: float


AS_STATED = VarianceFactors(1.0, 1.0)


def of_moments(knowledge: Problem, pairs: Sequence[Pair], moments: MomentStack, gauge: Gauge) -> Problem:
    """A problem of moments alone, summed about a gauge, with the knowledge that another one has of their frames."""
    result = copy.copy(knowledge)
    result.keep_measurements = False
    result._kind = dict.fromkeys((pair.target for pair in pairs if not pair.is_motion), "target")
    result._kind |= dict.fromkeys((pair.sensor for pair in pairs), "sensor")
    result._kept = dict.fromkeys(pairs, KeptMeasurements())
    result._accumulator = Accumulator(gauge, {pair: Row(moments, e) for e, pair in enumerate(pairs)})
    result._take_knowledge(
        knowledge,
        frames=(knowledge.fixed.keys() | knowledge.priors.keys()) - result._kind.keys(),
        scales=knowledge.fixed_scales.keys() - {pair.target for pair in pairs},
    )
    return result


def summed_again(problem: Problem) -> Problem:
    """A copy whose sums have B's rotations: an unknown size needs them, and with known sizes they may be left out."""
    return problem.with_measurements({pair: problem.measurements(*pair) for pair in problem.pairs})


def selected(problem: Problem, keep: ByPair[ArrayLike]) -> Problem:
    """The problem with some of its measurements only.

    The masks ``keep`` (N,) are true for measurements that stay, in the order of ``problem.measurements``. Pairs without
    an entry stay whole. A CountError says which mask is not one boolean for each measurement; other errors are as in
    `reweighted`.
    """
    masks = {Pair(*pair): np.asarray(mask) for pair, mask in keep.items()}
    for pair, mask in masks.items():
        count = problem.moments(*pair).count
        if mask.shape != (count,) or mask.dtype != np.bool_:
            raise CountError(f"keep of {pair} has shape {mask.shape} of {mask.dtype}; give {count} booleans")
    return reweighted(problem, masks)


def without_copies(problem: Problem) -> Problem:
    """The problem with each measurement once: A and B that are another row's to the last bit were copied.

    Noise makes no two measurements alike, so a copy says nothing new; counted, it would make deviations smaller.
    """
    keep = {}
    for pair in problem.pairs if problem.has_measurements else ():
        raw = problem.measurements(*pair)
        keep[pair] = np.ones(len(raw.B), dtype=bool)
        if len(np.unique(raw.B[:, :3, 3].sum(axis=1))) < len(raw.B):  # else there are none, as one number tells sooner
            rows = np.concatenate([raw.A, raw.B], axis=1).reshape(len(raw.A), -1) + 0.0  # no -0.0
            first = np.unique(rows.view(f"V{rows.itemsize * rows.shape[1]}"), return_index=True)[1]
            keep[pair] = np.isin(np.arange(len(rows)), first)
    return problem if all(mask.all() for mask in keep.values()) else selected(problem, keep)


def reweighted(problem: Problem, weights: ByPair[ArrayLike], factors: VarianceFactors = AS_STATED) -> Problem:
    """The problem with each measurement's squared residual multiplied by a weight; the problem itself is not changed.

    A measurement of weight w > 0 gets sigma / sqrt(w) and w kappa; weight 0 leaves it out, and a pair without an entry
    keeps its ``weights`` (N,). Each kappa is divided by ``factors.rotation``, each sigma^2 multiplied by
    ``factors.translation``. Pairs and frames without a measurement left are not in the result.

    Raises
    ------
    MeasurementsNotKeptError
        The problem was made with ``keep_measurements=False``.
    FrameError, CountError, NoiseError
        The problem does not have a pair, weights have another count or are negative, or nothing is left.
    """
    for target, sensor in weights:
        problem.moments(target, sensor)
    if not all(np.isfinite(factor) and factor > 0.0 for factor in factors):
        raise NoiseError(f"{factors}: give variance factors that are positive and finite")
    edges: dict[Pair, Measurements] = {}
    for pair in problem.pairs:
        raw = problem.measurements(*pair)
        w = np.ones(len(raw.A))
        if pair in weights:
            w = np.asarray(weights[pair], dtype=np.float64)
            if w.shape != (len(raw.A),):
                raise CountError(f"weights of {pair} have shape {w.shape}; give {len(raw.A)}")
            if not (np.isfinite(w).all() and w.min() >= 0.0):
                raise NoiseError(f"weights of {pair} are not all finite and at least zero: {w.min():g}")
        positive = w > 0.0
        if positive.any():
            kept, w = (raw, w) if positive.all() else (raw.selected(positive), w[positive])
            edges[pair] = _weighed(kept, w, factors)
    return problem.with_measurements(edges)


def _weighed(raw: Measurements, w: np.ndarray, factors: VarianceFactors) -> Measurements:
    covariances = raw.covariances
    if covariances is not None:
        deviation = np.sqrt(np.repeat(factors, 3))
        covariances = scaled(covariances, slides_of(raw), deviation) / w[:, None, None]
    return replace(
        raw,
        sigma=raw.sigma * np.sqrt(factors.translation / w),
        kappa=raw.kappa * w / factors.rotation,
        covariances=covariances,
    )


def aligned_at(
    problem: Problem,
    X: Mapping[str, gtsam.Pose3],
    Y: Mapping[str, gtsam.Pose3],
    scale: float | Mapping[str, float] = 1.0,
) -> Problem:
    """The problem whose measurements that weigh by direction are slid to where an answer predicts them (`aligned`).

    The answer's cost stays the same. Pairs of frames that it lacks stay.
    """
    pairs = [pair for pair in problem.directed if (pair.target in X or pair.is_motion) and pair.sensor in Y]
    if not pairs:
        return problem
    every = {pair: problem.measurements(*pair) for pair in problem.pairs}
    for pair in pairs:
        of_target = (Y if pair.is_motion else X)[pair.target].matrix()
        alpha = scale_at(scale, pair.target)
        every[pair] = aligned(every[pair], of_target, Y[pair.sensor].matrix(), alpha)
    slid = problem.with_measurements(every)
    for name in dict.fromkeys(pair.target for pair in pairs if not pair.is_motion):
        own = [every[pair] for pair in problem.pairs if pair.target == name]
        if name not in problem.fixed and name not in problem.priors:
            slid.held = slid.held | {name: (X[name].matrix(), common_slides(own))}
    return slid


#: Two rotations belong to the same pose of an image if their entries differ by less than this.
SAME_POSE = 1e-3


def nearer_poses(
    problem: Problem,
    X: Mapping[str, gtsam.Pose3],
    Y: Mapping[str, gtsam.Pose3],
    cameras: Mapping[str, Camera] | None = None,
) -> tuple[Problem, int]:
    """The problem in which each image has the pose that is nearer to an answer's, and how many images changed.

    X and Y are the answer's T_targetcarrier_target and T_sensorcarrier_sensor. Measurements that were added as poses
    stay, and so do those of frames that the answer lacks. ``cameras`` are other intrinsics by sensor, by which the
    poses of all their images are computed; the problem's own stay as they were stated.
    """
    if not problem.boards or not problem.has_measurements:
        return problem, 0
    every = {pair: problem.measurements(*pair) for pair in problem.pairs}
    alike: dict[tuple[str, int], list[tuple[Pair, np.ndarray, Array]]] = {}  # of one camera and as many corners
    for pair, raw in every.items():
        if raw.pixels is not None and raw.covariances is not None and pair.target in X and pair.sensor in Y:
            rows = np.flatnonzero(np.isfinite(raw.pixels).any(axis=(1, 2)))
            alike.setdefault((pair.sensor, raw.pixels.shape[1]), []).append((pair, rows, raw.pixels[rows]))
    number = 0
    for (sensor, _), views in alike.items():
        camera = (cameras or {}).get(sensor)
        seen = [(problem.boards[pair.target], pixels, pair.label) for pair, _, pixels in views]
        found = candidates_of_each(camera or problem.cameras[sensor], seen, problem.corner_px or 0.1)
        for (pair, at, _), both in zip(views, found, strict=True):
            raw = every[pair]
            predicted = np.linalg.inv(Y[sensor].matrix()) @ raw.A[at] @ X[pair.target].matrix()
            T, covariance = both.chosen(both.nearer(predicted))
            changed = np.abs(T[:, :3, :3] - raw.B[at, :3, :3]).max(axis=(1, 2)) > SAME_POSE
            number += int(changed.sum())
            if camera is not None:
                changed[:] = True
            if changed.any():
                every[pair] = with_poses(raw, at[changed], T[changed], covariance[changed])
    return (problem.with_measurements(every), number) if number or cameras else (problem, 0)


def with_poses(raw: Measurements, rows: np.ndarray, T: Array, covariance: Array) -> Measurements:
    """Measurements with other poses and covariances in some rows."""
    assert raw.covariances is not None
    B, covariances = raw.B.copy(), raw.covariances.copy()
    B[rows], covariances[rows] = T, covariance
    spread = np.einsum("nii->ni", covariances)
    return replace(
        raw,
        B=B,
        sigma=np.sqrt(spread[:, 3:].mean(axis=1)),
        kappa=0.5 / spread[:, :3].mean(axis=1),
        covariances=covariances,
    )
