"""The stage that asks the measurements about what the user stated: poses, sizes, and that each frame has one pose."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from gtsam_rwhec.calibration.moved_frames import moved_frame
from gtsam_rwhec.calibration.moved_outliers import Measured, moved_with_outliers
from gtsam_rwhec.calibration.noise_choice import Inliers, estimated
from gtsam_rwhec.calibration.run import Run
from gtsam_rwhec.calibration.sizes import TargetSize, common_factor, sizes
from gtsam_rwhec.calibration.stated_poses import contradicted_poses, stated_poses
from gtsam_rwhec.calibration.two_poses import TwoPoses, by_station, means_of, residual_twists, two_poses
from gtsam_rwhec.calibration.verdict import Ground
from gtsam_rwhec.errors import RwhecError
from gtsam_rwhec.files.progress import silent
from gtsam_rwhec.fitting.fit_options import RefineOptions
from gtsam_rwhec.fitting.noise_in_data import NoiseInData
from gtsam_rwhec.fitting.noise_search import CORRELATED, likeness_of_neighbours
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.truncated_least_squares import graduated
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import selected
from gtsam_rwhec.solving.certified_solution import solve


def doubt_stated_poses(run: Run, refined: Refined, inliers: Inliers) -> None:
    """Priors and fixed poses that the measurements contradict are found."""
    if not stated_poses(run.problem):
        return
    run.tell("comparing the stated poses with the measurements")
    options = replace(run.options, time_offsets=tuple(refined.time_offsets_s))
    with_outliers = any(not mask.all() for mask in inliers.values())

    def answer(without: Problem) -> Refined | None:
        try:
            agree = graduated(without, noise_scale="estimate").inliers if with_outliers else {}
            kept = selected(without, agree) if agree else without
            return estimated(without, solve(kept, options=options.solve), agree, options, silent)[0]
        except (RwhecError, np.linalg.LinAlgError):
            return None  # without what was stated there is no answer to compare with

    found = contradicted_poses(run.problem, answer)
    for one in found:
        off = Ground.COVARIANCE_DOUBTED if one.is_small else Ground.POSE_DOUBTED
        run.record.find(off if one.is_surely_off else Ground.POSE_UNCERTAIN, str(one))
    chosen, do = ("as stated, and doubted", "") if found else ("as stated", "do not ")
    run.record.choose("stated poses", chosen, f"the measurements {do}contradict them")


def doubt_one_pose(run: Run, refined: Refined, inliers: Inliers) -> None:
    """Frames that were at two poses are found."""
    if any(finding.ground is Ground.LATE_CLOCK for finding in run.record.findings):
        return  # a late clock makes such groups
    found = two_poses(run.problem, refined, inliers) or _moved(run, refined, inliers)
    found = found or moved_with_outliers(refined, _with_outliers(run.problem, inliers))
    if found is not None:
        run.record.find(Ground.MOVED, str(found))


def _with_outliers(problem: Problem, inliers: Inliers) -> dict[Pair, Measured]:
    """All measurements of the pairs of which some were left out, and of the others."""
    if not problem.has_measurements or not inliers:
        return {}
    raw = {pair: problem.measurements(*pair) for pair in inliers}
    return {pair: Measured(of.A, of.B, inliers[pair]) for pair, of in raw.items()}


def _moved(run: Run, refined: Refined, inliers: Inliers) -> TwoPoses | None:
    """A frame that moved once, where residuals of neighbours are alike."""
    if not run.problem.has_measurements:
        return None
    problem = selected(run.problem, inliers) if inliers else run.problem
    raw = {pair: problem.measurements(*pair) for pair in problem.pairs}
    tracks = [means_of(residual_twists(refined, pair, of.A, of.B)[0], by_station(of.A)[0]) for pair, of in raw.items()]
    if likeness_of_neighbours(tracks) < CORRELATED:
        return None
    run.tell("looking for a frame that moved")
    found = moved_frame(run.problem, {pair: (of.A, of.B) for pair, of in raw.items()})
    if found is None or found.from_row is None or not inliers:
        return found
    (mask,) = (mask for pair, mask in inliers.items() if found.frame in pair.frames)
    return replace(found, from_row=int(np.flatnonzero(mask)[found.from_row - 1]) + 1)


def doubt_stated_sizes(
    run: Run, refined: Refined, inliers: Inliers, like: NoiseInData | None
) -> tuple[TargetSize, ...]:
    """What the motion says about sizes that were said to be known; those that it contradicts are found."""
    problem, options, record, what = run.problem, run.options, run.record, "sizes of targets"
    if problem.scale != "known":
        return ()
    if options.sizes == "known":
        record.choose(what, "as stated", "an option says so")
        return ()
    noise: Literal["given", "estimate"] = "given" if options.noise == "given" else "estimate"
    late = tuple(refined.time_offsets_s)
    how = RefineOptions(
        noise=noise,
        noise_groups=options.noise_groups,
        carrier_noise=options.carrier_noise,
        time_offsets=late,
        carrier_path=options.carrier_path if late else None,
    )
    # A target of a wrong size contradicts the others: then all of its measurements are asked, not those that agree.
    kept = {pair: mask if 2 * mask.sum() > len(mask) else np.ones(len(mask), bool) for pair, mask in inliers.items()}
    found = sizes(selected(problem, kept) if kept else problem, how, like=like, progress=run.tell)
    doubted = [size for size in found if size.is_doubted]
    together = common_factor(found)
    uncertain = [size for size in found if size.is_uncertain]
    if together is not None:
        record.find(Ground.SIZE_DOUBTED, str(together))
    else:
        for size in doubted:
            record.find(Ground.SIZE_DOUBTED, str(size))
        for size in uncertain:
            record.find(Ground.SIZE_UNCERTAIN, str(size))
    if doubted or uncertain or together is not None:
        record.choose(what, "as stated, and doubted", "the motion contradicts them")
    elif any(size.sigma is not None for size in found):
        record.choose(what, "as stated", "the motion does not contradict them")
    else:
        record.choose(what, "as stated", "the motion does not tell them, so a wrong size would not show")
    return found
