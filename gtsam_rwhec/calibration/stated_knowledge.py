"""Tests of what the user stated against the measurements: poses, sizes, and that each frame has one pose.

With a wrong stated pose the answer is a compromise, whose residuals are taken for noise. So the pose is estimated
without the statement, and compared with it under both covariances.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from gtsam_rwhec.calibration.calibrate_options import Inliers, Run, agreeing
from gtsam_rwhec.calibration.moved_frames import (
    AtStations,
    Measured,
    TwoPoses,
    measured_of,
    mixed_sensors,
    moved_at_the_end,
    moved_with_outliers,
    outliers_drift,
    residuals_at_stations,
    step_of,
    two_poses,
)
from gtsam_rwhec.calibration.noise_choice import estimated
from gtsam_rwhec.calibration.outliers import Outliers, contradicted_frames
from gtsam_rwhec.calibration.row_shifts import between_rows
from gtsam_rwhec.calibration.sizes import TargetSize, common_factor, sizes
from gtsam_rwhec.calibration.verdict import Ground
from gtsam_rwhec.errors import RwhecError
from gtsam_rwhec.files.progress import silent
from gtsam_rwhec.files.terminal_text import rounded
from gtsam_rwhec.fitting.noise_in_data import NoiseInData
from gtsam_rwhec.fitting.noise_search import CORRELATED, likeness_of_neighbours
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.robust_solution import robust_solution
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import CONTRADICTION_SIGMAS, Prior
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.solution import solve

#: The probability that a correct stated pose is contradicted.
CHANCE = 1e-6
#: Below this probability a stated pose is doubted: 3.5 standard deviations of one number, as for sizes.
DOUBTFUL_CHANCE = 4.65e-4
#: A stated pose with a smaller error (degrees, m) is not wrong, but its standard deviation is too small.
SMALL_DEG, SMALL_M = 0.5, 0.005
#: Standard deviations of the prior that holds what the motion leaves free, m and rad.
LOOSE_M, LOOSE_RAD = 10.0, 1.0


@dataclass(frozen=True)
class StatedPose:
    """A stated pose that the measurements contradict; ``str()`` is one sentence."""

    frame: str
    #: The distance of the measured pose from the stated one; 0 for a part that was not stated
    rotation_deg: float
    translation_m: float
    sigmas: float  #: The same in standard deviations of their difference
    is_surely_off: bool = True  #: Whether the measurements contradict it beyond chance; otherwise it fits them badly

    @property
    def is_small(self) -> bool:
        """Whether the answer hardly depends on it."""
        return self.rotation_deg < SMALL_DEG and self.translation_m < SMALL_M

    def __str__(self) -> str:
        off = f"{rounded(self.rotation_deg)} deg and {rounded(1e3 * self.translation_m, 3)} mm"
        return (
            f"the stated pose of {self.frame} is {off} from the pose that the measurements give "
            f"({rounded(self.sigmas)} standard deviations)"
        )


def stated_poses(problem: Problem) -> dict[str, list[Prior]]:
    """What was stated of each frame that is measured; a fixed pose counts as a prior without noise."""
    found = {
        name: [Prior(problem.fixed[name], 0.0, math.inf)] if name in problem.fixed else problem.priors.get(name, [])
        for name in (*problem.targets, *problem.sensors)
    }
    return {name: priors for name, priors in found.items() if priors}


def _without(problem: Problem, loose: Mapping[str, list[Prior]]) -> Problem:
    """The problem without what was stated of frames; those of ``loose`` keep the pose with a large noise."""
    without = copy.copy(problem)  # the measurements are shared, what was stated is not
    without.fixed, without.priors = {}, {}
    for name, priors in loose.items():
        without.add_prior(name, priors[0].transform, LOOSE_M, 0.5 / LOOSE_RAD**2)
    return without


def _compared(name: str, prior: Prior, refined: Refined) -> StatedPose | None:
    """The stated pose, if it is contradicted."""
    pose: gtsam.Pose3 = (refined.X | refined.Y)[name]
    difference: Array = gtsam.Pose3.Logmap(gtsam.Pose3(prior.transform).between(pose))
    variance = np.zeros(6)
    variance[:3] = 0.0 if prior.kappa is None else 0.5 / prior.kappa
    variance[3:] = 0.0 if prior.sigma is None else prior.sigma**2
    told = np.repeat([prior.kappa is not None, prior.sigma is not None], 3)
    both = (refined.covariance(name) + np.diag(variance))[np.ix_(told, told)]
    squared = float(difference[told] @ np.linalg.lstsq(both, difference[told], rcond=None)[0])
    limit = refined.squared_radius(int(told.sum()), 1.0 - CHANCE)
    if squared < refined.squared_radius(int(told.sum()), 1.0 - DOUBTFUL_CHANCE):
        return None
    turned_rad = 0.0 if prior.kappa is None else float(np.linalg.norm(difference[:3]))
    moved_m = 0.0 if prior.sigma is None else float(np.linalg.norm(pose.translation() - prior.transform[:3, 3]))
    return StatedPose(
        name, math.degrees(turned_rad), moved_m, math.sqrt(squared), squared >= max(limit, CONTRADICTION_SIGMAS**2)
    )


def doubt_stated_poses(run: Run, refined: Refined, inliers: Inliers) -> None:
    """Record findings for priors and fixed poses that the measurements contradict, or that fit them badly."""
    stated = stated_poses(run.problem)
    if not stated:
        return
    run.tell("comparing the stated poses with the measurements")
    options = replace(run.options, time_offsets=tuple(refined.time_offsets_s))
    has_outliers = any(not mask.all() for mask in inliers.values())
    found: list[StatedPose] = []
    untold = ""
    without = _without(run.problem, {})
    for is_last in (False, True):
        try:
            agree = robust_solution(without, noise_scale="estimate").inliers if has_outliers else {}
            solution = solve(agreeing(without, agree), options=options.solve)
            alone = estimated(without, solution, agree, options, silent)[0]
        except (RwhecError, np.linalg.LinAlgError):  # without what was stated there is no answer to compare with
            alone = None
        free = {}
        for name, priors in stated.items():
            if alone is None or name not in alone.names or not np.isfinite(alone.covariance(name)).all():
                free[name] = priors
            else:
                found += [one for prior in priors if (one := _compared(name, prior, alone)) is not None]
        if is_last and alone is None:
            untold = ", ".join(stated)
        if is_last or not free:
            break
        stated = free
        without = _without(run.problem, free)  # what the motion leaves free is held loosely in the second round
    for one in found:
        off = Ground.COVARIANCE_DOUBTED if one.is_small else Ground.POSE_DOUBTED
        run.record.find(off if one.is_surely_off else Ground.POSE_UNCERTAIN, str(one))
    if untold:
        words = f"the stated poses of {untold} could not be compared with the measurements, which give none alone"
        run.record.find(Ground.NOT_CHECKED, words)
    if untold and not found:
        run.record.choose("stated poses", "as stated", "the measurements alone give no answer to compare them with")
        return
    chosen, do = ("as stated, and doubted", "") if found else ("as stated", "do not ")
    run.record.choose("stated poses", chosen, f"the measurements {do}contradict them")


def doubt_one_pose(run: Run, refined: Refined, inliers: Inliers) -> dict[str, Array]:
    """Record a finding for a frame that was at two poses, or a sensor that is two, or for poses beside their rows.

    Returns the error of these, as one that moves frames by so much (6, 1), also where it is less than sure.
    """
    if any(finding.ground is Ground.LATE_CLOCK for finding in run.record.findings):
        return {}  # a late clock makes such groups
    measured = measured_of(run.problem, inliers)
    at = residuals_at_stations(refined, measured)
    found = two_poses(at) or _moved(run, at, measured) or moved_with_outliers(refined, measured)
    found = found or moved_at_the_end(refined, measured) or mixed_sensors(refined, measured)
    if found is not None:
        run.record.find(Ground.MIXED if found.by_turns else Ground.MOVED, str(found))
        return {}
    outliers = Outliers.of(run.problem, inliers)
    if not contradicted_frames(outliers.counts) and outliers_drift(refined, measured):
        alike = "were left out, but are off in the same way as their neighbours: a frame drifts or moved"
        run.record.find(Ground.CORRELATED, f"{outliers.by_pair} {alike}")
    if not run.problem.directed and (late := between_rows(refined, measured)) is not None:
        if late.chance <= DOUBTFUL_CHANCE:
            run.record.find(Ground.LATE_POSES, str(late))
        return late.moves
    return {}


def _moved(run: Run, at: Mapping[Pair, AtStations], measured: Mapping[Pair, Measured]) -> TwoPoses | None:
    """A frame that moved once, where residuals of neighbours are alike, in the axes of either frame.

    What is left out may hide the likeness: the rest is then what fits between both poses.
    """
    alike = max(likeness_of_neighbours([one.twists[side] for one in at.values()]) for side in (0, 1))
    if alike < CORRELATED and all(one.kept.all() for one in measured.values()):
        return None
    run.tell("looking for a frame that moved")
    kept = {pair: one for pair, one in measured.items() if one.kept.any()}
    found = step_of(run.problem, {pair: (one.A[one.kept], one.B[one.kept]) for pair, one in kept.items()})
    if found is None or found[0].from_row is None:
        return None if found is None else found[0]
    (mask,) = (one.kept for pair, one in kept.items() if found[0].frame in pair.frames)
    return replace(found[0], from_row=int(np.flatnonzero(mask)[found[0].from_row - 1]) + 1)


def doubt_stated_sizes(
    run: Run, refined: Refined, inliers: Inliers, like: NoiseInData | None
) -> tuple[TargetSize, ...]:
    """Estimate the sizes that were stated as known; record findings for those that the motion contradicts.

    Where sizes were to be corrected, none could be estimated before: then they are checked here.
    """
    problem, options, record, what = run.problem, run.options, run.record, "sizes of targets"
    if problem.scale != "known" or options.sizes == "estimate":
        return ()
    if options.sizes == "known":
        record.choose(what, "as stated", run.says_so)
        return ()
    how = options.refinement(tuple(refined.time_offsets_s))
    # The measurements of a target with a wrong size may be outliers: then all of them are used, not only inliers.
    kept = {pair: mask if 2 * mask.sum() > len(mask) else np.ones(len(mask), bool) for pair, mask in inliers.items()}
    found = sizes(agreeing(problem, kept), how, like=like, progress=run.tell)
    doubted = [size for size in found if size.is_doubted]
    untested = ", ".join(size.target for size in found if size.is_untested)
    if untested:
        words = f"the stated size of {untested} could not be compared with the motion: it hangs on few measurements"
        record.find(Ground.NOT_CHECKED, words)
    together = common_factor(found)
    uncertain = [size for size in found if size.is_uncertain]
    if together:
        record.find(Ground.SIZE_DOUBTED, together)
    else:
        for size in (*doubted, *uncertain):
            record.find(Ground.SIZE_DOUBTED if size.is_doubted else Ground.SIZE_UNCERTAIN, str(size))
    if doubted or uncertain or together:
        record.choose(what, "as stated, and doubted", "the motion contradicts them")
    elif off := [size for size in found if size.may_be_off]:
        words = "; ".join(map(str, off))
        record.choose(what, "as stated, and the poses' standard deviations hold that they may be wrong", words)
    elif any(size.sigma is not None for size in found):
        record.choose(what, "as stated", "the motion does not contradict them")
    else:
        record.choose(what, "as stated", "the motion does not tell them, so a wrong size would not show")
    return found


def say_estimated_sizes(run: Run, found: Sequence[TargetSize], refined: Refined) -> None:
    """Stated sizes that the motion contradicts, and that were estimated in their place.

    Where another stated size fits the motion, the unit of A and the focal lengths are right, and the poses rest on it.
    Where none does, any of the three may be wrong; the focal lengths only where they were not estimated too.
    """
    if run.options.sizes != "correct":
        return
    told = [size for size in found if size.sigma is not None]
    doubted = [size for size in told if size.is_doubted]
    what = "sizes of targets"
    if not doubted:
        why = "does not contradict them" if told else "does not tell them, so a wrong size would not show"
        run.record.choose(what, "as stated", f"the motion {why}")
        return
    names = ", ".join(size.target for size in doubted)
    run.record.choose(what, f"estimated for {names}", "the motion contradicts the stated ones")
    words = "; ".join(map(str, doubted))
    if len(doubted) < len(told):
        run.record.find(Ground.SIZE_ESTIMATED, f"{words}; the poses use the size that the motion gives")
        return
    others = "unit of lengths in A" if refined.intrinsics else "unit of lengths in A or the focal lengths"
    why = f"nothing tells whether the sizes are wrong or the {others}"
    run.record.find(Ground.NO_SIZE_FITS, f"{words}; the poses use the sizes that the motion gives, and {why}")
