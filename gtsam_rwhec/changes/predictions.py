"""How far off the old poses' predictions of new measurements are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gtsam_rwhec.calibration.prediction_errors import PredictionError, prediction_errors
from gtsam_rwhec.changes.near_answer import NearAnswer
from gtsam_rwhec.changes.verification import SensorCheck
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.results.result_file import Result
from gtsam_rwhec.trajectories.trajectory import Trajectory

#: Predictions are far off from so many times the old log's residuals on, and from so much on.
FAR, LEAST_MM, LEAST_DEG = 10.0, 5.0, 0.5


def _at_offsets(problem: Problem, found: NearAnswer, path: Trajectory | None) -> Problem:
    """The measurements with A on the carriers' path at the time offsets that were found."""
    if path is None:
        return problem
    moved = {}
    for pair in problem.pairs:
        one = problem.measurements(*pair)
        offset_s = found.time_offsets_s.get(pair.sensor)
        if offset_s is not None and one.stamps_ns is not None:
            one = replace(one, A=path.at(one.stamps_ns + round(1e9 * offset_s))[0])
        moved[pair] = one
    return problem.with_measurements(moved)


def checks_of(
    result: Result, old: RefinedPoses, found: NearAnswer, problem: Problem, path: Trajectory | None
) -> dict[str, SensorCheck]:
    """By sensor, how well the old poses and the best ones predict what it saw."""
    problem = _at_offsets(problem, found, path)
    held = replace(old, time_offsets_s={} if path is not None else found.time_offsets_s)
    best = replace(held, X=found.X, Y=found.Y, scale=found.scale)
    checks = {}
    for sensor in problem.sensors:
        pairs = [pair for pair in problem.pairs if pair.sensor == sensor]
        errors = []
        for answer in (held, best):
            of_pairs = [
                prediction_errors(problem, answer, pair, problem.measurements(*pair))[:, found.inliers[pair]]
                for pair in pairs
            ]
            errors.append(PredictionError.of(*np.concatenate(of_pairs, axis=1)))
        before = _residual_m(result, sensor)
        checks[sensor] = SensorCheck(
            held=errors[0],
            best=errors[1],
            outliers=sum(int((~found.inliers[pair]).sum()) for pair in pairs),
            noise_ratio=None if before is None else 1e-3 * errors[1].translation_rms_mm / before,
        )
    return checks


def _residual_m(result: Result, sensor: str) -> float | None:
    """The root mean square of a sensor's residuals in the old log, m."""
    residuals = [residual for pair, residual in result.solution.residuals.items() if pair.sensor == sensor]
    count = sum(one.number_of_measurements for one in residuals)
    square = sum(one.number_of_measurements * one.translation_rms_m**2 for one in residuals)
    return float(np.sqrt(square / count)) if count and square > 0.0 else None


def far_off(result: Result, old: RefinedPoses, problem: Problem) -> dict[str, SensorCheck]:
    """The sensors whose new measurements are far off the old poses' predictions, whatever the noise is."""
    checks = {}
    for sensor in problem.sensors:
        pairs = [pair for pair in problem.pairs if pair.sensor == sensor]
        here = replace(old, time_offsets_s={})
        errors = [prediction_errors(problem, here, pair, problem.measurements(*pair)) for pair in pairs]
        held = PredictionError.of(*np.concatenate(errors, axis=1))
        residuals = [result.solution.residuals[pair] for pair in result.solution.residuals if pair.sensor == sensor]
        before_mm = 1e3 * max((one.translation_rms_m for one in residuals), default=0.0)
        before_deg = float(np.degrees(max((one.rotation_rms_rad for one in residuals), default=0.0)))
        is_far = held.translation_median_mm > max(FAR * before_mm, LEAST_MM)
        if is_far or held.rotation_median_deg > max(FAR * before_deg, LEAST_DEG):
            checks[sensor] = SensorCheck(held, None, 0, None)
    return checks
