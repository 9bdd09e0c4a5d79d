"""How far measurements are from what a calibration predicts of them, in millimetres and degrees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Measurements
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.refinement.refined import Refined
from gtsam_rwhec.solving.solution import Solution
from gtsam_rwhec.trajectories.local_paths import LocalPaths


@dataclass(frozen=True)
class PredictionError:
    """How far predicted measurements are from the measured ones.

    Attributes
    ----------
    count : int
        Measurements that were predicted.
    translation_rms_mm, translation_median_mm, translation_95_mm : float
        Root mean square, median and 95th percentile of |t_measured / scale - t_predicted|, true millimetres; nan where
        nothing was predicted.
    rotation_rms_deg, rotation_median_deg, rotation_95_deg : float
        The same of the angle of R_measured' R_predicted.
    """

    count: int
    translation_rms_mm: float
    translation_median_mm: float
    translation_95_mm: float
    rotation_rms_deg: float
    rotation_median_deg: float
    rotation_95_deg: float

    @staticmethod
    def of(translation_m: Array, rotation_rad: Array) -> PredictionError:
        """Of errors one by one; nan is what was not predicted."""
        known = np.isfinite(translation_m)
        mm, deg = 1e3 * translation_m[known], np.degrees(rotation_rad[known])
        return PredictionError(len(mm), *_rms_median_95(mm), *_rms_median_95(deg))


@dataclass(frozen=True)
class HoldOutError:
    """Errors of measurements held out, and of the same measurements when the calibration has seen all.

    Attributes
    ----------
    held_out, training : PredictionError
        Far apart: too few measurements, or too many unknowns, for the noise. Both large: outliers, a wrong model
        (intrinsics, a size, a delay), or much noise.
    not_predicted : int
        Measurements of frames that the rest does not measure.
    """

    held_out: PredictionError
    training: PredictionError
    not_predicted: int


def prediction_errors(problem: Problem, answer: Solution | Refined, pair: Pair, one: Measurements) -> Array:
    """Of predictions of all of a pair's measurements, (2, N): in true metres and in radians; nan without a pose."""
    poses: dict[str, Array] = {name: pose.matrix() for name, pose in (answer.X | answer.Y).items()}
    poses = {**problem.fixed, **poses}
    scales = answer.scale
    scale = {**problem.fixed_scales, **scales}.get(pair.target) if isinstance(scales, Mapping) else scales
    if scale is None or any(name not in poses for name in pair):
        return np.full((2, len(one.A)), np.nan)
    A = one.A
    offset = getattr(answer, "time_offsets_s", {}).get(pair.sensor, 0.0)
    if offset and one.stamps_ns is not None:
        A = A @ LocalPaths.of(A, one.stamps_ns, pair.label).motion(offset)
    predicted = np.linalg.inv(poses[pair.sensor]) @ A @ poses[pair.target]
    translation = np.linalg.norm(one.B[:, :3, 3] / scale - predicted[:, :3, 3], axis=1)
    chord = np.linalg.norm(one.B[:, :3, :3] - predicted[:, :3, :3], axis=(1, 2))  # sqrt(8) sin(angle / 2)
    return np.stack([translation, 2.0 * np.arcsin(np.minimum(1.0, chord / np.sqrt(8.0)))])


def _rms_median_95(values: Array) -> tuple[float, float, float]:
    if len(values) == 0:
        return np.nan, np.nan, np.nan
    return (
        float(np.sqrt(np.mean(values**2))),
        float(np.median(values)),
        float(np.percentile(values, 95.0)),
    )
