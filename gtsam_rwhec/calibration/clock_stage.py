"""The stage of clocks: the answer with the time offsets that stamps and motion determine."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from gtsam_rwhec.calibration.clocks import NO_STAMPS, Clock, offsets_worth_estimating
from gtsam_rwhec.calibration.noise_choice import Inliers, offsets_of
from gtsam_rwhec.calibration.noise_found import NOT_KNOWN, NoiseFound
from gtsam_rwhec.calibration.noise_stage import refined_under_its_noise
from gtsam_rwhec.calibration.outlier_stage import say_outliers, without_outliers
from gtsam_rwhec.calibration.run import Run
from gtsam_rwhec.calibration.verdict import Ground
from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.problem.selection import selected
from gtsam_rwhec.solving.solution import Solution

#: A time offset of so many standard deviations explains rows that look shifted.
SURELY = 5.0
#: A clock that was taken as right moves poses by millimetres and more if it is off by more than this, s.
LATE_S = 0.005
#: Where more than this share of a sensor's measurements are outliers, its clock may have made them.
MANY_LEFT_OUT = 0.25
WHAT = "time offsets"


@dataclass(frozen=True)
class Answer:
    """The certified solution of the inliers, the inliers, their refined calibration, and the noise that was found."""

    solution: Solution | None
    inliers: Inliers = field(default_factory=dict)
    refined: Refined | None = None
    noise: NoiseFound = NOT_KNOWN

    @property
    def time_offsets_s(self) -> dict[str, float]:
        """By sensor; empty where none was estimated."""
        return {} if self.refined is None else self.refined.time_offsets_s


def check_offsets(run: Run) -> None:
    """An OptionError for time offsets that are asked of no sensor."""
    given = run.options.time_offsets
    if isinstance(given, tuple):
        unknown = [name for name in given if name not in run.problem.sensors]
        if unknown:
            raise OptionError(
                f"CalibrateOptions.time_offsets names {unknown[0]!r}, which is not a sensor; give any of "
                f"{', '.join(run.problem.sensors)}"
            )


def answer(run: Run, first: Solution | None) -> Answer:
    """The answer without outliers, with the time offsets that stamps and motion determine, or that options say.

    ``first`` is the certified solution of all measurements.
    """
    return _by_the_data(run, first) if run.options.time_offsets == "auto" else _by_option(run, first)


def late_in_place_of_shifted(run: Run, first: Solution | None) -> Answer | None:
    """The answer where a late clock explains rows that look shifted; None where it does not."""
    if run.options.time_offsets != "auto":
        return None
    attempt = run.attempt()
    found = answer(attempt, first)
    if found.refined is None or not any(_is_late(found.refined, name) for name in found.time_offsets_s):
        return None
    chosen = "rows of A and B look shifted against each other, and a time offset is estimated in place of that"
    run.record.choose("reading of A and B", "as given", f"{chosen}, since there are stamps")
    run.record.take(attempt.record)
    return found


def _by_option(run: Run, first: Solution | None) -> Answer:
    found = _with_offsets(run, first)
    asked = offsets_of(run.problem, run.options)
    run.record.choose(WHAT, "estimated" if asked else "not estimated", "an option says so")
    if found.refined is not None:
        _doubt_stated_clocks(run, _stated_clocks(run, found))
    return found


def _by_the_data(run: Run, first: Solution | None) -> Answer:
    """Clocks are looked at before outliers are, and again without the outliers."""
    before = _clocks(run, first, {})
    attempt = run.attempt()
    found = _with_offsets(attempt, first, _worth_estimating(before), before)
    if found.solution is None or found.refined is None:
        run.record.take(attempt.record)
        run.record.choose(WHAT, "not estimated", "there are no residuals to test")
        return found
    after = _clocks(run, found.solution, found.inliers)
    worth = _worth_estimating(after)
    known = [name for name in worth if _is_known(found.refined, name)]
    new = [name for name in worth if name not in found.time_offsets_s]
    if new or len(known) != len(found.time_offsets_s):
        # Outliers had hidden what the motion tells, or the motion of what is left tells less.
        attempt = run.attempt()
        found = _with_offsets(attempt, first, (*known, *new), after)
    run.record.take(attempt.record)
    names = ", ".join(found.time_offsets_s)
    chosen = f"estimated for {names}" if names else "not estimated"
    run.record.choose(WHAT, chosen, _evidence(after))
    return found


def _with_offsets(
    run: Run, first: Solution | None, offsets: tuple[str, ...] | None = None, clocks: tuple[Clock, ...] = ()
) -> Answer:
    """The answer with the time offsets of the named sensors, or of those that the options say."""
    clearly_off = tuple(clock.sensor for clock in clocks if clock.is_clearly_off)
    solution, inliers = without_outliers(run, first, clearly_off)
    if solution is None:
        return Answer(None, inliers)
    told = run if offsets is None else run.with_time_offsets(offsets)
    refined, noise, solution, inliers = refined_under_its_noise(told, solution, inliers)
    say_outliers(run, inliers)
    return Answer(solution, inliers, refined, noise)


def _clocks(run: Run, solution: Solution | None, inliers: Inliers) -> tuple[Clock, ...]:
    if solution is None:
        return ()
    kept = selected(run.problem, inliers) if inliers else run.problem
    return offsets_worth_estimating(kept, solution, run.options.carrier_path)


def _evidence(clocks: tuple[Clock, ...]) -> str:
    """The evidence of all clocks; what is true of several is said once."""
    sensors: dict[str, list[str]] = {}
    for clock in clocks:
        sensors.setdefault(clock.evidence, []).append(clock.sensor)
    if set(sensors) == {NO_STAMPS}:
        return "the measurements have no stamps"
    return "; ".join(f"{', '.join(names)}: {evidence}" for evidence, names in sensors.items())


def _stated_clocks(run: Run, found: Answer) -> tuple[Clock, ...]:
    """The clocks that were taken as right, by the measurements that agree.

    A late clock makes outliers of what moves. So where many of a sensor's were left out, all of them are asked too.
    """
    stated = [name for name in run.problem.sensors if name not in found.time_offsets_s]
    if not stated:
        return ()
    clocks = {clock.sensor: clock for clock in _clocks(run, found.solution, found.inliers)}
    of_sensor = {
        name: np.concatenate([mask for pair, mask in found.inliers.items() if pair.sensor == name])
        for name in stated
        if found.inliers
    }
    many = [name for name, kept in of_sensor.items() if np.mean(~kept) > MANY_LEFT_OUT]
    if many:
        clocks |= {clock.sensor: clock for clock in _clocks(run, found.solution, {}) if clock.sensor in many}
    return tuple(clocks[name] for name in stated if name in clocks)


def _doubt_stated_clocks(run: Run, clocks: tuple[Clock, ...]) -> None:
    """Clocks that were taken as right, and that the motion contradicts."""
    for clock in clocks:
        if clock.is_clearly_off and clock.offset_s is not None:
            ground = Ground.LATE_CLOCK if abs(clock.offset_s) > LATE_S else Ground.COVARIANCE_DOUBTED
            run.record.find(ground, f"the clock of {clock.sensor} was taken as right, but {clock.evidence}")


def _worth_estimating(clocks: tuple[Clock, ...]) -> tuple[str, ...]:
    return tuple(clock.sensor for clock in clocks if clock.is_worth_estimating)


def _is_known(refined: Refined, sensor: str) -> bool:
    """Whether the answer has the sensor, and determines its time offset."""
    offset = Unknown(UnknownKind.TIME_OFFSET, sensor)
    return sensor in refined.time_offsets_s and bool(np.isfinite(refined.covariance(offset)).all())


def _is_late(refined: Refined, sensor: str) -> bool:
    """Whether the sensor's time offset is surely not zero."""
    variance = float(refined.covariance(Unknown(UnknownKind.TIME_OFFSET, sensor))[0, 0])
    return abs(refined.time_offsets_s[sensor]) > SURELY * math.sqrt(variance)
