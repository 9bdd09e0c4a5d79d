"""The stage that looks for outliers: which measurements agree, and the certified solution of these."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from gtsam_rwhec.calibration.disagreement import contradicted_frames
from gtsam_rwhec.calibration.noise_choice import Inliers, offsets_of
from gtsam_rwhec.calibration.outliers import Outliers
from gtsam_rwhec.calibration.run import Run
from gtsam_rwhec.calibration.verdict import Ground
from gtsam_rwhec.errors import NoiseError, OutlierError, ScaleError
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.refinement.graduated import graduated
from gtsam_rwhec.refinement.options import RefineOptions
from gtsam_rwhec.refinement.refining import refine
from gtsam_rwhec.solving.solution import Solution

#: Without at least so many equations more than unknowns a wrong measurement cannot be told from the others: it has six
#: of its own, and the rest must tell noise from it.
SPARE_EQUATIONS = 24
WHAT = "outliers"


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
        record.choose(WHAT, "every measurement counts", "an option says so")
        return first, {}
    if not problem.has_measurements:
        record.choose(WHAT, "every measurement counts", "the raw measurements were not kept")
        return first, {}
    if options.robust == "auto" and spare < SPARE_EQUATIONS:
        record.choose(
            WHAT,
            "not looked for",
            f"{problem.number_of_measurements} measurements have {spare} equations more than unknowns, and to "
            f"find a wrong one takes {SPARE_EQUATIONS}",
        )
        return first, {}
    offsets = clearly_off or offsets_of(problem, options)
    has_more = problem.has_covariances or options.carrier_noise is not None or bool(offsets)
    noise: Literal["given", "estimate"] = "given" if options.noise == "given" else "estimate"
    try:
        if first is not None and has_more:
            return _inliers_under_the_full_noise(run, first, offsets)
        found = graduated(problem, confidence=options.inlier_confidence, noise_scale=noise, progress=run.tell)
    except (OutlierError, NoiseError, ScaleError) as error:
        record.choose(WHAT, "not left out", f"it is not possible: {error}")
        words = "too few measurements agree with one another to find out which are wrong"
        record.find(Ground.CONTRADICTED, words)
        return first, {}
    return found.solution, found.inliers


def _inliers_under_the_full_noise(
    run: Run, first: Solution, offsets: bool | tuple[str, ...]
) -> tuple[Solution, Inliers]:
    """Inliers where sigma and kappa do not hold the whole noise: ``refine`` chooses them again under it."""
    options = run.options
    how = RefineOptions(
        noise="given" if options.noise == "given" else "estimate",
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


def say_outliers(run: Run, inliers: Inliers) -> None:
    """The choice of outliers, where they were looked for."""
    number = sum(int((~mask).sum()) for mask in inliers.values())
    if inliers and number == 0:
        run.record.choose(WHAT, "none", "every measurement agrees with the others")
    elif inliers:
        run.record.choose(
            WHAT,
            f"{number} of {run.problem.number_of_measurements} measurements were left out",
            "they are farther off than good measurements are",
        )


def outliers_of(run: Run, inliers: Inliers) -> Outliers:
    """The outliers as a record; what they say against frames is found."""
    problem = run.problem
    counts = {
        pair: (int(inliers[pair].sum()) if inliers else problem.moments(*pair).count, problem.moments(*pair).count)
        for pair in problem.pairs
    }
    for frame in contradicted_frames(counts):
        is_sensor = frame.frame in problem.sensors
        run.record.find(Ground.CONTRADICTED if is_sensor else Ground.TARGET_CONTRADICTED, str(frame))
    left = {name for pair, (kept, _) in counts.items() if kept for name in pair}
    left_out = tuple(name for name in (*problem.sensors, *problem.targets) if name not in left)
    for name in left_out:
        if name in problem.sensors:
            words = f"{name} has no pose, because no measurement of it is in the answer"
            run.record.find(Ground.NO_ANSWER, words)
    return Outliers(inliers, counts, left_out, looked_for=bool(inliers))


def spare_equations(problem: Problem) -> int:
    """How many more equations than unknowns there are: six for each measurement, and those of priors."""
    free = [name for name in (*problem.targets, *problem.sensors) if name not in problem.fixed]
    beliefs = [prior for name in free for prior in problem.priors.get(name, [])]
    scales = {"known": 0, "shared": 1}.get(problem.scale)
    if scales is None:
        scales = len({pair.target for pair in problem.pairs} - set(problem.fixed_scales))
    known = sum(3 * (prior.sigma is not None) + 3 * (prior.kappa is not None) for prior in beliefs)
    return 6 * problem.number_of_measurements + known - 6 * len(free) - scales
