"""The stage that looks for outliers: which measurements agree, and the certified solution of these."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from gtsam_rwhec.calibration.choices import OUTLIERS
from gtsam_rwhec.calibration.disagreement import contradicted_frames
from gtsam_rwhec.calibration.gross_errors import gross_errors
from gtsam_rwhec.calibration.noise_choice import Inliers, offsets_of
from gtsam_rwhec.calibration.outliers import Outliers, few_words
from gtsam_rwhec.calibration.plausibility import implausible
from gtsam_rwhec.calibration.run import Run
from gtsam_rwhec.calibration.second_choice import more_consistent
from gtsam_rwhec.calibration.stated_poses import stated_poses
from gtsam_rwhec.calibration.verdict import Ground
from gtsam_rwhec.errors import NoiseError, OutlierError, ScaleError
from gtsam_rwhec.fitting.fit_options import RefineOptions
from gtsam_rwhec.fitting.refinement_from_poses import refine
from gtsam_rwhec.fitting.truncated_least_squares import graduated
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import selected
from gtsam_rwhec.solving.certified_solution import solve
from gtsam_rwhec.solving.solution import Solution

#: Without at least so many equations more than unknowns a wrong measurement cannot be told from the others: it has six
#: of its own, and the rest must tell noise from it.
SPARE_EQUATIONS = 24
#: The share of the measurements that agree where the noise is about right.
HALF = 0.5
#: Of so large a share of outliers the verdict says something.
MANY = 0.3
#: Of fewer measurements than this, more than this share of outliers under the stated noise may be a noise stated too
#: small: so it is where under the noise that the residuals show none is left out.
FEW, MANY_OF_FEW = 20, 0.25
#: So many that agree, with residuals of a sensor, are right, and the others are outliers.
MAJORITY = 0.6


def without_outliers(
    run: Run, first: Solution | None, clearly_off: tuple[str, ...] = ()
) -> tuple[Solution | None, Inliers]:
    """The certified solution of the measurements that agree, and which these are: empty where every one counts.

    Parameters
    ----------
    run : Run
    first : Solution or None
        The certified solution of all measurements; None where it has no positive scale.
    clearly_off : tuple of str
        Sensors whose clocks are clearly off. That makes some of what moves an outlier, so they are taken along.
    """
    problem, options, record = run.problem, run.options, run.record
    spare = spare_equations(problem)
    if options.robust == "none":
        record.choose(OUTLIERS, "every measurement counts", "an option says so")
        if gross := gross_errors(problem):
            record.find(Ground.OUTLIERS_KEPT, str(gross))
        return first, {}
    if not problem.has_measurements:
        record.choose(OUTLIERS, "every measurement counts", "the raw measurements were not kept")
        return first, {}
    if options.robust == "auto" and spare < SPARE_EQUATIONS:
        record.choose(
            OUTLIERS,
            "not looked for",
            f"{problem.number_of_measurements} measurements are too few to tell a wrong one from the others; "
            f"{-((spare - SPARE_EQUATIONS) // 6)} more would do",
        )
        return first, {}
    offsets = clearly_off or offsets_of(problem, options)
    try:
        solution, inliers = _agreeing(run, first, offsets)
        other = more_consistent(problem, inliers)
        if other is not None:
            solution, inliers = solve(selected(problem, other), options=options.solve), other
        return solution, inliers
    except (OutlierError, NoiseError, ScaleError) as error:
        record.choose(OUTLIERS, "not left out", f"it is not possible: {error}")
        words = "too few measurements agree with one another to find out which are wrong"
        record.find(Ground.CONTRADICTED, words)
        return first, {}


def _agreeing(run: Run, first: Solution | None, offsets: bool | tuple[str, ...]) -> tuple[Solution, Inliers]:
    """The certified solution of the measurements that agree, and which these are.

    Under a stated noise that is far too small nearly nothing agrees. Where most agree under the noise that the
    residuals show, that noise decides; the stage of the noise says then that the stated one is too small.
    """
    if run.options.noise != "given":
        return _agreeing_under(run, first, offsets, "estimate")
    try:
        found = _agreeing_under(run, first, offsets, "given")
        share = _share_kept(found[1])
        is_doubtful = run.problem.number_of_measurements < FEW and share < 1.0 - MANY_OF_FEW
        if share > HALF and not is_doubtful:
            return found
    except (OutlierError, NoiseError, ScaleError) as error:
        found, share, why = None, 0.0, error
    try:
        other = _agreeing_under(run, first, offsets, "estimate")
    except (OutlierError, NoiseError, ScaleError):
        other = None
    if other is not None and (_share_kept(other[1]) == 1.0 or (_share_kept(other[1]) > HALF >= share)):
        return other
    if found is None:
        raise why
    return found


def _share_kept(inliers: Inliers) -> float:
    return float(np.concatenate(list(inliers.values())).mean())


def _agreeing_under(
    run: Run, first: Solution | None, offsets: bool | tuple[str, ...], noise: Literal["given", "estimate"]
) -> tuple[Solution, Inliers]:
    problem, options = run.problem, run.options
    has_more = problem.has_covariances or options.carrier_noise is not None or bool(offsets)
    if first is not None and has_more:
        return _inliers_under_the_full_noise(run, first, offsets, noise)
    found = graduated(problem, confidence=options.inlier_confidence, noise_scale=noise, progress=run.tell)
    return found.solution, found.inliers


def _inliers_under_the_full_noise(
    run: Run, first: Solution, offsets: bool | tuple[str, ...], noise: Literal["given", "estimate"]
) -> tuple[Solution, Inliers]:
    """Inliers where sigma and kappa do not hold the whole noise: ``refine`` chooses them again under it."""
    options = run.options
    how = RefineOptions(
        noise=noise,
        noise_groups=options.noise_groups,
        robust="gnc",
        inlier_confidence=options.inlier_confidence,
        carrier_noise=options.carrier_noise,
        carrier_model="propagated",
        time_offsets=offsets,
        carrier_path=options.carrier_path if offsets else None,
    )
    try:
        refined = refine(run.problem, first, how, progress=run.tell)
    except NoiseError:
        if options.carrier_noise is None:
            raise
        # More noise is stated for A than the residuals hold. They are judged by what they show, and again under
        # the noise that is found.
        refined = refine(run.problem, first, replace(how, carrier_noise=None), progress=run.tell)
    return refined.solution, refined.inliers


def share_that_agrees_plausibly(run: Run, first: Solution | None) -> float | None:
    """The share of the measurements that agree with one another, with residuals that a sensor may have.

    None where fewer than ``MAJORITY`` do: then outliers do not explain what is wrong with the others.
    """
    attempt = run.attempt()
    solution, inliers = without_outliers(attempt, first)
    if solution is None or not inliers or _share_kept(inliers) < MAJORITY:
        return None
    return None if implausible(selected(run.problem, inliers), solution) else _share_kept(inliers)


def say_outliers(run: Run, inliers: Inliers) -> None:
    """The choice of outliers, where they were looked for."""
    if inliers:
        outliers = Outliers.of(run.problem, inliers)
        run.record.choices.append(outliers.choice("they are farther off than the noise of the others explains"))


def outliers_of(run: Run, inliers: Inliers, *, is_answered: bool) -> Outliers:
    """The outliers as a record; what they say against frames is found, and what they leave too little of."""
    outliers = Outliers.of(run.problem, inliers)
    sensors = run.problem.sensors
    contradicted = contradicted_frames(outliers.counts)
    for frame in contradicted:
        run.record.find(Ground.CONTRADICTED if frame.frame in sensors else Ground.TARGET_CONTRADICTED, str(frame))
    for name in outliers.left_out:
        if name in sensors:
            words = f"{name} has no pose, because no measurement of it is in the answer"
            run.record.find(Ground.NO_ANSWER, words)
    number = sum(len(mask) for mask in inliers.values())
    left_out = sum(int((~mask).sum()) for mask in inliers.values())
    if left_out > MANY * number and not contradicted:
        words = f"{left_out} of {number} measurements contradict the answer and were left out"
        run.record.find(Ground.MANY_OUTLIERS, words)
    if is_answered:
        known = {frame.frame for frame in contradicted} | set(stated_poses(run.problem))
        for name, number in outliers.resting_on_few.items():
            if name not in known:
                run.record.find(Ground.FEW_MEASUREMENTS, few_words(name, number))
    return outliers


def spare_equations(problem: Problem) -> int:
    """How many more equations than unknowns there are: six for each measurement, and those of priors."""
    free = [name for name in (*problem.targets, *problem.sensors) if name not in problem.fixed]
    beliefs = [prior for name in free for prior in problem.priors.get(name, [])]
    scales = {"known": 0, "shared": 1}.get(problem.scale)
    if scales is None:
        scales = len({pair.target for pair in problem.pairs} - set(problem.fixed_scales))
    known = sum(3 * (prior.sigma is not None) + 3 * (prior.kappa is not None) for prior in beliefs)
    return 6 * problem.number_of_measurements + known - 6 * len(free) - scales
