"""Whether an old calibration still holds: the record, and its verdict in words."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.cross_validation import PredictionError, prediction_errors
from gtsam_rwhec.errors import CountError, FrameError, UnderdeterminedError
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.files.terminal_text import rounded, shown
from gtsam_rwhec.fitting.fit_options import CarrierNoise, Component, NoiseOptions, RefineOptions
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.fitting.unknowns import UnknownKind
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.real_numbers import check_kind
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.results.change_test import LEVEL, ChangeTest, change_test, checked_level
from gtsam_rwhec.results.changed_frames import (
    MADE_ANEW,
    as_result,
    movement_words,
    movements_of,
    objects_of,
    share_words,
    without_constant_errors,
)
from gtsam_rwhec.results.common_quantities import Movement, Quantities, quantities
from gtsam_rwhec.results.near_answer import NearAnswer, near, stated_as
from gtsam_rwhec.results.residual_evidence import pooled_residual
from gtsam_rwhec.results.result_file import Result

#: Why frames are not checked.
UNSEEN_SENSOR = "the new log has no measurement by it"
UNSEEN_TARGET = "the new log has no measurement of it"


@dataclass(frozen=True)
class SensorCheck:
    """How well the old poses predict what a sensor saw in the new log."""

    #: Errors of predictions by the old poses: what a robot that uses them is off by, with the noise of the measurements
    held: PredictionError
    #: Errors by the poses that fit the new log best: noise of the measurements. None where none near the old ones fit.
    best: PredictionError | None
    outliers: int  #: Measurements that agree with no others; they count in neither
    #: `best`'s root mean square translation over that of the old log's residuals; None where that has none
    noise_ratio: float | None
    #: Median distance of corners from where the old poses say that they are, pixels; None without images
    held_px: float | None = None


@dataclass(frozen=True)
class Verification:
    """Whether an old calibration still holds; ``str()`` is the verdict."""

    #: Test of the old poses against those that fit the new log best, by the sum of both covariances. None where the
    #: predictions are so far off that no test is needed, and none is possible.
    test: ChangeTest | None
    movements: dict[str, Movement]  #: From the old pose of each frame to the one that fits the new log best
    sensors: dict[str, SensorCheck]
    #: Sensors and targets of the old calibration that the new log tells nothing of, with the reason
    not_checked: dict[str, str]
    targets_may_move: bool  #: Whether targets were left out of the test
    remarks: tuple[str, ...]

    @property
    def holds(self) -> bool:
        """Whether there is no evidence against the old calibration."""
        return self.test is not None and not self.test.has_changed

    @property
    def unchecked_sensors(self) -> tuple[str, ...]:
        """The sensors of the old calibration that were not checked."""
        return tuple(name for name, why in self.not_checked.items() if why == UNSEEN_SENSOR or name in self.sensors)

    def __str__(self) -> str:
        unchecked = ", ".join(map(shown, self.unchecked_sensors))
        but = f" Not checked: {unchecked}." if unchecked else ""
        if self.test is None:
            said = "; ".join(
                f"what {shown(name)} sees is {rounded(check.held.translation_median_mm)} mm and "
                f"{rounded(check.held.rotation_median_deg)} degrees off its predictions"
                for name, check in self.sensors.items()
            )
            return f"The calibration no longer holds: {said}. Check also that A and B are read as before.{but}"
        level = f"{100.0 * self.test.level:g} %"
        if self.holds:
            return (
                f"The calibration still holds at {level}: the new log agrees with it as well as by chance in "
                f"{share_words(self.test.chance)}.{but}"
            )
        named = self.test.changed
        if not named:
            return (
                f"The calibration no longer holds, by more than chance at {level}. No frame stands out by itself.{but}"
            )
        said = "; ".join(map(self.sentence, named))
        return f"The calibration no longer holds: {said}, more than chance at {level}.{but}"

    def sentence(self, name: str) -> str:
        """How far a frame seems to have moved, in words, without a full stop."""
        if name in self.movements:
            return movement_words(name, self.movements[name], self.test)
        assert self.test is not None
        verb = "changed" if name in self.test.changed else "differs"
        return f"{shown(name)} {verb}: {self.test.groups[name].deviations:.1f} joint deviations"


#: Predictions are far off if they exceed this many times the old log's residuals, and these lengths and angles.
FAR, LEAST_MM, LEAST_DEG = 10.0, 5.0, 0.5


def _at_offsets(problem: Problem, offsets_s: Mapping[str, float], path: Trajectory) -> Problem:
    """The measurements with A on the carriers' path at these time offsets."""
    moved = {}
    for pair in problem.pairs:
        one = problem.measurements(*pair)
        if pair.sensor in offsets_s and one.stamps_ns is not None:
            one = replace(one, A=path.at(one.stamps_ns + round(1e9 * offsets_s[pair.sensor]))[0])
        moved[pair] = one
    return problem.with_measurements(moved)


def _predicted(
    problem: Problem, answer: RefinedPoses, sensor: str, inliers: Mapping[Pair, np.ndarray] | None = None
) -> PredictionError:
    """How well an answer predicts what a sensor measured; of some measurements, or of all."""
    errors = []
    for pair in problem.pairs:
        if pair.sensor == sensor:
            of_pair = prediction_errors(problem, answer, pair, problem.measurements(*pair))
            errors.append(of_pair if inliers is None else of_pair[:, inliers[pair]])
    return PredictionError.of(*np.concatenate(errors, axis=1))


def checks_of(
    result: Result, old: RefinedPoses, found: NearAnswer, problem: Problem, path: Trajectory | None
) -> dict[str, SensorCheck]:
    """By sensor, how well the old poses and the best ones predict what it saw."""
    offsets_s = found.refined.time_offsets_s
    if path is not None:
        problem, offsets_s = _at_offsets(problem, offsets_s, path), {}
    answers = [replace(each, time_offsets_s=offsets_s) for each in (old, found.refined)]
    checks = {}
    for sensor in problem.sensors:
        held, best = (_predicted(problem, answer, sensor, found.inliers) for answer in answers)
        outliers = sum(int((~inliers).sum()) for pair, inliers in found.inliers.items() if pair.sensor == sensor)
        before = _residual_m(result, sensor)
        ratio = None if before is None else 1e-3 * best.translation_rms_mm / before
        checks[sensor] = SensorCheck(held, best, outliers, ratio)
    return checks


def _residual_m(result: Result, sensor: str) -> float | None:
    """The root mean square of a sensor's residuals in the old log, m."""
    of_sensor = (residual for pair, residual in result.solution.residuals.items() if pair.sensor == sensor)
    rms_m = pooled_residual(of_sensor).translation_rms_m
    return rms_m if rms_m > 0.0 else None


def far_off(result: Result, old: RefinedPoses, problem: Problem) -> dict[str, SensorCheck]:
    """The sensors whose new measurements are far off the old poses' predictions, whatever the noise is."""
    checks = {}
    for sensor in problem.sensors:
        held = _predicted(problem, replace(old, time_offsets_s={}), sensor)
        residuals = [result.solution.residuals[pair] for pair in result.solution.residuals if pair.sensor == sensor]
        before_mm = 1e3 * max((one.translation_rms_m for one in residuals), default=0.0)
        before_deg = float(np.degrees(max((one.rotation_rms_rad for one in residuals), default=0.0)))
        is_far = held.translation_median_mm > max(FAR * before_mm, LEAST_MM)
        if is_far or held.rotation_median_deg > max(FAR * before_deg, LEAST_DEG):
            checks[sensor] = SensorCheck(held, None, 0, None)
    return checks


#: Residuals that are this many times those of the old log are reported.
NOISIER = 2.0


@one_blas_thread()
def verify(
    old: Result | Calibration,
    problem: Problem,
    *,
    level: float = LEVEL,
    targets_may_move: bool = False,
    systematic: bool = True,
    carrier_noise: CarrierNoise | None = None,
    time_offsets: Collection[str] = (),
    carrier_path: Trajectory | None = None,
    progress: Progress | None = None,
) -> Verification:
    """Whether an old calibration still holds on new measurements, without calibrating anew.

    The noise of the new measurements is found, and from the old poses on the poses that fit them best. The difference
    is tested against the sum of both covariances, as `difference` does. What the new log leaves free is not tested, so
    that a short log is enough for what it shows.

    Parameters
    ----------
    old : Result (``rw.results.read_result``) or Calibration
    problem : Problem
        The new measurements, with raw poses.
    level : float
        How often it may say that the calibration no longer holds where nothing changed.
    targets_may_move : bool
        The targets may stand elsewhere than before: only sensors are tested, and need a motion that tells their poses
        without the targets'.
    systematic : bool
        Whether A may have errors that vary with the configuration, as arms have.
    carrier_noise : CarrierNoise, optional
        The noise of A, where it is known.
    time_offsets : names of sensors, optional
        Sensors whose clock may be off: their time offset is free.
    carrier_path : Trajectory, optional
        The carriers' path, for time offsets.
    progress : callable, optional

    Raises
    ------
    FrameError
        The new measurements have no pair of frames that the old calibration has.
    UnderdeterminedError
        The old calibration has no covariances, or nothing that the new log determines can be compared.
    CountError
        There are too few measurements to tell their noise.
    """
    checked_level(level)
    result = as_result(old)
    check_kind(problem, Problem, "the problem", "a gtsam_rwhec.Problem")
    if result.refined is None:
        raise UnderdeterminedError(
            "the old calibration has no covariances, because it was not refined, so nothing can be tested; calibrate "
            "with rw.calibrate or gtsam-rwhec calibrate"
        )
    refined, made_anew = without_constant_errors(result), objects_of(result)
    problem.require_pairs()
    problem.require_raw_measurements("verify")
    stated = stated_as(refined, problem)
    if not stated.pairs:
        raise FrameError(
            f"the new measurements are of {', '.join(map(shown, (*problem.targets, *problem.sensors)))}, the old "
            f"calibration of {', '.join(map(shown, (*refined.X, *refined.Y)))}: no target and sensor of "
            "one pair are in both"
        )
    how = RefineOptions(
        noise="estimate", time_offsets=tuple(time_offsets) or False, carrier_path=carrier_path if time_offsets else None
    )
    try:
        found = near(refined, stated, how, _noise_options(carrier_noise, systematic=systematic), progress)
        common = quantities(refined, found.refined, {UnknownKind.TIME_OFFSET, UnknownKind.INTRINSICS})
        common = common.only(lambda unknown: unknown.owner not in made_anew)
        if targets_may_move:
            common = common.only(lambda unknown: unknown.owner in refined.Y)
        if not common.slots:
            said = "; ".join(f"{shown(name)}: {why}" for name, why in in_words(common).items())
            raise UnderdeterminedError(f"nothing can be tested ({said}); move about two axes, and take more images")
    except (UnderdeterminedError, CountError) as error:
        far = {} if targets_may_move or made_anew else far_off(result, refined, stated)
        if not far:
            raise
        return Verification(None, {}, far, _unseen(refined, stated, targets_may_move), targets_may_move, (str(error),))
    not_checked = _unseen(refined, stated, targets_may_move) | in_words(common)
    not_checked |= dict.fromkeys(sorted(made_anew), MADE_ANEW)
    test = change_test(
        common.difference, common.covariances, common.free, common.groups,
        (refined.degrees_of_freedom, found.degrees_of_freedom), level,
    )  # fmt: skip
    # An object's old pose predicts nothing of a new one.
    checks = {} if made_anew else checks_of(result, refined, found, stated, carrier_path)
    return Verification(
        test=test,
        movements={name: m for name, m in movements_of(refined, found.refined).items() if name not in made_anew},
        sensors=checks,
        not_checked=not_checked,
        targets_may_move=targets_may_move,
        remarks=tuple(_remarks(refined, problem, found, checks, targets_may_move=targets_may_move)),
    )


def in_words(common: Quantities) -> dict[str, str]:
    """What is not compared, and why."""
    return {
        str(unknown): why.replace("of OLD", "of the old log").replace("of NEW", "of the new log")
        for unknown, why in common.not_compared.items()
    }


def _unseen(old: RefinedPoses, problem: Problem, targets_may_move: bool) -> dict[str, str]:
    """The frames of the old calibration that the new log has no measurement of."""
    unseen = {name: UNSEEN_SENSOR for name in old.Y if name not in problem.sensors}
    if not targets_may_move:
        unseen |= {name: UNSEEN_TARGET for name in old.X if name not in problem.targets}
    return unseen


def _noise_options(carrier: CarrierNoise | None, *, systematic: bool) -> NoiseOptions:
    if carrier is None or carrier.covariances is not None:
        return NoiseOptions(systematic=systematic)
    stated = {Component.CARRIER_ROTATION: carrier.rotation_rad, Component.CARRIER_TRANSLATION: carrier.translation_m}
    return NoiseOptions(stated=stated, systematic=systematic, side=carrier.about)


def _remarks(
    old: RefinedPoses, problem: Problem, found: NearAnswer, checks: dict[str, SensorCheck], *, targets_may_move: bool
) -> list[str]:
    remarks = []
    strangers = [name for name in (*problem.sensors, *problem.targets) if name not in old.X and name not in old.Y]
    if strangers:
        remarks.append(
            f"the old calibration has no {', '.join(map(shown, strangers))}; their measurements do not count"
        )
    remarks += [f"the new log leaves free: {direction}" for direction in found.free]
    remarks += [f"the old calibration leaves free: {direction}" for direction in old.free_directions]
    for name, check in checks.items():
        if check.noise_ratio is not None and check.noise_ratio > NOISIER:
            remarks.append(
                f"what {shown(name)} measures scatters {check.noise_ratio:.1f} times as much as in the old log, "
                "whatever its pose: look for a loose mount, blur, another exposure, or targets that are farther away"
            )
        if check.outliers:
            remarks.append(f"{check.outliers} measurements of {shown(name)} agree with no others, and do not count")
    if targets_may_move:
        remarks.append("the targets may stand elsewhere than before: their poses are not tested")
    return remarks
