"""The stage that finds the noise and refines: what was chosen of the noise, and on which evidence."""

from __future__ import annotations

from gtsam_rwhec.calibration.choices import REFINEMENT
from gtsam_rwhec.calibration.noise_choice import Inliers, estimated
from gtsam_rwhec.calibration.noise_found import NOT_KNOWN, NoiseFound
from gtsam_rwhec.calibration.run import Run
from gtsam_rwhec.calibration.verdict import Ground
from gtsam_rwhec.errors import CountError, NoiseError, UnderdeterminedError
from gtsam_rwhec.noise_model.found import NoiseInData
from gtsam_rwhec.refinement.refined import Refined
from gtsam_rwhec.solving.solution import Solution


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
    elif refined.noise_source == "given":
        record.choose("noise of B", "as given", "the residuals are too few to estimate it")
    elif noise.model is None:
        record.choose("noise", "that of B alone is estimated", noise.simple)
        if noise.has_failed:
            words = "the standard deviations lack the noise of A and errors that vary with the configuration"
            record.find(Ground.COVARIANCE_DOUBTED, words)
    else:
        equations = 6 * run.problem.number_of_measurements
        record.choose("noise of A and B", "each is estimated", f"from {equations} residuals by restricted likelihood")
        _say_drift(run, noise.model)
        _say_systematic(run, noise.model)
    return refined, noise, refined.solution, inliers


def _say_drift(run: Run, model: NoiseInData) -> None:
    """Whether errors of neighbours in time are alike."""
    what, record = "drift", run.record
    if model.is_drift_untried:
        record.choose(what, "not modelled", "too many pairs are measured at the same instants")
        words = "errors of neighbours in time are alike, so the standard deviations may be too small"
        record.find(Ground.CORRELATED, words)
    elif model.correlation is None:
        is_told = run.options.drift == "none"
        why = "an option says so" if is_told else "neighbours in time are no more alike than others"
        record.choose(what, "none", why)
    else:
        kind = "a random walk" if model.correlation == 1.0 else f"errors correlated by {model.correlation:g} a step"
        record.choose(
            what,
            f"{kind}; {model.instants} frames are worth about {model.worth:.0f}",
            f"2 log likelihood rises by {model.drift_evidence:.0f}",
        )


def _say_systematic(run: Run, model: NoiseInData) -> None:
    """Whether errors depend on the configuration, which is a finding too."""
    what, record = "systematic errors", run.record
    if not model.arms_assumed:
        record.choose(what, "none", "an option says so")
        return
    evidence = f"2 log likelihood changes by {model.systematic_evidence:.0f}"
    if not model.has_systematic:
        record.choose(what, "not found; the covariances hold those that may be there", evidence)
        return
    record.choose(what, "found, and in the covariances", evidence)
    words = f"errors vary with the configuration of the carriers: {model.systematic_words}"
    record.find(Ground.SYSTEMATIC, words)
