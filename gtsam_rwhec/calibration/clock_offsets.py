"""Clock offsets: which of them stamps and motion determine, and the answer with these offsets estimated.

One Gauss-Newton step, whose unknowns are the offset, the sensor's pose, its targets' poses and a scale, gives a first
estimate of the offset and its standard deviation. It is not worth estimating where the carriers' path between the
stamps is not known: they stood still, or the poses are stations, and what lies between them is not in the data.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.special import chdtri, stdtrit

from gtsam_rwhec.calibration.calibrate_options import Inliers, Run, agreeing, offsets_of
from gtsam_rwhec.calibration.noise_choice import NOT_KNOWN, NoiseFound, refined_under_its_noise
from gtsam_rwhec.calibration.outliers import say_outliers, without_outliers
from gtsam_rwhec.calibration.verdict import Ground
from gtsam_rwhec.errors import CountError, OptionError
from gtsam_rwhec.files.terminal_text import some
from gtsam_rwhec.fitting.fit_options import RefineOptions
from gtsam_rwhec.fitting.pair_data import PairData, local_paths
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.trajectory import WINDOW_S, LocalPaths, Trajectory
from gtsam_rwhec.problem.knowledge import scale_at
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.solution import Solution

#: An offset whose standard deviation (s) would be larger is not estimated: a camera's frame interval is about as long.
LARGEST_SIGMA_S = 0.02
#: The largest share of the carriers' squared velocity that may be error (noise, or interpolation between distant
#: poses).
LARGEST_UNKNOWN_SHARE = 0.05
#: With fewer stamps no offset is estimated: it could not be checked.
FEWEST_STAMPS = 10
#: Why the offset of a sensor without stamps is not estimated.
NO_STAMPS = "its measurements have no stamps"
#: At most this many targets of a sensor are looked at, those with most measurements.
MOST_TARGETS = 40
#: An offset of more standard deviations than this is clearly not zero.
CLEARLY = 4.0
#: Residuals beyond this many standard deviations are left out.
GROSS_SIGMAS = 4.5
#: Number of time blocks with equal information; the scatter of their estimates gives a second standard deviation.
BLOCKS_OF_TIME = 8


@dataclass(frozen=True)
class Clock:
    """What the data say about one sensor's clock; ``str()`` is one sentence."""

    sensor: str
    is_worth_estimating: bool
    evidence: str  #: Why, in words
    #: A first estimate of the offset, one step from the certified solution, and its standard deviation
    offset_s: float | None = None
    sigma_s: float | None = None
    #: Whether a path of the carriers was given to tell the clock by, and it has no velocity at most of the stamps
    is_unchecked: bool = False

    @property
    def is_clearly_off(self) -> bool:
        """Whether the offset is worth estimating, and zero is not among its likely values."""
        if not self.is_worth_estimating or self.offset_s is None or self.sigma_s is None:
            return False
        return abs(self.offset_s) > CLEARLY * self.sigma_s

    def __str__(self) -> str:
        chosen = "is estimated" if self.is_worth_estimating else "is taken as right"
        return f"The clock of {self.sensor} {chosen}, because {self.evidence}."


def offsets_worth_estimating(
    problem: Problem, solution: Solution, carrier_path: Trajectory | None = None
) -> tuple[Clock, ...]:
    """For each sensor, whether its clock's offset is worth estimating, and why.

    Parameters
    ----------
    problem : Problem
        Measurements as they were paired. Those with stamps on the carriers' clock may have an offset.
    solution : Solution
        The certified solution of this problem, or of its inliers.
    carrier_path : Trajectory, optional
        T_sensorcarrier_targetcarrier over time, logged faster than the measurements were made. Without it the
        measurements' own A give the path.

    Returns
    -------
    tuple of Clock
        In the order of ``problem.sensors``.
    """
    return tuple(_clock_of(sensor, problem, solution, carrier_path) for sensor in problem.sensors)


def _clock_of(sensor: str, problem: Problem, solution: Solution, carrier_path: Trajectory | None) -> Clock:
    pairs = sorted(
        (pair for pair in problem.pairs if pair.sensor == sensor), key=lambda pair: -problem.moments(*pair).count
    )[:MOST_TARGETS]

    def right(why: str, offset_s: float | None = None, sigma_s: float | None = None) -> Clock:
        return Clock(sensor, False, why, offset_s, sigma_s)

    if not problem.has_measurements:
        return right("the raw measurements were not kept")
    if any(pair.is_motion for pair in pairs):
        return right("its measurements are motions between two stamps, for which no offset is modelled")
    own = [raw for pair in pairs if (raw := problem.measurements(*pair).stamps_ns) is not None]
    if len(own) < len(pairs):
        return right(NO_STAMPS)
    stamps = np.unique(np.concatenate(own))
    if len(stamps) < FEWEST_STAMPS:
        return right(f"{len(stamps)} stamps are too few for an offset")
    if not all(name in solution.X for name, _ in pairs) or sensor not in solution.Y:
        return right("it is not in the certified solution")
    apart_s = float(np.median(np.diff(stamps))) * 1e-9
    try:
        paths = local_paths(problem, (sensor,), carrier_path)
    except CountError as error:
        # Between stations without a path this is usual: a late clock is then noise, which is estimated, as it is
        # without stamps. Whoever gives a path wants the clock told by it.
        why = f"the carriers' path about its stamps is not known ({apart_s:.2g} s apart): {error}"
        return Clock(sensor, is_worth_estimating=False, evidence=why, is_unchecked=carrier_path is not None)
    unknown = _unknown_share(paths)
    if unknown > LARGEST_UNKNOWN_SHARE:
        help_ = "" if carrier_path is not None else " (a path that was logged faster would tell: carrier_path)"
        return right(
            f"the carriers stood still, or how they moved between stamps {apart_s:.2g} s apart is not known{help_}"
        )
    options = RefineOptions(time_offsets=(sensor,), carrier_path=carrier_path)
    data = [PairData.of(problem, pair, options, paths[pair]) for pair in pairs]
    offset_s, sigma_s = _one_step(data, *_rows_of(data, solution, frozenset(problem.fixed_scales)))
    # An error of the velocities scales the offset.
    sigma_s = float(np.hypot(sigma_s, unknown * offset_s))
    about = f"motion tells it to +-{1e3 * sigma_s:.2g} ms"
    if not sigma_s <= LARGEST_SIGMA_S:
        return right(f"{about} only", offset_s, sigma_s)
    if abs(offset_s) > WINDOW_S:
        return right(
            f"the offset would be {offset_s:+.2g} s, and beyond {WINDOW_S:g} s the path is not linear enough; find it "
            "with cleaning.estimate_time_offset, and pair A and B again",
            offset_s,
            sigma_s,
        )
    return Clock(sensor, True, f"{about}, and it is about {1e3 * offset_s:+.3g} ms", offset_s, sigma_s)


def _unknown_share(paths: dict[Pair, LocalPaths]) -> float:
    """The share of the squared velocity that is error: of the angular or the linear one, whichever is smaller."""
    squares, error = np.zeros(2), np.zeros(2)
    for path in paths.values():
        squares += (path.twists() ** 2).sum(axis=0).reshape(2, 3).sum(axis=1)
        error += path.known.sum() * path.velocity_variance.reshape(2, 3).sum(axis=1)
    return float(np.min(error / np.maximum(squares, 1e-18)))


def _one_step(data: list[PairData], r_0: Array, all_J: Array) -> tuple[float, float]:
    """One step of Gauss-Newton from the certified solution: the offset, and its standard deviation, s."""
    good, r = np.ones(len(r_0), dtype=bool), r_0
    for _ in range(3):
        squares = (r**2).reshape(-1, 2, 3).sum(axis=2)
        variance = np.maximum(np.median(squares[good], axis=0) / chdtri(3, 0.5), 1e-24)
        good = (squares / variance).max(axis=1) < 3.0 * GROSS_SIGMAS**2
        weight = np.repeat(1.0 / variance, 3)
        J = all_J[good]
        H = np.einsum("nip,i,niq->pq", J, weight, J)
        unit = np.sqrt(np.maximum(np.diagonal(H), 1e-300))
        inverse = np.linalg.pinv(H / unit[:, None] / unit, rcond=1e-10, hermitian=True) / unit[:, None] / unit
        step = -inverse @ np.einsum("nip,i,ni->p", J, weight, r_0[good])
        r = r_0 + all_J @ step
    if not inverse[0, 0] > 0.0:
        return float(step[0]), np.inf
    g = all_J @ (inverse[:, 0] / inverse[0, 0])  # the offset, with all else following
    information = np.where(good, np.einsum("ni,i,ni->n", g, weight, g), 0.0)
    scores = np.where(good, np.einsum("ni,i,ni->n", g, weight, r), 0.0)
    stamps_ns = np.concatenate([item.stamps_ns for item in data if item.stamps_ns is not None])
    order = np.argsort(stamps_ns, kind="stable")
    share = np.cumsum(information[order]) / max(float(information.sum()), 1e-300)
    block = np.minimum((share * BLOCKS_OF_TIME).astype(int), BLOCKS_OF_TIME - 1)
    filled = max(len(np.unique(block)), 2)
    scatter = np.sqrt(float((np.bincount(block, scores[order], BLOCKS_OF_TIME) ** 2).sum()) * filled / (filled - 1))
    scatter *= float(stdtrit(filled - 1, 0.975)) / 1.96
    total = float(information.sum())
    return float(step[0]), max(np.sqrt(total), scatter) / max(total, 1e-300)


def _rows_of(data: list[PairData], solution: Solution, fixed_scales: frozenset[str]) -> tuple[Array, Array]:
    """Residuals (N, 6) of a sensor and their derivatives (N, 6, p): by the offset, Y, each X, each scale."""
    targets = list(dict.fromkeys(item.pair.target for item in data))
    owners = [] if solution.scale_mode == "known" else [name for name in targets if name not in fixed_scales]
    first, step = 7 + 6 * len(targets), int(solution.scale_mode == "per_target")
    column_of = {name: first + i * step for i, name in enumerate(owners)}
    r, J = [], []
    for item in data:
        target, sensor = item.pair
        scale = 1.0
        if target in column_of:
            scale = scale_at(solution.scale, target)
        at = item.residuals.linearize(solution.X[target].matrix(), solution.Y[sensor].matrix(), scale)
        own = np.zeros((item.count, 6, max(column_of.values(), default=first - 1) + 1))
        own[:, :, 0] = at.offset
        own[:, :, 1:7] = at.sensor
        k = 7 + 6 * targets.index(target)
        own[:, :, k : k + 6] = at.target
        if target in column_of:
            own[:, :, column_of[target]] = at.scale
        r.append(at.residual)
        J.append(own)
    return np.concatenate(r), np.concatenate(J)


#: A time offset of at least so many standard deviations explains rows that look shifted.
LATE_SIGMAS = 5.0
#: A clock error above this (s) that is not estimated moves poses by millimetres or more.
LATE_S = 0.005
#: If more than this share of a sensor's measurements are outliers, a clock error may be the cause.
MANY_LEFT_OUT = 0.25
TIME_OFFSETS = "time offsets"


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
    """Raise an OptionError if time offsets are asked for a sensor that the problem does not have."""
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
    """The answer with time offsets, if a late clock explains rows that look shifted; else None."""
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
    chosen = f"estimated for {', '.join(found.time_offsets_s)}" if asked and found.time_offsets_s else "not estimated"
    run.record.choose(TIME_OFFSETS, chosen, run.says_so + _without_velocity(run, found))
    if found.refined is not None:
        _doubt_stated_clocks(run, found)
    return found


def _by_the_data(run: Run, first: Solution | None) -> Answer:
    """Choose the clocks to estimate from all measurements, and choose again without the outliers."""
    before = _clocks(run, first, {})
    attempt = run.attempt()
    found = _with_offsets(attempt, first, _worth_estimating(before), before)
    if found.solution is None or found.refined is None:
        run.record.take(attempt.record)
        run.record.choose(TIME_OFFSETS, "not estimated", "there are no residuals to test")
        return found
    after = _clocks(run, found.solution, found.inliers)
    worth = _worth_estimating(after)
    known = [name for name in worth if _is_known(found.refined, name)]
    new = [name for name in worth if name not in found.time_offsets_s]
    if new or len(known) != len(found.time_offsets_s):
        # Outliers hid an offset, or the measurements that are left do not determine one.
        attempt = run.attempt()
        found = _with_offsets(attempt, first, (*known, *new), after)
    run.record.take(attempt.record)
    names = ", ".join(found.time_offsets_s)
    chosen = f"estimated for {names}" if names else "not estimated"
    run.record.choose(TIME_OFFSETS, chosen, _evidence(after) + _without_velocity(run, found))
    _say_unchecked(run, after)
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
    return offsets_worth_estimating(agreeing(run.problem, inliers), solution, run.options.carrier_path)


def _evidence(clocks: tuple[Clock, ...]) -> str:
    """The evidence of all clocks; evidence that several share is given once."""
    sensors: dict[str, list[str]] = {}
    for clock in clocks:
        sensors.setdefault(clock.evidence, []).append(clock.sensor)
    if set(sensors) == {NO_STAMPS}:
        return NO_STAMPS.replace("its", "the")
    return "; ".join(f"{', '.join(names)}: {evidence}" for evidence, names in sensors.items())


#: So many measurements are named by their stamps.
NAMED = 5


def _without_velocity(run: Run, found: Answer) -> str:
    """How many measurements count without a term of their clock, and which; empty where none does."""
    sensors = tuple(found.time_offsets_s)
    kept = agreeing(run.problem, found.inliers)
    paths = local_paths(kept, sensors, run.options.carrier_path)
    where = []
    for pair, path in paths.items():
        stamps_ns = kept.measurements(*pair).stamps_ns
        if stamps_ns is not None:
            where += [f"{pair} at {stamp} ns" for stamp in stamps_ns[~path.known].tolist()]
    if not where:
        return ""
    total = sum(len(path.known) for path in paths.values())
    return (
        f"; beside gaps in the carriers' path no velocity is known, so {len(where)} of {total} measurements count as "
        f"they are paired, without an offset ({some(where, NAMED)})"
    )


def _say_unchecked(run: Run, clocks: tuple[Clock, ...]) -> None:
    """Record a finding for each clock that a path of the carriers was given for, and that could not be checked."""
    for clock in clocks:
        if clock.is_unchecked:
            words = f"the clock of {clock.sensor} could not be checked: {clock.evidence}"
            run.record.find(Ground.NOT_CHECKED, words)


def _doubt_stated_clocks(run: Run, found: Answer) -> None:
    """Record a finding for each clock that was taken as right, although the measurements that agree contradict it.

    A late clock makes outliers while carriers move. So where many measurements of a sensor are outliers, all of its
    measurements are used.
    """
    stated = [name for name in run.problem.sensors if name not in found.time_offsets_s]
    if not stated:
        return
    clocks = {clock.sensor: clock for clock in _clocks(run, found.solution, found.inliers)}
    kept = {name: [mask for pair, mask in found.inliers.items() if pair.sensor == name] for name in stated}
    many = [name for name, of in kept.items() if of and np.mean(~np.concatenate(of)) > MANY_LEFT_OUT]
    if many:
        clocks |= {clock.sensor: clock for clock in _clocks(run, found.solution, {}) if clock.sensor in many}
    for clock in (clocks[name] for name in stated if name in clocks):
        if clock.is_clearly_off and clock.offset_s is not None:
            ground = Ground.LATE_CLOCK if abs(clock.offset_s) > LATE_S else Ground.COVARIANCE_DOUBTED
            run.record.find(ground, f"the clock of {clock.sensor} was taken as right, but {clock.evidence}")
    _say_unchecked(run, tuple(clocks[name] for name in stated if name in clocks))


def _worth_estimating(clocks: tuple[Clock, ...]) -> tuple[str, ...]:
    return tuple(clock.sensor for clock in clocks if clock.is_worth_estimating)


def _is_known(refined: Refined, sensor: str) -> bool:
    """Whether the answer has the sensor, and determines its time offset."""
    offset = Unknown(UnknownKind.TIME_OFFSET, sensor)
    return sensor in refined.time_offsets_s and bool(np.isfinite(refined.covariance(offset)).all())


def _is_late(refined: Refined, sensor: str) -> bool:
    """Whether the sensor's time offset is surely not zero."""
    variance = float(refined.covariance(Unknown(UnknownKind.TIME_OFFSET, sensor))[0, 0])
    return abs(refined.time_offsets_s[sensor]) > LATE_SIGMAS * math.sqrt(variance)
