"""``calibrate``: one call from a problem to the best answer that its measurements hold, with a verdict.

It solves, leaves outliers out, certifies what is kept, refines with the noise that the residuals show, and judges. Each
step that cannot be taken is a choice that says so; only input that cannot be used raises an error.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np

from gtsam_rwhec.calibration.calibrated import (
    REFINEMENT,
    Calibration,
    Carriers,
    NoiseFound,
    Outliers,
)
from gtsam_rwhec.calibration.choices import Choice
from gtsam_rwhec.calibration.clocks import Clock, offsets_worth_estimating
from gtsam_rwhec.calibration.disagreement import contradicted_frames
from gtsam_rwhec.calibration.lengths import doubted_lengths, undetectable
from gtsam_rwhec.calibration.misreadings import Misreading
from gtsam_rwhec.calibration.noise_choice import Inliers, estimated, offsets_of
from gtsam_rwhec.calibration.options import CalibrateOptions
from gtsam_rwhec.calibration.plausibility import Implausible
from gtsam_rwhec.calibration.reading import reading_of
from gtsam_rwhec.calibration.readings import Mistake
from gtsam_rwhec.calibration.sizes import TargetSize, sizes
from gtsam_rwhec.calibration.stated_poses import contradicted_poses, stated_poses
from gtsam_rwhec.calibration.verdict import Finding, Ground, Judgement, findings_of, proof_of
from gtsam_rwhec.calibration.views import views_of
from gtsam_rwhec.errors import (
    CountError,
    NoiseError,
    NotCertifiedWarning,
    NotUniqueWarning,
    OptionError,
    OutlierError,
    OutliersWarning,
    RwhecError,
    RwhecWarning,
    ScaleError,
    UnderdeterminedError,
    WeightsWarning,
)
from gtsam_rwhec.files.progress import Progress, check_progress, silent
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.noise_model.found import NoiseInData
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import selected
from gtsam_rwhec.refinement.graduated import graduated
from gtsam_rwhec.refinement.options import RefineOptions
from gtsam_rwhec.refinement.refined import Refined
from gtsam_rwhec.refinement.refining import refine
from gtsam_rwhec.refinement.unknowns import Unknown, UnknownKind
from gtsam_rwhec.solving.certified_solution import solve
from gtsam_rwhec.solving.solution import Solution

#: Without at least so many equations more than unknowns a wrong measurement cannot be told from the others: it has six
#: of its own, and the rest must tell noise from it.
SPARE_EQUATIONS = 24
#: The verdict says better what these warn of.
SAID_BY_THE_VERDICT = (NotUniqueWarning, NotCertifiedWarning, WeightsWarning, OutliersWarning)

#: A time offset of so many standard deviations explains rows that look shifted.
SURELY = 5.0

#: A clock that was taken as right moves poses by millimetres and more if it is off by more than this, s.
LATE_S = 0.005
NOT_KNOWN = NoiseFound("not known", {}, {}, "not known")


@one_blas_thread()
def calibrate(
    problem: Problem, options: CalibrateOptions | None = None, *, progress: Progress | None = None
) -> Calibration:
    """Find the best answer that the measurements hold, with an uncertainty and a verdict.

    Parameters
    ----------
    problem : Problem
        With its raw measurements: without them, outliers are not looked for.
    options : CalibrateOptions, optional
        Each overrules one choice that is otherwise made from the data.
    progress : callable, optional
        Is called with the name of each stage as it begins.

    Returns
    -------
    Calibration
        Always with a verdict: ``Verdict.DO_NOT_USE`` where the measurements do not determine the poses, or contradict
        them. ``choices`` has every choice with its evidence, also those that could not be made.

    Raises
    ------
    RwhecError
        The input cannot be used: there are fewer equations than unknowns, options contradict the problem, a sensor's
        name is unknown.
    """
    if not isinstance(problem, Problem):
        raise OptionError(f"the problem is a {type(problem).__name__}; give a gtsam_rwhec.Problem")
    options = CalibrateOptions() if options is None else options
    if not isinstance(options, CalibrateOptions):
        raise OptionError(f"options is a {type(options).__name__}; give a gtsam_rwhec.CalibrateOptions")
    check_progress(progress)
    problem.require_pairs()
    if options.noise == "given" and problem.is_relative:
        raise OptionError(
            "noise='given', but some measurements were added without sigma or kappa; take noise='auto', or add sigma "
            "and kappa"
        )
    return _Calibrating(problem, options, progress or silent).done()


class _Answer(NamedTuple):
    """The certified solution of the inliers, the inliers, their refined calibration, and the noise that was found."""

    solution: Solution | None
    inliers: Inliers
    refined: Refined | None
    noise: NoiseFound


def _is_known(refined: Refined, sensor: str) -> bool:
    """Whether the answer has the sensor, and determines its time offset."""
    offset = Unknown(UnknownKind.TIME_OFFSET, sensor)
    return sensor in refined.time_offsets_s and bool(np.isfinite(refined.covariance(offset)).all())


def _is_late(refined: Refined, sensor: str) -> bool:
    """Whether the sensor's time offset is surely not zero."""
    variance = float(refined.covariance(Unknown(UnknownKind.TIME_OFFSET, sensor))[0, 0])
    return abs(refined.time_offsets_s[sensor]) > SURELY * math.sqrt(variance)


def _worth_estimating(clocks: tuple[Clock, ...]) -> tuple[str, ...]:
    return tuple(clock.sensor for clock in clocks if clock.is_worth_estimating)


@dataclass
class _Calibrating:
    """One run of ``calibrate``."""

    problem: Problem
    options: CalibrateOptions
    tell: Progress
    choices: list[Choice] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    notes: dict[str, None] = field(default_factory=dict)
    #: Sensors whose clocks are clearly off.
    _clearly_off: tuple[str, ...] = ()

    def done(self) -> Calibration:
        """All steps, one after the other."""
        problem, options = self.problem, self.options
        self._check_offsets()
        inliers: Inliers = {}
        refined, noise = None, NOT_KNOWN
        with self._noted():
            solution, why = self._solved()
            misread, odd = self._misread(solution)
            if misread and all(one.mistake is Mistake.ROWS_SHIFTED for one in misread):
                late = self._late_instead_of_shifted(solution)
                if late is not None:
                    misread, (solution, inliers, refined, noise) = (), late
            elif not (misread or odd):
                solution, inliers, refined, noise = self._answer(solution)
            if refined is not None:
                self._doubt_stated_poses(refined, inliers)
            found_sizes = self._sizes(inliers) if refined is not None else ()
        if solution is None:
            self.findings.append(Finding(Ground.NO_SCALE, why))
        elif lengths := doubted_lengths(problem, solution):
            self.findings.append(Finding(Ground.MISREAD, str(lengths)))
        outliers = self._outliers(inliers)
        if refined is not None and not refined.free_directions and spare_equations(problem) < SPARE_EQUATIONS:
            words = f"{problem.number_of_measurements} measurements are too few to tell how large their noise is"
            self.findings.append(Finding(Ground.COVARIANCE_DOUBTED, words))
        judgement = Judgement.of([*findings_of(solution, refined), *self.findings], proof_of(refined))
        best = solution if refined is None else refined
        return Calibration(
            X={} if best is None else best.X,
            Y={} if best is None else best.Y,
            scale=math.nan if best is None else best.scale,
            time_offsets_s={} if refined is None else refined.time_offsets_s,
            judgement=judgement,
            solution=solution,
            refined=refined,
            noise=noise,
            outliers=outliers,
            misreadings=misread,
            implausible=odd,
            sizes=found_sizes,
            cannot_tell=undetectable(problem),
            findings=tuple(self.findings),
            choices=tuple(self.choices),
            notes=tuple(self.notes),
            views={} if best is None else views_of(problem, inliers, best.scale),
            carriers=Carriers(problem.sensor_carrier, problem.target_carrier),
            options=options,
        )

    # -- steps --------------------------------------------------------------------------------------------------

    def _check_offsets(self) -> None:
        given = self.options.time_offsets
        if isinstance(given, tuple):
            unknown = [name for name in given if name not in self.problem.sensors]
            if unknown:
                raise OptionError(
                    f"CalibrateOptions.time_offsets names {unknown[0]!r}, which is not a sensor; give any of "
                    f"{', '.join(self.problem.sensors)}"
                )

    def _solved(self) -> tuple[Solution | None, str]:
        """The certified solution of all measurements; without one, why there is none."""
        try:
            return solve(self.problem, options=self.options.solve, progress=self.tell), ""
        except ScaleError as error:
            return None, str(error)

    def _misread(self, solution: Solution | None) -> tuple[tuple[Misreading, ...], Implausible | None]:
        """Likely misreadings of the poses, or residuals that no sensor has; with these there is no more to do."""
        what = "reading of A and B"
        if not self.options.misreadings:
            self._choose(what, "as given", "an option says so")
            return (), None
        reading = reading_of(self.problem, solution, self.tell)
        found, odd = reading.misreadings, reading.implausible
        if reading.finding is not None:
            self.findings.append(reading.finding)
        if found:
            self._choose(what, "nothing else is computed", "another reading of the poses fits far better")
        elif odd is not None:
            self._choose(what, "nothing else is computed", "the residuals are those of no sensor")
        else:
            self._choose(what, "as given", "no likely mistake of reading explains the measurements far better")
        return found, odd

    def _late_instead_of_shifted(self, first: Solution | None) -> _Answer | None:
        """The answer where a late clock explains rows that look shifted; None where it does not."""
        if self.options.time_offsets != "auto":
            return None
        as_it_was, self.choices, self.findings = (self.choices, self.findings), [], []
        answer = self._answer(first)
        if answer.refined is not None and any(_is_late(answer.refined, name) for name in answer.refined.time_offsets_s):
            chosen = "rows of A and B look shifted against each other, and a time offset is estimated in place of that"
            self.choices.insert(0, Choice("reading of A and B", "as given", f"{chosen}, since there are stamps"))
            return answer
        self.choices, self.findings = as_it_was
        return None

    def _answer(self, first: Solution | None) -> _Answer:
        """The answer without outliers, with the time offsets that stamps and motion determine."""
        options, what = self.options, "time offsets"
        if options.time_offsets != "auto":
            answer = self._answer_as_told(first)
            asked = offsets_of(self.problem, options)
            self._choose(what, "estimated" if asked else "not estimated", "an option says so")
            if not asked and answer.refined is not None:
                self._doubt_stated_clocks(self._clocks(answer.solution, answer.inliers))
            return answer
        before = (list(self.choices), list(self.findings))
        clocks = self._clocks(first, {})
        self._clearly_off = tuple(clock.sensor for clock in clocks if clock.is_clearly_off)
        answer = self._answer_as_told(first, _worth_estimating(clocks))
        if answer.solution is None or answer.refined is None:
            self._choose(what, "not estimated", "there are no residuals to test")
            return answer
        after = self._clocks(answer.solution, answer.inliers)
        known = [name for name in _worth_estimating(after) if _is_known(answer.refined, name)]
        new = [name for name in _worth_estimating(after) if name not in answer.refined.time_offsets_s]
        if len(known) + len(new) != len(answer.refined.time_offsets_s) or new:
            # Outliers had hidden what the motion tells, or the motion of what is left tells less.
            self.choices, self.findings = before
            self._clearly_off = tuple(clock.sensor for clock in after if clock.is_clearly_off)
            answer = self._answer_as_told(first, (*known, *new))
        found = {} if answer.refined is None else answer.refined.time_offsets_s
        chosen = f"estimated for {', '.join(found)}" if found else "not estimated"
        self._choose(what, chosen, "; ".join(f"{clock.sensor}: {clock.evidence}" for clock in after))
        return answer

    def _doubt_stated_clocks(self, clocks: tuple[Clock, ...]) -> None:
        """Clocks that were taken as right, and that the motion contradicts."""
        for clock in clocks:
            if clock.is_clearly_off and clock.offset_s is not None:
                ground = Ground.LATE_CLOCK if abs(clock.offset_s) > LATE_S else Ground.COVARIANCE_DOUBTED
                said = f"the clock of {clock.sensor} was taken as right, but {clock.evidence}"
                self.findings.append(Finding(ground, said))

    def _clocks(self, solution: Solution | None, inliers: Inliers) -> tuple[Clock, ...]:
        if solution is None:
            return ()
        kept = selected(self.problem, inliers) if inliers else self.problem
        return offsets_worth_estimating(kept, solution, self.options.carrier_path)

    def _offsets_for_outliers(self) -> bool | tuple[str, ...]:
        """Clocks that are clearly off make some of what moves an outlier, so they are taken along."""
        return self._clearly_off or (offsets_of(self.problem, self.options) if self._is_told else ())

    @property
    def _is_told(self) -> bool:
        return self.options.time_offsets != "auto"

    def _answer_as_told(self, first: Solution | None, offsets: tuple[str, ...] | None = None) -> _Answer:
        """The answer with the time offsets of the named sensors, or of those that the options say."""
        solution, inliers = self._without_outliers(first)
        if solution is None:
            return _Answer(None, inliers, None, NOT_KNOWN)
        options = self.options
        self.options = options if offsets is None else replace(options, time_offsets=offsets)
        refined, noise, solution, inliers = self._refined(solution, inliers)
        self.options = options
        self._say_outliers(inliers)
        return _Answer(solution, inliers, refined, noise)

    def _without_outliers(self, first: Solution | None) -> tuple[Solution | None, Inliers]:
        """The certified solution of the measurements that agree, and which these are."""
        problem, options, what = self.problem, self.options, "outliers"
        spare = spare_equations(problem)
        if options.robust == "none":
            self._choose(what, "every measurement counts", "an option says so")
            return first, {}
        if not problem.has_measurements:
            self._choose(what, "every measurement counts", "the raw measurements were not kept")
            return first, {}
        if options.robust == "auto" and spare < SPARE_EQUATIONS:
            self._choose(
                what,
                "not looked for",
                f"{problem.number_of_measurements} measurements have {spare} equations more than unknowns, and to "
                f"find a wrong one takes {SPARE_EQUATIONS}",
            )
            return first, {}
        noise: Literal["given", "estimate"] = "given" if options.noise == "given" else "estimate"
        try:
            has_more = (
                problem.has_covariances or options.carrier_noise is not None or bool(self._offsets_for_outliers())
            )
            if first is not None and has_more:
                solution, inliers = self._inliers_under_the_full_noise(first)
            else:
                found = graduated(problem, confidence=options.inlier_confidence, noise_scale=noise, progress=self.tell)
                solution, inliers = found.solution, found.inliers
        except (OutlierError, NoiseError, ScaleError) as error:
            self._choose(what, "not left out", f"it is not possible: {error}")
            self.findings.append(
                Finding(Ground.CONTRADICTED, "too few measurements agree with one another to find out which are wrong")
            )
            return first, {}
        return solution, inliers

    def _inliers_under_the_full_noise(self, first: Solution) -> tuple[Solution, Inliers]:
        """Inliers where sigma and kappa do not hold the whole noise: ``refine`` chooses them again under it."""
        options = self.options
        how = RefineOptions(
            noise="given" if options.noise == "given" else "estimate",
            noise_groups=options.noise_groups,
            robust="gnc",
            inlier_confidence=options.inlier_confidence,
            carrier_noise=options.carrier_noise,
            carrier_model="propagated",
            time_offsets=self._offsets_for_outliers(),
            carrier_path=options.carrier_path if self._offsets_for_outliers() else None,
        )
        try:
            refined = refine(self.problem, first, how, progress=self.tell)
        except NoiseError:
            if options.carrier_noise is None:
                raise
            # More noise is stated for A than the residuals hold. They are judged by what they show, and again under
            # the noise that is found.
            refined = refine(self.problem, first, replace(how, carrier_noise=None), progress=self.tell)
        return refined.solution, refined.inliers

    def _refined(self, solution: Solution, inliers: Inliers) -> tuple[Refined | None, NoiseFound, Solution, Inliers]:
        self.tell("refining")
        try:
            refined, noise, inliers = estimated(self.problem, solution, inliers, self.options, self.tell)
        except (NoiseError, CountError, UnderdeterminedError) as error:
            self._choose(REFINEMENT, "none", f"the noise cannot be found: {error}")
            self.findings.append(
                Finding(
                    Ground.NO_COVARIANCE,
                    f"the {self.problem.number_of_measurements} measurements are too few to tell how well the poses "
                    "are known",
                )
            )
            return None, NOT_KNOWN, solution, inliers
        if self.options.noise == "given":
            self._choose("noise of B", "as given", "an option says so")
        elif refined.noise_source == "given":
            self._choose("noise of B", "as given", "the residuals are too few to estimate it")
        elif noise.model is None:
            self._choose("noise", "that of B alone is estimated", noise.simple)
            if noise.has_failed:
                words = "the standard deviations lack the noise of A and errors that vary with the configuration"
                self.findings.append(Finding(Ground.COVARIANCE_DOUBTED, words))
        else:
            self._say_noise(noise.model)
        return refined, noise, refined.solution, inliers

    def _say_noise(self, model: NoiseInData) -> None:
        """The choices of the noise model, and the finding that errors depend on the configuration."""
        options = self.options
        equations = 6 * self.problem.number_of_measurements
        self._choose("noise of A and B", "each is estimated", f"from {equations} residuals by restricted likelihood")
        if model.is_drift_untried:
            self._choose("drift", "not modelled", "too many pairs are measured at the same instants")
            words = "errors of neighbours in time are alike, so the standard deviations may be too small"
            self.findings.append(Finding(Ground.CORRELATED, words))
        elif model.correlation is None:
            why = "an option says so" if options.drift == "none" else "neighbours in time are no more alike than others"
            self._choose("drift", "none", why)
        else:
            kind = "a random walk" if model.correlation == 1.0 else f"errors correlated by {model.correlation:g} a step"
            self._choose(
                "drift",
                f"{kind}; {model.instants} frames are worth about {model.worth:.0f}",
                f"2 log likelihood rises by {model.drift_evidence:.0f}",
            )
        if not model.arms_assumed:
            self._choose("systematic errors", "none", "an option says so")
            return
        evidence = f"2 log likelihood changes by {model.systematic_evidence:.0f}"
        if not model.has_systematic:
            self._choose("systematic errors", "not found; the covariances hold those that may be there", evidence)
            return
        self._choose("systematic errors", "found, and in the covariances", evidence)
        self.findings.append(
            Finding(Ground.SYSTEMATIC, f"errors vary with the configuration of the carriers: {model.systematic_words}")
        )

    def _say_outliers(self, inliers: Inliers) -> None:
        number = sum(int((~mask).sum()) for mask in inliers.values())
        if inliers and number == 0:
            self._choose("outliers", "none", "every measurement agrees with the others")
        elif inliers:
            self._choose(
                "outliers",
                f"{number} of {self.problem.number_of_measurements} measurements were left out",
                "they are farther off than good measurements are",
            )

    def _doubt_stated_poses(self, refined: Refined, inliers: Inliers) -> None:
        """Priors and fixed poses that the measurements contradict."""
        problem = self.problem
        if not stated_poses(problem):
            return
        self.tell("comparing the stated poses with the measurements")
        options = replace(self.options, time_offsets=tuple(refined.time_offsets_s))
        with_outliers = any(not mask.all() for mask in inliers.values())

        def answer(without: Problem) -> Refined | None:
            try:
                agree = graduated(without, noise_scale="estimate").inliers if with_outliers else {}
                kept = selected(without, agree) if agree else without
                return estimated(without, solve(kept, options=options.solve), agree, options, silent)[0]
            except (RwhecError, np.linalg.LinAlgError):
                return None  # without what was stated there is no answer to compare with

        found = contradicted_poses(problem, answer)
        for one in found:
            self.findings.append(Finding(Ground.COVARIANCE_DOUBTED if one.is_small else Ground.CONTRADICTED, str(one)))
        said = "contradicted by the measurements" if found else "not contradicted by the measurements"
        self._choose("stated poses", "as stated", said)

    def _sizes(self, inliers: Inliers) -> tuple[TargetSize, ...]:
        """What the motion says about sizes that were said to be known."""
        problem, options, what = self.problem, self.options, "sizes of targets"
        if problem.scale != "known":
            return ()
        if options.sizes == "known":
            self._choose(what, "as stated", "an option says so")
            return ()
        noise: Literal["given", "estimate"] = "given" if options.noise == "given" else "estimate"
        how = RefineOptions(noise=noise, noise_groups=options.noise_groups, carrier_noise=options.carrier_noise)
        # A target of a wrong size contradicts the others: then all of its measurements are asked, not those that agree.
        kept = {
            pair: mask if 2 * mask.sum() > len(mask) else np.ones(len(mask), bool) for pair, mask in inliers.items()
        }
        found = sizes(selected(problem, kept) if kept else problem, how, progress=self.tell)
        doubted = [size for size in found if size.is_doubted]
        self.findings += [Finding(Ground.SIZE_DOUBTED, str(size)) for size in doubted]
        if doubted:
            self._choose(what, "as stated, and doubted", "the motion contradicts them")
        elif any(size.sigma is not None for size in found):
            self._choose(what, "as stated", "the motion does not contradict them")
        else:
            self._choose(what, "as stated", "the motion does not tell them, so a wrong size would not show")
        return found

    def _outliers(self, inliers: Inliers) -> Outliers:
        """The outliers, and what they say against frames."""
        problem = self.problem
        counts = {
            pair: (int(inliers[pair].sum()) if inliers else problem.moments(*pair).count, problem.moments(*pair).count)
            for pair in problem.pairs
        }
        for frame in contradicted_frames(counts):
            is_sensor = frame.frame in problem.sensors
            ground = Ground.CONTRADICTED if is_sensor else Ground.TARGET_CONTRADICTED
            self.findings.append(Finding(ground, str(frame)))
        left = {name for pair, (kept, _) in counts.items() if kept for name in pair}
        left_out = tuple(name for name in (*problem.sensors, *problem.targets) if name not in left)
        for name in left_out:
            if name in problem.sensors:
                self.findings.append(
                    Finding(Ground.NO_ANSWER, f"{name} has no pose, because no measurement of it is in the answer")
                )
        return Outliers(inliers, counts, left_out, looked_for=bool(inliers))

    # -- records ------------------------------------------------------------------------------------------------

    def _choose(self, what: str, chosen: str, evidence: str) -> None:
        self.choices.append(Choice(what, chosen, evidence))

    @contextmanager
    def _noted(self) -> Iterator[None]:
        """Warnings of this library become notes, but for those that the verdict says better; others stay warnings."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield
        for warning in caught:
            if not isinstance(warning.message, RwhecWarning):
                warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
            elif not isinstance(warning.message, SAID_BY_THE_VERDICT):
                self.notes.setdefault(str(warning.message))


def spare_equations(problem: Problem) -> int:
    """How many more equations than unknowns there are: six for each measurement, and those of priors."""
    free = [name for name in (*problem.targets, *problem.sensors) if name not in problem.fixed]
    beliefs = [prior for name in free for prior in problem.priors.get(name, [])]
    scales = {"known": 0, "shared": 1}.get(problem.scale)
    if scales is None:
        scales = len({pair.target for pair in problem.pairs} - set(problem.fixed_scales))
    known = sum(3 * (prior.sigma is not None) + 3 * (prior.kappa is not None) for prior in beliefs)
    return 6 * problem.number_of_measurements + known - 6 * len(free) - scales
