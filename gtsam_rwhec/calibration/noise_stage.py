"""The stage that finds the noise and refines: what was chosen of the noise, and on which evidence."""

from __future__ import annotations

import math

from gtsam_rwhec.calibration.choices import REFINEMENT
from gtsam_rwhec.calibration.noise_choice import Inliers, estimated
from gtsam_rwhec.calibration.noise_found import NOT_KNOWN, NoiseFound
from gtsam_rwhec.calibration.outlier_stage import spare_equations
from gtsam_rwhec.calibration.run import Run
from gtsam_rwhec.calibration.verdict import Ground
from gtsam_rwhec.errors import CountError, NoiseError, UnderdeterminedError
from gtsam_rwhec.files.rounded_numbers import rounded
from gtsam_rwhec.fitting.noise_in_data import MOST_BY_CHANCE, NoiseInData, ratio_words
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.problem.selection import selected
from gtsam_rwhec.solving.solution import Solution
from gtsam_rwhec.solving.weights import contradicted_by, overstated_by


def refined_under_its_noise(
    run: Run, solution: Solution, inliers: Inliers
) -> tuple[Refined | None, NoiseFound, Solution, Inliers]:
    """The refined calibration under the noise that is found, this noise, the certified solution, and the inliers.

    Inliers are judged again under the noise, so the last two may differ from those that were given.
    """
    record = run.record
    run.tell("refining")
    try:
        refined, noise, inliers = estimated(run.problem, solution, inliers, run.options, run.tell)
    except (NoiseError, CountError, UnderdeterminedError) as error:
        record.choose(REFINEMENT, "none", f"the noise cannot be found: {error}")
        number = run.problem.number_of_measurements
        words = f"the {number} measurements are too few to tell how well the poses are known"
        record.find(Ground.NO_COVARIANCE, words)
        return None, NOT_KNOWN, solution, inliers
    if run.options.noise == "given":
        record.choose("noise of B", "as given", "an option says so")
        _doubt_stated_noise(run, refined, inliers)
    elif refined.noise_source == "given":
        record.choose("noise of B", "as given", "the residuals are too few to estimate it")
        _doubt_stated_noise(run, refined, inliers)
    elif noise.model is None:
        record.choose("noise", "that of B alone is estimated", noise.simple)
        if noise.has_failed:
            words = "the standard deviations lack the noise of A and errors that vary with the configuration"
            record.find(Ground.COVARIANCE_DOUBTED, words)
    else:
        _say_sizes(run, refined, noise.model, inliers)
        _say_drift(run, noise.model)
        _say_systematic(run, noise.model)
    return refined, noise, refined.solution, inliers


def _doubt_stated_noise(run: Run, refined: Refined, inliers: Inliers) -> None:
    """Noise that was stated, and is larger: then the standard deviations are too small by as much."""
    if refined.options.robust not in ("none", "gnc"):
        return  # the cost of another loss is no chi-square
    kept = selected(run.problem, inliers) if inliers else run.problem
    ratio = contradicted_by(refined.cost, spare_equations(kept))
    if ratio is not None:
        words = f"the residuals are {rounded(math.sqrt(ratio))} times as large as the stated noise allows"
        run.record.find(Ground.NOISE_UNDERSTATED, words)


def _say_sizes(run: Run, refined: Refined, model: NoiseInData, inliers: Inliers) -> None:
    """How large the noise is, in one line; ``model`` says the rest."""
    number = sum(int(mask.sum()) for mask in inliers.values()) or run.problem.number_of_measurements
    shown = f"that is what the residuals of {number} measurements show"
    stated = run.options.carrier_noise
    if stated is None:
        run.record.choose("noise of A and B", f"estimated, for each axis {model.size_words}", shown)
        return
    run.record.choose("noise of B", f"estimated, for each axis {model.size_words_of_B}", f"{shown} beside A's")
    size = f"{rounded(math.degrees(stated.rotation_rad))}° and {rounded(1e3 * stated.translation_m)} mm for each axis"
    run.record.choose("noise of A", f"{size}, as you stated", "an option says so")
    _doubt_noise_of_A(run, refined, inliers)


def _doubt_noise_of_A(run: Run, refined: Refined, inliers: Inliers) -> None:
    """Noise that was stated for A, and is far larger than the residuals: then the standard deviations are too large."""
    kept = selected(run.problem, inliers) if inliers else run.problem
    ratio = overstated_by(refined.cost, spare_equations(kept))
    if ratio is not None:
        factor = rounded(1.0 / math.sqrt(ratio))
        words = f"the residuals are far smaller ({factor} times) than the noise that you stated for A makes them"
        run.record.find(Ground.NOISE_OVERSTATED, words)


def _say_drift(run: Run, model: NoiseInData) -> None:
    """Whether errors of neighbours in time are alike."""
    what, record = "drift", run.record
    if model.is_drift_untried:
        evidence = "more pairs are measured at the same instants than its model can hold"
        record.choose(what, "seen, and not modelled; blocks of time widen the standard deviations", evidence)
        words = (
            "errors of neighbours in time are alike, and no model holds them; the standard deviations were widened as "
            "blocks of time show, and may still be too small"
        )
        record.find(Ground.CORRELATED, words)
    elif model.correlation is None:
        if run.options.drift == "none":
            record.choose(what, "none", "an option says so")
        elif model.drift_not_sought:
            record.choose(what, "no model of it was tried", model.drift_not_sought)
        else:
            order = "" if model.has_stamps else " (rows are taken to be in order of time, since they have no stamps)"
            record.choose(what, "none", f"errors of neighbours in time are no more alike than others{order}")
    else:
        kind = "a random walk" if model.correlation == 1.0 else f"errors correlated by {model.correlation:g} a step"
        clock = "" if model.has_stamps else "; a late clock looks like this too, and there are no stamps to tell"
        record.choose(
            what,
            f"{kind}; {model.instants} frames are worth about {model.worth:.0f}",
            f"a model in which neighbours in time share errors explains the residuals far better "
            f"({ratio_words(model.drift_evidence)}){clock}",
        )


def _say_systematic(run: Run, model: NoiseInData) -> None:
    """Whether errors depend on the configuration, which is a finding too."""
    what, record = "systematic errors", run.record
    if not model.arms_assumed:
        record.choose(what, "none", "an option says so")
        return
    tried = "a model with errors that vary with the carriers' configuration explains the residuals"
    if not model.has_systematic:
        how = "hardly" if model.systematic_evidence > 1.0 else "no"
        record.choose(
            what,
            "none found; the covariances hold as much as could hide",
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
