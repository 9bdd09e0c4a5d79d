"""Misreadings: mistakes in reading A and B, found because another reading of the same numbers fits far better.

A certificate proves that no other poses fit better; it says nothing about numbers that were misread. So, where
residuals are not plainly those of a sensor, each likely mistake is undone on a sample of the measurements, and the
sample is fitted again. A reading is named only if it explains the measurements, and explains them better than the given
one by a factor and by more than chance allows; and only if a frame that moved once does not explain them far better
still. Exchanged carriers, the most common mistake in a rig file, are compared by likelihoods, since few stations hide
them: of 40 draws of n stations from two real cells they were named in 16 for n = 4, 34 for n = 5, 39 for n = 6 and all
for n = 8 and more; where there was none, never (280 draws).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from rwhec_factors.se3 import inverse, so3_logmap

from gtsam_rwhec.calibration.calibrate_options import Run
from gtsam_rwhec.calibration.euler_readings import readings_of_euler_angles
from gtsam_rwhec.calibration.moved_frames import explains_more
from gtsam_rwhec.calibration.other_readings import (
    A_INVERTED,
    AS_READ,
    DOUBLE,
    REPAIR,
    SINGLE,
    Mistake,
    OtherReading,
    WrongUnit,
    readings_of_angles,
    shifted,
    wrong_unit,
)
from gtsam_rwhec.calibration.slipped_rows import Slips, slips_of
from gtsam_rwhec.calibration.trial_fits import (
    Implausible,
    Sampled,
    Spread,
    TrialFit,
    fitted,
    implausible,
    likelihood_of_a_wrong_one,
    residual_of,
    signal_of,
)
from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.errors import RwhecWarning, ScaleError
from gtsam_rwhec.files.progress import Progress, check_progress, silent
from gtsam_rwhec.files.terminal_text import rounded
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.solution import Solution


@dataclass(frozen=True)
class Reading:
    """The likely misreadings of a problem's poses; if there are none, residuals that no sensor has."""

    misreadings: tuple[Misreading, ...] = ()
    implausible: Implausible | None = None

    @property
    def finding(self) -> Finding | None:
        """The finding against the poses; None where nothing is wrong."""
        found = self.misreadings
        if found:
            return Finding(Ground.MISREAD, " (or: ".join(map(str, found)) + ")" * (len(found) - 1))
        return None if self.implausible is None else Finding(Ground.IMPLAUSIBLE, str(self.implausible))


def reading_of(problem: Problem, solution: Solution | None, progress: Progress | None = None) -> Reading:
    """Test how a problem's poses were read. ``solution``: certified, or None if there is none with a positive scale."""
    found = misreadings(problem, solution, progress=progress or silent)
    return Reading(found, None if found else implausible(problem, solution))


#: Residuals are plainly those of a sensor if, as shares of the variation of B, their geometric mean is below this.
PLAIN_SHARE = 0.025
#: Neither of the two shares may then be above this.
LARGEST_PLAIN_SHARE = 0.04
#: With a share above this the calibration explains so little that unusual mistakes are tried too.
UNEXPLAINED_SHARE = 0.3
#: Readings are first tried on so many pairs, measurements and rounds.
SCREENING_PAIRS, SCREENING_MEASUREMENTS, SCREENING_ROUNDS = 6, 200, 2
#: There, a reading is promising if its product of residuals is below this share of that of the poses as read.
PROMISING = 0.85
#: The product of both residuals' ratios must be at least this: "fits far better".
FAR_BETTER = 1.8
#: And its gain must be above this many of its own standard deviations.
BEYOND_CHANCE = 4.0
#: A reading explains a residual that became smaller only if it is below this share of the variation of B.
EXPLAINED_SHARE = 0.3
#: One of the two residuals may grow by this factor, if the other one falls by more.
NOT_WORSE = 1.5
#: The variance of the logarithm of a median's ratio, over that of a root mean square's.
INEFFICIENCY_OF_MEDIANS = 2.7
#: With fewer degrees of freedom, rotations and translations each, any reading may fit by chance.
FEWEST_DEGREES_OF_FREEDOM = 9
#: Two readings fit alike when their products of residuals differ by less than this factor.
ALIKE_FACTOR = 1.5
#: Smaller rotation residuals (rad) count as this: no sensor is better.
SMALLEST_RAD = 2e-4
#: Smaller translation residuals, as a share of the variation of B, count as this.
SMALLEST_SHARE = 2e-4
#: The largest shift of rows that is tried.
MOST_SHIFTED = 5
#: Residuals that are like a delay of this many rows may come from a shift.
LATE_ROWS = 0.5
#: Pairs with fewer rows are not tested for a shift.
FEWEST_ROWS = 8


@dataclass(frozen=True)
class Misreading:
    """A likely mistake in reading the poses; ``str()`` is one sentence with both residuals and the cure."""

    mistake: Mistake
    #: What was likely misread, and what to do
    likely: str
    cure: str
    #: The median residuals as read, and if read otherwise
    rotation_deg: tuple[float, float]
    translation_mm: tuple[float, float]
    of_B: bool = False  #: Whether B was misread
    inverts_A: bool = False  #: Whether A, alone, is the inverse of what was meant: the carriers are exchanged
    #: By pair, how many rows after its own (N,) the A of each B is; empty where rows are not shifted
    shifts: Mapping[Pair, np.ndarray] = field(default_factory=dict, repr=False)

    @staticmethod
    def of_slips(slips: Slips) -> Misreading:
        """The record of rows that slipped."""
        first = slips.slips[0]
        lost = "an image without a detection" if first.shift > first.before else "a pose that was not recorded"
        left = ("B", "A") if first.shift > first.before else ("A", "B")
        return Misreading(
            Mistake.ROWS_SLIPPED,
            f"rows slipped: {slips.words}; this is what {lost} does that is left out of {left[0]} and not of {left[1]}",
            f"leave out of {left[1]} too what is left out of {left[0]} (write a pose and a detection together, or "
            f"neither), or let the rows be shifted: {REPAIR}",
            *_figures(slips.before, slips.after),
            shifts=slips.shifts,
        )

    @staticmethod
    def of(reading: OtherReading, before: Spread, after: Spread, unit: WrongUnit | None = None) -> Misreading:
        """The record of a reading with its residuals, and of a wrong unit if there is one."""
        parts = [part for part in (reading if reading is not AS_READ else None, unit) if part]
        return Misreading(
            parts[0].mistake,
            ", and ".join(part.likely for part in parts),
            "; ".join(part.cure for part in parts),
            *_figures(before, after, unit.of_B if unit else 1.0),
            reading.of_B,
            reading.inverts_A,
        )

    def __str__(self) -> str:
        before, after = (
            f"{rounded(deg, 3)} deg and {rounded(mm, 3)} mm"
            for deg, mm in zip(self.rotation_deg, self.translation_mm, strict=True)
        )
        return f"{self.likely}: the median residual is {before} as read, and {after} otherwise; {self.cure}"


def _figures(before: Spread, after: Spread, of_B: float = 1.0) -> tuple[tuple[float, float], tuple[float, float]]:
    """The residuals of two readings in degrees, and in millimetres."""
    degrees = (math.degrees(before.rotation_rad), math.degrees(after.rotation_rad))
    return degrees, (1e3 * before.translation_m, 1e3 * after.translation_m / of_B)


@one_blas_thread()
def misread_as_recorded(run: Run) -> Reading:
    """How a log's poses were misread in a way that neither sizes nor clocks explain; empty where they were not.

    Measurements that cleaning removed are included: a misreading may make them contradict the motion. B that this
    library found in images was not misread. Where A is the inverse of the poses in the log, those may have been
    misread.
    """
    recording = run.recording
    if recording is None or recording.uncleaned is None or run.times > 1 or not run.options.misreadings:
        return Reading()
    problem = recording.uncleaned
    with warnings.catch_warnings(action="ignore", category=RwhecWarning):  # users get those of the answer
        try:
            found = _of_recording(problem, run)
        except ScaleError as error:
            words = "whether the poses were misread was not looked for among what cleaning removed"
            run.record.find(Ground.NOT_CHECKED, f"{words}: {error}")
            return Reading()
        if found and recording.is_inverse:
            with suppress(ScaleError):  # the poses as they are read tell it too
                found = min(found, _of_recording(inverted(problem), run) or found, key=_is_left)
    exchanged = exchange_of(problem).misreading if not found else None
    found = found if exchanged is None else (exchanged,)
    return Reading() if all(one.mistake.may_be_sizes_or_clocks for one in found) else Reading(found)


def _of_recording(problem: Problem, run: Run) -> tuple[Misreading, ...]:
    assert run.recording is not None
    found = misreadings(problem, run.solution_of(problem), progress=run.tell)
    return (tuple(one for one in found if not one.of_B) or found) if run.recording.is_detected else found


def inverted(problem: Problem) -> Problem:
    """The same measurements with A and B inverted, and targets and sensors exchanged: B^-1 = X^-1 A^-1 Y."""
    turned = Problem(problem.scale)
    for target, sensor in problem.pairs:
        measured = problem.measurements(target, sensor)
        turned.add(sensor, target, inverse(measured.A), inverse(measured.B))
    return turned


def _is_left(found: tuple[Misreading, ...]) -> float:
    """The product of both residuals under the first reading."""
    return found[0].rotation_deg[1] * found[0].translation_mm[1]


def are_too_few_to_tell(problem: Problem) -> bool:
    """Whether the raw measurements are too few to show a misreading; False if the problem did not keep them."""
    sampled = Sampled.of(problem)
    return sampled is not None and _degrees_of_freedom(sampled) < FEWEST_DEGREES_OF_FREEDOM


@one_blas_thread()
def misreadings(
    problem: Problem, solution: Solution | None, *, progress: Progress | None = None
) -> tuple[Misreading, ...]:
    """Find likely mistakes in the reading of A and B.

    Parameters
    ----------
    problem : Problem
    solution : Solution or None
        The problem's solution; None where it has none (a scale that is not positive).
    progress : callable, optional
        Is called with what is tried.

    Returns
    -------
    tuple of Misreading
        Empty where residuals are plainly those of a sensor, where no other reading fits far better, and where the
        problem did not keep its measurements. Two or more readings fit alike: data cannot tell which mistake it was.
    """
    check_progress(progress)
    sampled = Sampled.of(problem)
    if sampled is None or _degrees_of_freedom(sampled) < FEWEST_DEGREES_OF_FREEDOM:
        return ()
    signal = signal_of(sampled.as_read())
    given = residual_of(problem, solution) if solution is not None else None
    slips = slips_of(problem, solution, is_plain=given is not None and is_plain(given, signal))
    if slips is not None:
        return (Misreading.of_slips(slips),)
    is_late = solution is not None and _rows_are_late(sampled, solution)
    if given is not None and is_plain(given, signal) and not is_late:
        return ()
    tell = progress or silent
    tell("trying other readings of the poses")
    trial = _Trial.of(problem, sampled, signal, tell)
    if trial is None or (is_plain(trial.base.residual, signal) and not is_late):
        return ()
    angles = list(readings_of_angles(*sampled.all_poses))
    # Readings that say all rotations are small come first: such rotations fit any other reading too.
    found = trial.found([each for each in angles if each.of_small_angles])
    found = found or trial.found([*SINGLE, *readings_of_euler_angles(sampled.as_read())])
    found = found or trial.found(trial.shifts())
    if not found and problem.scale == "known":
        found = trial.found([AS_READ], "shared")
    if found or not trial.is_strange:
        return found
    found = trial.found([each for each in angles if not each.of_small_angles]) or trial.found(DOUBLE)
    if not found and problem.scale == "known":
        found = trial.found(SINGLE, "shared")
    return found


def _rows_are_late(sampled: Sampled, solution: Solution) -> bool:
    """Whether residuals look like a shift of rows: where carriers move slowly, a shift makes small residuals.

    A regression of the residual's rotation on the motion from row to row estimates how many rows B is late. Small
    rotations of X and Y are unknowns too, since the solution absorbed a part of the shift.
    """
    if sampled.has_clock:
        return False
    late = []
    for pair, raw in sampled.whole.items():
        if pair.is_motion or len(raw.A) < FEWEST_ROWS:
            continue
        R = (inverse(solution.Y[pair.sensor].matrix()) @ raw.A @ solution.X[pair.target].matrix())[:, :3, :3]
        R_inverse = R.transpose(0, 2, 1)
        motion = so3_logmap(R_inverse[:-2] @ R[2:]) / 2.0
        error = so3_logmap(R_inverse[1:-1] @ raw.B[1:-1, :3, :3])
        size = np.linalg.norm(error, axis=1)
        w = 1.0 / (1.0 + size / max(float(np.median(size)), SMALLEST_RAD))
        of_X = np.broadcast_to(np.eye(3), R_inverse[1:-1].shape)
        columns = np.concatenate([motion[:, :, None], of_X, R_inverse[1:-1]], axis=2) * w[:, None, None]
        estimate = np.linalg.lstsq(columns.reshape(-1, 7), (error * w[:, None]).ravel(), rcond=None)[0]
        late += [float(estimate[0])] * len(error)
    return bool(late) and abs(float(np.median(late))) > LATE_ROWS


def is_plain(residual: Spread, signal: Spread) -> bool:
    """Whether residuals are plainly those of a sensor: small compared with the variation of B."""
    shares = shares_of(residual, signal)
    return math.sqrt(shares[0] * shares[1]) < PLAIN_SHARE and max(shares) < LARGEST_PLAIN_SHARE


def shares_of(residual: Spread, signal: Spread) -> tuple[float, float]:
    """The residuals as shares of the variation of B."""
    return (
        residual.rotation_rad / max(signal.rotation_rad, SMALLEST_RAD),
        residual.translation_m / max(signal.translation_m, 1e-12),
    )


def _degrees_of_freedom(sampled: Sampled) -> int:
    """Degrees of freedom of the rotations; the translations have as many."""
    return 3 * (sampled.count - sampled.unknown_poses)


@dataclass(frozen=True)
class _Trial:
    """What other readings are compared with."""

    problem: Problem
    sampled: Sampled
    screen: Sampled
    signal: Spread
    base: TrialFit
    on_screen: TrialFit
    tell: Progress

    @staticmethod
    def of(problem: Problem, sampled: Sampled, signal: Spread, tell: Progress) -> _Trial | None:
        """The poses as they were read, fitted; None where they have no answer with these scales."""
        screen = Sampled.of(problem, SCREENING_PAIRS, SCREENING_MEASUREMENTS)
        assert screen is not None
        base = fitted(problem, sampled.as_read())
        on_screen = fitted(problem, screen.as_read(), rounds=SCREENING_ROUNDS)
        if base is None or on_screen is None:
            return None
        return _Trial(problem, sampled, screen, signal, base, on_screen, tell)

    def found(self, readings: Iterable[OtherReading], mode: ScaleMode | None = None) -> tuple[Misreading, ...]:
        """The readings that fit best, if they fit far better than the given one."""
        gains: list[tuple[float, Misreading, Spread]] = []
        for reading in filter(lambda reading: self.is_promising(reading, mode), readings):
            fit = fitted(self.problem, self.sampled.by(reading), mode)
            if fit is None or not (gain := self.gain(reading, fit)):
                continue
            if (named := self.named(reading, fit, mode)) is not None:
                gains.append((gain, named, fit.residual))
        best = max(gains, key=lambda each: each[0], default=None)
        if best is None or explains_more(self.problem, self.sampled.as_read(), best[2]):
            return ()  # of a board that was moved, or a mount that gave way, a step of that frame tells more
        return tuple(misreading for gain, misreading, _ in gains if gain > best[0] - math.log(ALIKE_FACTOR))

    @property
    def is_strange(self) -> bool:
        """Whether the fit of the poses as read explains next to nothing."""
        return max(shares_of(self.base.residual, self.signal)) > UNEXPLAINED_SHARE

    def shifts(self) -> list[OtherReading]:
        """The shifts of rows to try: larger ones only if a shift by one row already fits better, or nothing fits."""
        if self.sampled.has_clock:
            return []
        fewest = [shifted(1), shifted(-1)]
        if not self.is_strange and not any(self.is_promising(reading, None) for reading in fewest):
            return []
        return fewest + [shifted(sign * n) for n in range(2, MOST_SHIFTED + 1) for sign in (1, -1)]

    def is_promising(self, reading: OtherReading, mode: ScaleMode | None) -> bool:
        """Whether a reading fits better in a quick test: few measurements, few rounds."""
        self.tell(f"trying other readings of the poses: {reading.likely or 'another unit'}")
        fit = fitted(self.problem, self.screen.by(reading), mode, rounds=SCREENING_ROUNDS)
        return fit is not None and self._log_product(fit) < self._log_product(self.on_screen) + math.log(PROMISING)

    def gain(self, reading: OtherReading, fit: TrialFit) -> float:
        """The logarithm of the product of both residuals' ratios; 0 if small, by chance, or residuals stay large."""
        before, after = self._floored(self.base.residual), self._floored(fit.residual)
        ratios = (before.rotation_rad / after.rotation_rad, before.translation_m / after.translation_m)
        # Another unit of angles, or another convention, changes the variation of B.
        is_other = reading.mistake in (Mistake.ANGLE_UNIT, Mistake.EULER_AXES)
        signal = signal_of(self.sampled.by(reading)) if is_other else self.signal
        for ratio, share in zip(ratios, shares_of(after, signal), strict=True):
            if ratio < 1.0 / NOT_WORSE or (ratio > NOT_WORSE and share > EXPLAINED_SHARE):
                return 0.0
        gain = float(np.sum(np.log(ratios)))
        chance = math.sqrt(2.0 * INEFFICIENCY_OF_MEDIANS / _degrees_of_freedom(self.sampled))
        if gain <= math.log(FAR_BETTER) + BEYOND_CHANCE * chance:
            return 0.0
        # Vuong's test of two models that do not contain each other, over blocks of neighbouring measurements.
        remains = self.sampled.remains(reading)
        # A wrong measurement is one in either reading, however far it is from the better one.
        wrong = likelihood_of_a_wrong_one(self.signal)
        gains = np.maximum(fit.log_likelihoods, wrong) - np.maximum(self.base.log_likelihoods[remains], wrong)
        sums = _sums(gains, self.sampled.blocks()[remains])
        is_significant = float(sums.mean()) > BEYOND_CHANCE * float(sums.std(ddof=1)) / math.sqrt(len(sums))
        return gain if is_significant else 0.0

    def _floored(self, spread: Spread) -> Spread:
        return Spread(
            max(spread.rotation_rad, SMALLEST_RAD),
            max(spread.translation_m, SMALLEST_SHARE * self.signal.translation_m, 1e-12),
        )

    def _log_product(self, fit: TrialFit) -> float:
        floored = self._floored(fit.residual)
        return math.log(floored.rotation_rad) + math.log(floored.translation_m)

    def named(self, reading: OtherReading, fit: TrialFit, mode: ScaleMode | None) -> Misreading | None:
        """The record of a reading that fits; None where it fits with a free scale that is no mistake."""
        unit = None
        if mode is not None:
            from_corners = all(pair.target in self.problem.boards for pair in self.problem.pairs)
            unit = wrong_unit(fit.one_scale, *self.sampled.median_lengths, from_corners=from_corners)
            if unit is None:
                return None
        found = Misreading.of(reading, self.base.residual, fit.residual, unit)
        if not reading.shift:
            return found
        counts = {pair: self.problem.moments(*pair).count for pair in self.problem.pairs if not pair.is_motion}
        return replace(found, shifts={pair: np.full(count, -reading.shift) for pair, count in counts.items()})


def _sums(values: Array, blocks: np.ndarray) -> Array:
    """The sums of values (N,) over the blocks (N,) that there are."""
    return np.asarray(np.bincount(blocks, values)[np.unique(blocks)])


#: The exchange is reported from this logarithm of the likelihood ratio on.
EXCHANGE_SURELY = 15.0
#: And its mean over blocks of neighbouring measurements must be above this many of its standard deviations.
EXCHANGE_SIGMAS = 1.0
#: With the exchange, residuals must be below this share of the variation of B; else something else is wrong.
EXCHANGE_EXPLAINED = 0.15
#: Below this log likelihood ratio the measurements do not tell the two readings apart.
EXCHANGE_OPEN = 3.0


@dataclass(frozen=True)
class Exchange:
    """What the measurements say of exchanged carriers."""

    #: The exchange, if it fits far better than A as read, and a frame that moved once does not fit far better still
    misreading: Misreading | None = None
    #: Whether the question stays open: too few measurements for any other test, which do not tell the two apart or
    #: leave residuals that are not small
    is_open: bool = False


@one_blas_thread()
def exchange_of(problem: Problem) -> Exchange:
    """Compare A as it was read with its inverse; no result if either has no fit."""
    sampled = Sampled.of(problem)
    if sampled is None:
        return Exchange()
    given, inverse = fitted(problem, sampled.as_read()), fitted(problem, sampled.by(A_INVERTED))
    if given is None or inverse is None:
        return Exchange()
    gains = inverse.log_likelihoods - given.log_likelihoods
    sums = _sums(gains, sampled.blocks())
    gain, spread = float(gains.sum()), float(sums.std(ddof=1)) * math.sqrt(len(sums)) if len(sums) > 1 else math.inf
    signal = signal_of(sampled.as_read())
    is_explained = max(shares_of(inverse.residual, signal)) < EXCHANGE_EXPLAINED
    is_named = gain > EXCHANGE_SURELY and gain > EXCHANGE_SIGMAS * spread and is_explained
    if is_named and not explains_more(problem, sampled.as_read(), inverse.residual):
        return Exchange(Misreading.of(A_INVERTED, given.residual, inverse.residual))
    is_small = is_plain(given.residual, signal)
    return Exchange(is_open=are_too_few_to_tell(problem) and (gain > -EXCHANGE_OPEN or not is_small))
