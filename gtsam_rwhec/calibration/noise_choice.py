"""The noise stage: which model estimates the noise, the refined answer under it, and the findings about it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.calibration.calibrate_options import CalibrateOptions, Inliers, Run, agreeing, offsets_of
from gtsam_rwhec.calibration.outliers import SPARE_EQUATIONS, spare_equations
from gtsam_rwhec.calibration.verdict import REFINEMENT, Ground
from gtsam_rwhec.errors import CountError, NoiseError, ScaleError, UnderdeterminedError
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.files.terminal_text import rounded
from gtsam_rwhec.fitting.fit_options import ArmAccuracy, Component, NoiseOptions, RefineOptions
from gtsam_rwhec.fitting.noise_in_data import CONSTANT, MOST_BY_CHANCE, TOLD_RATIO, NoiseInData, ratio_words
from gtsam_rwhec.fitting.noise_refinement import under_noise
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.refinement_from_poses import refine
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.solution import Solution, contradicted_by, overstated_by, solve


@dataclass(frozen=True)
class NoiseFound:
    """The noise that a calibration assumes, one standard deviation per axis; ``str()`` is a sentence."""

    source: str  #: Where it comes from: "estimated from the residuals", "as given"
    #: Noise of B at each pair's median measurement, root mean square over axes, by pair
    rotation_rad: dict[Pair, float]
    translation_m: dict[Pair, float]
    carriers: str  #: The noise of A, in words
    #: All that the data say about the noise of A and B, in time and over the configuration; None where B's alone was
    #: estimated, or noise was given
    model: NoiseInData | None = None
    simple: str = ""  #: Why B's alone was estimated; empty with a model
    #: Whether the model of all noise could not be computed, or the noise that was stated for A not used
    has_failed: bool = False
    #: Whether that model was asked for, and could not run: what it would have found is not known
    is_unchecked: bool = False

    def __str__(self) -> str:
        if self.model is not None:
            return str(self.model)
        if not self.rotation_rad:
            return f"Noise of B: {self.source}. Noise of A: {self.carriers}."
        degrees = [math.degrees(value) for value in self.rotation_rad.values()]
        millimetres = [1e3 * value for value in self.translation_m.values()]
        return (
            f"Noise of B: {_span(degrees)}° and {_span(millimetres)} mm for each axis of a typical measurement, "
            f"{self.source}. Noise of A: "
            f"{self.carriers}."
        )


def _span(values: list[float]) -> str:
    low, high = rounded(min(values)), rounded(max(values))
    return low if low == high else f"{low} to {high}"


#: Where nothing could be estimated.
NOT_KNOWN = NoiseFound("not known", {}, {}, "not known")


#: An answer that would still move by more standard deviations is not at its optimum.
UNSETTLED = 1.0
#: Noise is found at most this many times; between them, inliers are chosen anew.
MAX_CHOICES = 4


def estimated(
    problem: Problem, solution: Solution, inliers: Inliers, options: CalibrateOptions, progress: Progress
) -> tuple[Refined, NoiseFound, Inliers]:
    """The refined calibration of the inliers under the noise that is found, a record of this noise, and the inliers.

    Inliers are chosen again under the noise that is found, until they stay the same.

    ``inliers`` is empty where every measurement counts; ``solution`` is the certified one of the inliers. This alone
    decides by which model the noise is found: the whole one of ``noise_model``, or ``refine`` with the noise of B
    alone, if noise is given, by groups, or A's with covariances, or if the whole model lacks measurements or fails.

    Raises
    ------
    NoiseError, CountError
        The measurements are too few for the noise.
    """
    kept = agreeing(problem, inliers)
    residual = "geodesic" if problem.has_measurements else "chordal"
    how = options.refinement(offsets_of(kept, options), residual=residual)
    # the whole model holds standard deviations of A, and no covariances
    stated = options.carrier_noise
    is_asked = options.noise != "given" and options.noise_groups == "all"
    # Who asks for other noise has chosen; the residuals are still compared with noise that is given.
    why, failed, unchecked = "a model of all noise was not asked for", False, False
    if not problem.has_measurements:
        why = "the raw measurements were not kept"
    elif is_asked and (stated is None or stated.covariances is None):
        try:
            return _by_the_whole_model(problem, solution, how, options, inliers, progress)
        except CountError as error:
            why, unchecked = str(error), True
        except (np.linalg.LinAlgError, RuntimeError) as error:  # noises many orders apart, in LAPACK or in GTSAM
            why, failed = f"that of A and B together could not be computed ({error})", True
    try:
        refined = refine(kept, solution, how, progress=progress)
    except NoiseError as error:
        if options.noise == "auto" and not problem.is_relative:
            refined = refine(kept, solution, replace(how, noise="given"), progress=progress)
        elif options.noise != "given" and options.carrier_noise is not None:  # it is more than the residuals hold
            why, failed = f"the noise that was stated for A was not used: {error}", True
            options = replace(options, carrier_noise=None)
            refined = refine(kept, solution, replace(how, carrier_noise=None), progress=progress)
        else:
            raise
    counts = {pair: (int(mask.sum()), len(mask)) for pair, mask in inliers.items()}
    noise = replace(_noise_of(refined, options, None, why), has_failed=failed, is_unchecked=unchecked)
    return replace(refined, inliers=inliers, inlier_counts=counts), noise, inliers


def _by_the_whole_model(
    problem: Problem,
    solution: Solution,
    how: RefineOptions,
    options: CalibrateOptions,
    inliers: Inliers,
    progress: Progress,
) -> tuple[Refined, NoiseFound, Inliers]:
    stated: dict[Component, float] = {}
    side = options.hand
    if options.carrier_noise is not None:
        stated = {
            Component.CARRIER_ROTATION: options.carrier_noise.rotation_rad,
            Component.CARRIER_TRANSLATION: options.carrier_noise.translation_m,
        }
        side = options.carrier_noise.about
    if problem.is_of_registrations:
        # Thousands of points tell what is known of each view. Errors that all views share show in no residuals.
        stated |= {Component.ROTATION: 1.0, Component.TRANSLATION: 1.0}
    arm = options.systematic
    if isinstance(arm, ArmAccuracy):
        stated |= {
            Component.SYSTEMATIC_ROTATION: arm.rotation_rad / CONSTANT,
            Component.SYSTEMATIC_TRANSLATION: arm.translation_m / CONSTANT,
        }
    noise = NoiseOptions(stated=stated, drift=options.drift, systematic=arm is not False, side=side)
    how = replace(how, carrier_noise=None)
    before, choices = None, 0
    while True:
        found = under_noise(agreeing(problem, inliers), solution, how, noise, before=before, progress=progress)
        choices += 1
        if not inliers or choices == MAX_CHOICES:
            break
        progress("judging outliers again")
        again = found.agreeing(problem, inliers)
        if all(np.array_equal(mask, inliers[pair]) for pair, mask in again.items()):
            break
        inliers, before = again, found.settled
        solution = solve(agreeing(problem, inliers), options=options.solve, progress=progress)
    progress("covariances")
    refined, noise_found = found.refined(inliers)
    return refined, _noise_of(refined, options, noise_found), inliers


def _noise_of(refined: Refined, options: CalibrateOptions, model: NoiseInData | None, why: str = "") -> NoiseFound:
    return NoiseFound(
        source="estimated from the residuals" if refined.noise_source == "estimated" else "as given",
        rotation_rad={pair: noise.rotation_rad for pair, noise in refined.noise.items()},
        translation_m={pair: noise.translation_m for pair, noise in refined.noise.items()},
        carriers="as given" if options.carrier_noise is not None else "none, A counts as exact",
        model=model,
        simple=why,
    )


def refined_under_its_noise(
    run: Run, solution: Solution, inliers: Inliers
) -> tuple[Refined | None, NoiseFound, Solution, Inliers]:
    """The refined calibration under the noise that is found, this noise, the certified solution, and the inliers.

    Inliers are judged again under the noise, so the last two may differ from those that were given.
    """
    record, number = run.record, run.problem.number_of_measurements
    run.tell("refining")
    try:
        # A log's were chosen under each detection's own noise, and stay. Registrations state theirs to hundredths of a
        # millimetre, beside which errors of the carriers, as they are found here, look like outliers.
        keeps = run.recording is not None and run.agreed is not None and not run.problem.directed
        if keeps and inliers:
            refined, noise, _ = estimated(agreeing(run.problem, inliers), solution, {}, run.options, run.tell)
            refined = replace(refined, inliers=inliers)
        else:
            refined, noise, inliers = estimated(run.problem, solution, inliers, run.options, run.tell)
    except (NoiseError, CountError, ScaleError, UnderdeterminedError) as error:
        record.choose(REFINEMENT, "none", f"the noise cannot be found: {error}")
        words = f"the {number} measurements are too few to tell how well the poses are known"
        record.find(Ground.NO_COVARIANCE, str(error) if isinstance(error, ScaleError) else words)
        return None, NOT_KNOWN, solution, inliers
    spare = spare_equations(agreeing(run.problem, inliers))
    if run.options.noise == "given" or refined.noise_source == "given":
        is_option = run.options.noise == "given"
        why = run.says_so if is_option else "the residuals are too few to estimate it"
        record.choose("noise of B", "as given", why)
        ratio = contradicted_by(refined.cost, spare)
        if ratio is not None:  # standard deviations are too small by this factor
            words = f"the residuals are {rounded(math.sqrt(ratio))} times as large as the stated noise allows"
            record.find(Ground.NOISE_UNDERSTATED, words)
    elif noise.model is None:
        record.choose("noise", "that of B alone is estimated", noise.simple)
        if noise.has_failed:
            words = "the standard deviations lack the noise of A and errors that vary with the configuration"
            record.find(Ground.COVARIANCE_DOUBTED, words)
    else:
        kept = sum(int(mask.sum()) for mask in inliers.values()) or number
        _say_sizes(run, noise.model, f"that is what the residuals of {kept} measurements show")
        ratio = overstated_by(refined.cost, spare) if run.options.carrier_noise is not None else None
        if ratio is not None:  # deviations are then too large
            times = f"{rounded(1.0 / math.sqrt(ratio))} times"
            words = f"the residuals are far smaller ({times}) than the noise that you stated for A makes them"
            record.find(Ground.NOISE_OVERSTATED, words)
        if noise.model.farthest > UNSETTLED:
            moves = f"the answer would still move by {rounded(noise.model.farthest)} standard deviations"
            record.find(Ground.COVARIANCE_DOUBTED, f"answer and noise do not settle: {moves}")
        for clock in noise.model.clocks:
            if clock.is_sure:
                record.choose(f"rate of the clock of {clock.sensor}", "estimated, and taken off", str(clock))
        _say_drift(run, noise.model)
        _say_lasting(run, noise.model)
        _say_systematic(run, noise.model)
        _say_blocks(run, noise.model)
    arm = run.options.systematic
    if isinstance(arm, ArmAccuracy):
        size = f"{rounded(math.degrees(arm.rotation_rad))}° and {rounded(1e3 * arm.translation_m)} mm for each axis"
        record.choose("accuracy of the arm", f"{size}, as you stated", run.says_so)
    # Of measurements that are too few to estimate any noise, the verdict says so.
    if noise.is_unchecked and (refined.noise_source == "given" or spare >= SPARE_EQUATIONS):
        words = "noise of A, drift and errors that vary with the configuration were not looked for"
        record.find(Ground.NOT_CHECKED, f"{words}: {noise.simple}")
    return refined, noise, refined.solution, inliers


def moves_of_arm(refined: Refined, options: CalibrateOptions) -> list[dict[str, Array]]:
    """How errors of an arm's stated accuracy move the frames of each carrier, where no model of the noise has them.

    An error c of A, constant at the hand, moves X by Ad(X^-1) c; one at the base moves Y alike.
    """
    arm = options.systematic
    if not isinstance(arm, ArmAccuracy):
        return []
    c = np.repeat([arm.rotation_rad, arm.translation_m], 3)
    return [{name: pose.inverse().AdjointMap() * c for name, pose in poses.items()} for poses in (refined.X, refined.Y)]


def _say_sizes(run: Run, model: NoiseInData, shown: str) -> None:
    """Record the size of the noise in one line; the notes of ``model`` have the rest."""
    stated = run.options.carrier_noise
    if stated is None:
        run.record.choose("noise of A and B", f"estimated, for each axis {model.size_words}", shown)
        return
    run.record.choose("noise of B", f"estimated, for each axis {model.size_words_of_B}", f"{shown} beside A's")
    size = f"{rounded(math.degrees(stated.rotation_rad))}° and {rounded(1e3 * stated.translation_m)} mm for each axis"
    run.record.choose("noise of A", f"{size}, as you stated", run.says_so)


def _say_drift(run: Run, model: NoiseInData) -> None:
    """Record whether errors of neighbours in time are alike."""
    what, record = "drift", run.record
    if model.correlation is not None:
        kind = "a random walk" if model.correlation == 1.0 else f"errors correlated by {model.correlation:g} a step"
        clock = "" if model.has_stamps else "; a late clock looks like this too, and there are no stamps to tell"
        record.choose(
            what,
            f"{kind}; {model.instants} frames are worth about {model.worth:.0f}",
            f"a model in which neighbours in time share errors explains the residuals far better "
            f"({ratio_words(model.drift_evidence)}){clock}",
        )
    elif model.is_drift_doubted:
        many = "more pairs are measured at the same instants than its model can hold"
        few = model.drift_not_sought or "no model of it explains the residuals far better"
        evidence = few if model.is_short else many
        record.choose(what, "seen, and not modelled; blocks of time widen the standard deviations", evidence)
    elif run.options.drift == "none":
        record.choose(what, "none", run.says_so)
    elif model.drift_not_sought:
        # No finding: few instants hardly drift, and these have neighbours no more alike than chance makes them.
        record.choose(what, "no model of it was tried", model.drift_not_sought)
    else:
        order = "" if model.has_stamps else " (rows are taken to be in order of time, since they have no stamps)"
        record.choose(what, "none", f"errors of neighbours in time are no more alike than others{order}")
    is_asked = model.correlation is not None and run.options.drift != "auto"
    if model.is_drift_doubted and not is_asked:
        words = "no model holds them; blocks of time widened the standard deviations, which may still be too small"
        if model.is_short:
            words = (
                f"{model.instants} instants are too few to tell how; the standard deviations may be too small "
                "(a mount or a target that gave way does this, too)"
            )
        record.find(Ground.CORRELATED, f"errors of neighbours in time are alike, and {words}")


def _say_lasting(run: Run, model: NoiseInData) -> None:
    """Record whether errors last, of the view or in time; if the covariance is mostly theirs, add a finding."""
    lasting = model.lasting
    if lasting is None or lasting.ratio <= TOLD_RATIO:
        return
    larger = f"{rounded(math.sqrt(lasting.ratio))} times as large for it"
    evidence = "measurements that are near each other, in time or in what the sensor sees, err alike"
    probable = f"{100.0 * lasting.probability:.0f} % probable"
    run.record.choose("errors that last", f"{probable}; the standard deviations are {larger}", evidence)
    if lasting.is_by_far:
        run.record.find(Ground.CORRELATED, f"{evidence} and do not average out; standard deviations are {larger}")


def _say_blocks(run: Run, model: NoiseInData) -> None:
    """Record whether blocks of the log agree as well as the noise allows; if they do not by far, add a finding."""
    if not model.scatter:
        return
    worst = model.worst
    if worst is None:
        run.record.choose("blocks of the log", "agree as well as the noise allows", str(model.scatter[0]))
        return
    run.record.choose("blocks of the log", "do not agree; the standard deviations are larger for it", str(worst))
    if worst.is_by_far and not model.is_drift_doubted:  # which is said
        words = f"{worst}: errors are of another kind than any model of the noise that was tried, and last for long"
        moved = " (a mount or a target that gave way does this, too)" if worst.by == "time" else ""
        run.record.find(Ground.CORRELATED, f"{words}{moved}")


def _say_systematic(run: Run, model: NoiseInData) -> None:
    """Record whether errors depend on the configuration; if they do, add a finding."""
    what, record = "systematic errors", run.record
    if not model.arms_assumed:
        record.choose(what, "none", run.says_so)
        return
    tried = "a model with errors that vary with the carriers' configuration explains the residuals"
    if not model.has_systematic:
        how = "hardly" if model.systematic_evidence > 1.0 else "no"
        record.choose(
            what,
            f"none found; what hides is in the covariances as {100.0 * model.systematic_probability:.0f} % probable",
            f"{tried} {how} better ({ratio_words(model.systematic_evidence)}; more than {MOST_BY_CHANCE:g} counts)",
        )
        return
    evidence = f"{tried} far better ({ratio_words(model.systematic_evidence)}; more than {MOST_BY_CHANCE:g} counts)"
    record.choose(what, "found, and in the covariances", evidence)
    words = f"errors vary with the configuration of the carriers: {model.systematic_words}"
    if not model.has_stamps:
        words += (
            "; it may also be a late clock, which looks like this where there are no stamps: give stamps, or stand "
            "still at each pose"
        )
    record.find(Ground.SYSTEMATIC, words)
