"""``calibrate``: one call from a problem to the best answer that its measurements hold, with a verdict.

It solves, leaves outliers out, certifies what is kept, refines with the noise that the residuals show, and judges. A
step that is not possible is recorded as a choice; only input that cannot be used raises an error.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from rwhec_factors.se3 import inverse
from scipy.spatial.transform import Rotation

from gtsam_rwhec.calibration.calibrate_options import CalibrateOptions, Record, Recording, Run, agreeing
from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.clock_offsets import Answer, answer, check_offsets, late_in_place_of_shifted
from gtsam_rwhec.calibration.from_corners import (
    answered_by_corners,
    by_told_intrinsics,
    check_observations,
    with_better_poses,
)
from gtsam_rwhec.calibration.known_frames import of_knowledge
from gtsam_rwhec.calibration.misreadings import Reading, are_too_few_to_tell, misread_as_recorded, reading_of
from gtsam_rwhec.calibration.noise_choice import moves_of_arm
from gtsam_rwhec.calibration.other_readings import Mistake
from gtsam_rwhec.calibration.outliers import SPARE_EQUATIONS, outliers_of, share_that_agrees_plausibly, spare_equations
from gtsam_rwhec.calibration.point_uncertainty import Carriers, views_of
from gtsam_rwhec.calibration.settled_measurements import settled_measurements
from gtsam_rwhec.calibration.sizes import TargetSize, doubted_lengths, moves_of_sizes, undetectable
from gtsam_rwhec.calibration.slipped_rows import with_rows_shifted
from gtsam_rwhec.calibration.stated_knowledge import (
    doubt_one_pose,
    doubt_stated_poses,
    doubt_stated_sizes,
    say_estimated_sizes,
)
from gtsam_rwhec.calibration.trial_fits import implausible
from gtsam_rwhec.calibration.verdict import READING, Finding, Ground, Judgement, findings_of, proof_of
from gtsam_rwhec.errors import OptionError, RwhecError, ScaleError
from gtsam_rwhec.files.progress import Progress, check_progress, silent
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import check_kind
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import aligned_at, without_copies
from gtsam_rwhec.solver.free_directions import FreeDirection, FreeReason, all_slide
from gtsam_rwhec.solver.solution import Solution

#: Standard deviations about the axis with the second most turning: below this the carriers turned too little.
LITTLE_RAD = float(np.radians(2.0))
#: A motion is planar where what it moves along its axis is below this share of what it moves across it.
FLAT = 0.02


@dataclass(frozen=True)
class Turning:
    """How a carrier turned about its mean: standard deviations (3,) rad about its principal axes, the largest first.

    Tsai and Lenz (1989), section IV: the error of a hand-eye rotation falls with the sine of the angle between the axes
    of two motions, and that of its translation with the angle of the motions. So an arm that hardly turns magnifies
    every error that does not average out, and no residual shows it.
    """

    spread_rad: Array  #: (3,)
    #: Standard deviations of what it moved along the axis with most turning, and across it
    along_m: float
    across_m: float


def turning_of(A: Array) -> Turning:
    """How a carrier turned in poses A (N, 4, 4), T_sensorcarrier_targetcarrier."""
    moved = A @ inverse(A[:1])
    rotations = Rotation.from_matrix(moved[:, :3, :3])
    turns = (rotations * rotations.mean().inv()).as_rotvec()
    values, axes = np.linalg.eigh(turns.T @ turns / len(A))
    squares = (((moved[:, :3, 3] - moved[:, :3, 3].mean(axis=0)) @ axes) ** 2).mean(axis=0)
    return Turning(
        np.sqrt(np.maximum(values[::-1], 0.0)), float(np.sqrt(squares[2])), float(np.sqrt(squares[0] + squares[1]))
    )


def of_turning(
    problem: Problem, inliers: Mapping[Pair, np.ndarray], free: Iterable[FreeDirection], *, is_answered: bool
) -> list[Finding]:
    """Whether the carriers turned too little, or why their motion leaves a direction free.

    The sensor whose carrier turned most counts: where sensors see the same targets, it determines the others too.
    """
    if not problem.has_measurements or problem.fixed or problem.priors:
        return []
    found = [turning_of(A) for A in _of_sensors(problem, inliers).values() if len(A) > 2]
    if not found:
        return []
    most = max(found, key=lambda one: float(one.spread_rad[1]))
    reasons = {direction.reason for direction in free} - {FreeReason.SLIDES}  # which is of the thing, not of the motion
    if FreeReason.NO_ROTATION in reasons:
        return [Finding(Ground.NOT_UNIQUE, "too little rotation: the carriers hardly turn")]
    if FreeReason.ONE_AXIS in reasons:
        if most.along_m < FLAT * most.across_m:
            words = (
                f"planar motion: the carriers turn about one axis only, and move {1e3 * most.across_m:.0f} mm across "
                f"it but {1e3 * most.along_m:.1f} mm along it (standard deviations)"
            )
        else:
            words = "motion about one axis only: the carriers never turn about a second one"
        return [Finding(Ground.NOT_UNIQUE, words)]
    if reasons or not is_answered or most.spread_rad[1] >= LITTLE_RAD:
        return []
    first, second = (f"{np.degrees(spread):.2g} degrees" for spread in most.spread_rad[:2])
    words = (
        f"too little rotation: the carriers turn by {first} about one axis and {second} about a second one (standard "
        "deviations), which magnifies every error that does not average out, and no residual shows it"
    )
    return [Finding(Ground.LITTLE_ROTATION, words)]


def _of_sensors(problem: Problem, inliers: Mapping[Pair, np.ndarray]) -> dict[str, Array]:
    """The carriers' poses (N, 4, 4) in all kept measurements of each sensor."""
    of_sensor: dict[str, list[Array]] = {}
    for pair in problem.pairs:
        if not pair.is_motion:
            A = problem.measurements(*pair).A
            of_sensor.setdefault(pair.sensor, []).append(A[inliers[pair]] if pair in inliers else A)
    return {name: np.concatenate(parts) for name, parts in of_sensor.items()}


#: From fewer poses of the carriers their noise is not known, however often each was measured.
FEWEST_POSES = 6


@one_blas_thread()
def calibrate(
    problem: Problem,
    options: CalibrateOptions | None = None,
    *,
    recording: Recording | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Find the best answer that the measurements hold, with an uncertainty and a verdict.

    Parameters
    ----------
    problem : Problem
        With its raw measurements: without them, outliers are not looked for.
    options : CalibrateOptions, optional
        Each overrules one choice that is otherwise made from the data.
    recording : Recording, optional
        What `calibrate` uses of a log besides these measurements.
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
    check_kind(problem, Problem, "the problem", "a gtsam_rwhec.Problem")
    options = CalibrateOptions() if options is None else options
    check_kind(options, CalibrateOptions, "options", "a gtsam_rwhec.CalibrateOptions")
    check_progress(progress)
    problem.require_pairs()
    if options.noise == "given" and problem.is_relative:
        raise OptionError(
            "noise='given', but some measurements were added without sigma or kappa; take noise='auto', or add sigma "
            "and kappa"
        )
    _check_what_needs_measurements(problem, options)
    check_observations(problem, options)
    once = without_copies(problem) if recording is None else problem
    if once is not problem:
        found, number = calibrate(once, options, progress=progress), problem.number_of_measurements
        copies = number - once.number_of_measurements
        words = f"{copies} of {number} measurements are copies of others, to the last digit: each counts once"
        return replace(found, notes=(words, *found.notes))
    run = Run(problem, options, progress or silent, recording)
    check_offsets(run)
    if problem.directed:  # residuals of every stage are then those of what is measured
        first, _ = _solved(run)
        problem = problem if first is None else aligned_at(problem, first.X, first.Y, first.scale)
        run = replace(run, problem=problem)
    found = _calibrated(run)
    if recording is None or not recording.far_off or (found.refined is not None and found.refined.intrinsics):
        return found
    run.tell("computing the poses of targets again, with intrinsics that the images tell")
    try:
        again = _calibrated(by_told_intrinsics(run, recording.far_off))
    except RwhecError:  # no pose by these: what the stated ones gave is judged, and not to be used (far off)
        return found
    return again if again.refined is not None and again.refined.intrinsics else found


def _check_what_needs_measurements(problem: Problem, options: CalibrateOptions) -> None:
    """A MeasurementsNotKeptError for noise and offsets that moments do not hold."""
    if problem.has_covariances:
        problem.require_raw_measurements("a problem whose measurements have covariances (not sigma and kappa)")
    for name in ("carrier_noise", "carrier_path", "time_offsets"):
        if getattr(options, name) not in (None, "auto", False, ()):
            problem.require_raw_measurements(f"CalibrateOptions.{name}")
    if options.sizes == "estimate" and problem.scale == "known":
        problem.require_raw_measurements('CalibrateOptions.sizes="estimate" (or give the problem scale="per_target")')


def _calibrated(run: Run) -> Calibration:
    """All stages, one after the other, and their verdict."""
    found_sizes: tuple[TargetSize, ...] = ()
    by_corners, are_checked = None, False
    of_rows: dict[str, Array] = {}
    with run.record.noted():
        reading = misread_as_recorded(run)
        late = () if run.recording is None else run.recording.late
        if reading.finding is not None or late:
            first, why = _solved(run)
            run.record.choose(READING, "nothing else is computed", "the poses were misread, or are of another time")
            run.record.findings += [*([reading.finding] if reading.finding else []), *late]
            found = Answer(first)
        else:
            run, found_sizes, by_corners = settled_measurements(run)
            first, why = _solved(run)
            reading, found = _read_and_answered(run, first)
        repaired = _repaired(run, reading)
        if repaired is not None:
            return _calibrated(repaired)
        if run.options.repair and not run.is_repaired:
            run.record.choose("rows of A and B", "as they are", "none of them slipped")
        better, thin = with_better_poses(run, found)
        if better is not None:
            run.tell("once more, with the poses of targets that the answer says")
            return _calibrated(better)
        if found.refined is not None:
            doubt_stated_poses(run, found.refined, found.inliers)
            of_rows = doubt_one_pose(run, found.refined, found.inliers)
            if not found_sizes:
                found_sizes = doubt_stated_sizes(run, found.refined, found.inliers, found.noise.model)
                are_checked = run.problem.scale == "known"
            found = answered_by_corners(run, found, thin, by_corners)
            _doubt_untested_corners(run, found)
    problem, record = run.problem, run.record
    lengths = ""
    if found.solution is not None and not reading.misreadings:
        lengths = doubted_lengths(problem, found.solution)
    if lengths and (reading.finding is not None or not run.options.misreadings):
        record.find(Ground.MISREAD, lengths)
    elif lengths:
        record.start_again(Ground.MISREAD, lengths)
        record.choose(READING, "nothing else is told", "lengths of the answer are those of no rig")
        found, found_sizes = Answer(found.solution), ()
    elif reading.finding is not None:
        record.notes.clear()  # they warn of attempts at an answer that is not given
    solution, inliers = found.solution, found.inliers
    refined = found.refined
    if refined is not None:  # with offsets from the given stamps, including those that A was already corrected by
        offsets = {name: run.moved_s.get(name, 0.0) + more for name, more in refined.time_offsets_s.items()}
        refined = replace(refined, time_offsets_s=offsets)
        if not are_checked:
            say_estimated_sizes(run, found_sizes, refined)
    if solution is None:
        record.find(Ground.NO_SCALE, why)
    is_determined = refined is not None and all_slide(refined.free_directions)
    outliers = outliers_of(run, inliers, is_answered=is_determined)
    is_few = is_determined and spare_equations(problem) < SPARE_EQUATIONS
    if refined is not None and is_few and refined.noise_source == "estimated":
        words = f"{problem.number_of_measurements} measurements are too few to tell how large their noise is"
        record.find(Ground.COVARIANCE_DOUBTED, words)
    elif refined is not None and found.noise.model is not None and found.noise.model.instants < FEWEST_POSES:
        number = found.noise.model.instants
        words = f"all measurements come from {number} poses of the carriers, and each pose has one error"
        record.find(Ground.COVARIANCE_DOUBTED, words)
    if reading.finding is None and solution is not None:
        free = solution.identifiability.free_directions if refined is None else refined.free_directions
        record.findings += of_turning(problem, inliers, free, is_answered=refined is not None)
    if refined is not None:
        stated = found_sizes if problem.scale == "known" else ()
        untold = [size.untold(refined) for size in stated]
        record.findings += [Finding(Ground.SIZE_UNTOLD, words) for words in untold if words]
        of_sizes = moves_of_sizes([size for size, words in zip(stated, untold, strict=True) if not words])
        stretched = [one for one in problem.stretched.values() if one.is_clear]
        record.findings += [Finding(Ground.CLOUDS_STRETCHED, str(one)) for one in stretched]
        of_arm = () if found.noise.model is not None else moves_of_arm(refined, run.options)
        for moves in (*({name: of} for name, of in problem.alike_of_sensors.items()), *of_sizes, *of_arm, of_rows):
            refined = refined.with_errors(moves)
    best = solution if refined is None else refined
    views = {} if best is None else views_of(problem, inliers, best.scale)
    carriers = Carriers(problem.sensor_carrier, problem.target_carrier)
    if refined is not None and reading.finding is None:
        record.findings += of_knowledge(problem, inliers, refined, views, carriers)
    return Calibration(
        X={} if best is None else best.X,
        Y={} if best is None else best.Y,
        scale=math.nan if best is None else best.scale,
        time_offsets_s={} if refined is None else refined.time_offsets_s,
        judgement=Judgement.of([*findings_of(solution, refined), *record.findings], proof_of(refined)),
        solution=solution,
        refined=refined,
        noise=found.noise,
        outliers=outliers,
        misreadings=reading.misreadings,
        implausible=reading.implausible,
        sizes=found_sizes,
        cannot_tell=undetectable(problem, unit_is_told=bool(lengths)),
        findings=tuple(record.findings),
        choices=tuple(record.choices),
        notes=tuple(record.notes),
        views=views,
        carriers=carriers,
        options=run.options,
        problem=problem,
    )


def _repaired(run: Run, reading: Reading) -> Run | None:
    """A new run with rows of A and B where they belong; None where no option says so, or rows belong together."""
    one = reading.misreadings[0] if reading.misreadings else None
    if one is None or not one.shifts or not run.options.repair or run.is_repaired or run.recording is not None:
        return None
    again = replace(run, problem=with_rows_shifted(run.problem, one.shifts), record=Record(), is_repaired=True)
    left_out = run.problem.number_of_measurements - again.problem.number_of_measurements
    moved = sum(int((of != 0).sum()) for of in one.shifts.values()) - left_out
    number = "1 row was" if moved == 1 else f"{moved} rows were"
    words = f"{number} shifted and {left_out} left out, because {one.likely}"
    again.record.find(Ground.ROWS_REPAIRED, words)
    again.record.choose("rows of A and B", f"{number} shifted", "an option says so")
    return again


def _doubt_untested_corners(run: Run, found: Answer) -> None:
    """Record a finding where no image could be left out of a refinement from corners, to see how it is predicted."""
    numbers = None if found.refined is None else found.refined.reprojection
    if numbers is not None and all(one.held_out_px is None for one in numbers.sensors.values()):
        words = "systematic errors of the arm or of the targets were not looked for in images that are left out"
        run.record.find(Ground.NOT_CHECKED, f"{words}: there are too few images to leave some out")


def _solved(run: Run) -> tuple[Solution | None, str]:
    """The certified solution of all measurements; without one, why there is none."""
    try:
        return run.solution_of(run.problem), ""
    except ScaleError as error:
        return None, str(error)


def _read_and_answered(run: Run, first: Solution | None) -> tuple[Reading, Answer]:
    """How the poses were read, and the answer. If they were misread, the answer is only the first solution.

    Outliers alone may cause residuals that no sensor has: then the measurements that agree decide.
    """
    tries, problem, solution = run.options.misreadings, run.problem, first
    if run.agreed is not None:  # a log's poses were read, with those that cleaning removed, before
        solution, problem = run.agreed[0], agreeing(run.problem, run.agreed[1])
    reading = reading_of(problem, solution, run.tell) if tries else Reading(implausible=implausible(problem, solution))
    if reading.misreadings and all(one.mistake is Mistake.ROWS_SHIFTED for one in reading.misreadings):
        late = late_in_place_of_shifted(run, first)
        if late is not None:
            return Reading(), late
    why = ""
    if reading.finding is None:
        why = "no likely mistake of reading explains the measurements far better" if tries else "an option says so"
        if tries and are_too_few_to_tell(run.problem):
            why = f"{run.problem.number_of_measurements} measurements are too few to show a mistake of reading"
    elif reading.implausible is not None and (share := share_that_agrees_plausibly(run, first)) is not None:
        why = f"{100.0 * share:.0f} % of the measurements agree with one another, with residuals that a sensor may have"
        reading = Reading()
    if reading.finding is None:
        run.record.choose(READING, "as given", why)
        return reading, answer(run, first)
    why = "another reading of the poses fits far better" if reading.misreadings else "the residuals are of no sensor"
    run.record.choose(READING, "nothing else is computed", why)
    run.record.findings.append(reading.finding)
    return reading, Answer(first)
