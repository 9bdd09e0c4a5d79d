"""``verify``: whether an old calibration still holds on a new log, without calibrating anew."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from gtsam_rwhec.calibration.calibrated import Calibration
from gtsam_rwhec.changes.change_test import LEVEL, change_test, checked_level
from gtsam_rwhec.changes.comparing import as_result
from gtsam_rwhec.changes.constant_errors import without_constant_errors
from gtsam_rwhec.changes.near_answer import NearAnswer, near, stated_as
from gtsam_rwhec.changes.predictions import checks_of, far_off
from gtsam_rwhec.changes.quantities import Movement, Quantities, quantities
from gtsam_rwhec.changes.verification import UNSEEN_SENSOR, UNSEEN_TARGET, SensorCheck, Verification
from gtsam_rwhec.errors import CountError, FrameError, OptionError, UnderdeterminedError
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.files.terminal_text import shown
from gtsam_rwhec.fitting.fit_options import CarrierNoise, Component, NoiseOptions, RefineOptions
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.fitting.unknowns import UnknownKind
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.results.result_file import Result
from gtsam_rwhec.trajectories.trajectory import Trajectory

#: Residuals that are this many times those of the old log are told.
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
    if not isinstance(problem, Problem):
        raise OptionError(f"the problem is a {type(problem).__name__}; give a gtsam_rwhec.Problem")
    if result.refined is None:
        raise UnderdeterminedError(
            "the old calibration has no covariances, because it was not refined, so nothing can be tested; calibrate "
            "with rw.calibrate or gtsam-rwhec calibrate"
        )
    refined = without_constant_errors(result)
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
        found, common = _compared(
            refined, stated, how, _noise_options(carrier_noise, systematic=systematic), progress, targets_may_move
        )
    except (UnderdeterminedError, CountError) as error:
        far = {} if targets_may_move else far_off(result, refined, stated)
        if not far:
            raise
        return Verification(None, {}, far, _unseen(refined, stated, targets_may_move), targets_may_move, (str(error),))
    not_checked = _unseen(refined, stated, targets_may_move) | in_words(common)
    test = change_test(
        common.difference, common.covariances, common.free, common.groups,
        (refined.degrees_of_freedom, found.degrees_of_freedom), level,
    )  # fmt: skip
    movements = {
        name: Movement.of(pose, now[name])
        for poses, now in ((refined.Y, found.Y), (refined.X, found.X))
        for name, pose in poses.items()
        if name in now
    }
    checks = checks_of(result, refined, found, stated, carrier_path)
    return Verification(
        test=test,
        movements=movements,
        sensors=checks,
        not_checked=not_checked,
        targets_may_move=targets_may_move,
        remarks=tuple(_remarks(refined, problem, found, checks, targets_may_move=targets_may_move)),
    )


def _compared(
    old: RefinedPoses,
    problem: Problem,
    how: RefineOptions,
    noise: NoiseOptions,
    progress: Progress | None,
    targets_may_move: bool,
) -> tuple[NearAnswer, Quantities]:
    """What the new measurements say near the old poses, and what of it can be compared."""
    found = near(old, problem, how, noise, progress)
    common = quantities(old, found, {UnknownKind.TIME_OFFSET, UnknownKind.INTRINSICS})
    if targets_may_move:
        common = _of_sensors(common, old)
    if not common.slots:
        said = "; ".join(f"{shown(name)}: {why}" for name, why in in_words(common).items())
        raise UnderdeterminedError(f"nothing can be tested ({said}); move about two axes, and take more images")
    return found, common


def in_words(common: Quantities) -> dict[str, str]:
    """What is not compared, and why."""
    words = {"of OLD": "of the old log", "of NEW": "of the new log"}
    said = {}
    for unknown, why in common.not_compared.items():
        for name, other in words.items():
            why = why.replace(name, other)
        said[str(unknown)] = why
    return said


def _unseen(old: RefinedPoses, problem: Problem, targets_may_move: bool) -> dict[str, str]:
    """The frames of the old calibration that the new log has no measurement of."""
    unseen = {name: UNSEEN_SENSOR for name in old.Y if name not in problem.sensors}
    if not targets_may_move:
        unseen |= {name: UNSEEN_TARGET for name in old.X if name not in problem.targets}
    return unseen


def _noise_options(carrier: CarrierNoise | None, *, systematic: bool) -> NoiseOptions:
    stated: dict[Component, float] = {}
    if carrier is not None and carrier.covariances is None:
        stated = {
            Component.CARRIER_ROTATION: carrier.rotation_rad,
            Component.CARRIER_TRANSLATION: carrier.translation_m,
        }
        return NoiseOptions(stated=stated, systematic=systematic, side=carrier.about)
    return NoiseOptions(systematic=systematic)


def _of_sensors(common: Quantities, old: RefinedPoses) -> Quantities:
    """The quantities that are not of targets: these are unknown again."""
    kept = {unknown: rows for unknown, rows in common.slots.items() if unknown.owner in old.Y}
    rows = [row for place in kept.values() for row in range(place.start, place.stop)]
    slots, first = {}, 0
    for unknown, place in kept.items():
        slots[unknown] = slice(first, first + place.stop - place.start)
        first = slots[unknown].stop
    at = np.ix_(rows, rows)
    one, other = common.covariances
    not_compared = {unknown: why for unknown, why in common.not_compared.items() if unknown.owner in old.Y}
    return Quantities(common.difference[rows], (one[at], other[at]), common.free[rows], slots, not_compared)


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
