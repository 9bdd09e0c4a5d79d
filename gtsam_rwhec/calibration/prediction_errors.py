"""Prediction errors: the distances of measurements from a calibration's predictions, in millimetres and degrees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Measurements
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solving.solution import Solution
from gtsam_rwhec.trajectories.local_paths import LocalPaths


@dataclass(frozen=True)
class PredictionError:
    """The distance of predicted measurements from the measured ones.

    Attributes
    ----------
    count : int
        Number of predicted measurements.
    translation_rms_mm, translation_median_mm, translation_95_mm : float
        Root mean square, median and 95th percentile of |t_measured / scale - t_predicted|, true millimetres; nan if
        no measurement was predicted.
    rotation_rms_deg, rotation_median_deg, rotation_95_deg : float
        Root mean square, median and 95th percentile of the angle of R_measured' R_predicted, degrees.
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
        """The statistics of single errors; nan marks a measurement that was not predicted."""
        known = np.isfinite(translation_m)
        mm, deg = 1e3 * translation_m[known], np.degrees(rotation_rad[known])
        return PredictionError(len(mm), *_rms_median_95(mm), *_rms_median_95(deg))


@dataclass(frozen=True)
class HoldOutError:
    """The errors of held-out measurements, and of the same measurements with a calibration from all measurements.

    Attributes
    ----------
    held_out, training : PredictionError
        If the two differ much, there are too few measurements, or too many unknowns, for the noise. If both are large,
        there are outliers, a wrong model (intrinsics, a size, a delay), or much noise.
    not_predicted : int
        Number of measurements of frames that the other measurements do not determine.
    """

    held_out: PredictionError
    training: PredictionError
    not_predicted: int


def prediction_errors(problem: Problem, answer: Solution | RefinedPoses, pair: Pair, one: Measurements) -> Array:
    """The errors (2, N) of a pair's predicted measurements, in true metres and radians; nan if a pose is not known."""
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
    return float(np.sqrt(np.mean(values**2))), float(np.median(values)), float(np.percentile(values, 95.0))
