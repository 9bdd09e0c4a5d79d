"""Corrections before the answer: A at the clock offsets, and estimated sizes in place of stated ones that do not fit.

Where A lies on a path of the carriers, it is known at any instant: A is taken again at the offsets that were found,
until these stay the same. A wrong size makes outliers, and a late clock too: both are found before outliers count.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from gtsam_rwhec.calibration.calibrate_options import Inliers, Run, agreeing, offsets_of, with_sizes_of
from gtsam_rwhec.calibration.from_corners import CornersFound, with_estimated_intrinsics
from gtsam_rwhec.calibration.outliers import refined_with_outliers
from gtsam_rwhec.calibration.sizes import TargetSize, free_scale, refined_by, sizes_in
from gtsam_rwhec.errors import (
    CountError,
    NoiseError,
    OutlierError,
    RwhecError,
    RwhecWarning,
    ScaleError,
    UnderdeterminedError,
)
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.refinement_from_poses import refine
from gtsam_rwhec.fitting.robust_solution import NoiseScale
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.problem.measurements import Measurements, Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import summed_again
from gtsam_rwhec.solver.solution import Solution, solve

#: A is taken again at new offsets at most so many times.
ROUNDS = 6
#: Offsets that change by less (s) have converged: the answer estimates the rest.
SAME_S = 1e-4
#: A lies on a path if its entries equal those of the path within this.
ON_PATH = 1e-9


@dataclass(frozen=True, eq=False)
class _Settled:
    """A problem with A at the offsets, these offsets (s), and the refinement of the inliers that estimated them."""

    problem: Problem
    moved_s: dict[str, float]
    refined: Refined | None = None
    inliers: Inliers = field(default_factory=dict)


def settled_measurements(run: Run) -> tuple[Run, tuple[TargetSize, ...], CornersFound | None]:
    """The run with A at the clocks' offsets and with sizes that are estimated; sizes; what a log's corners give.

    A stays as it was if options leave clocks to the data, A lies on no path, or no measurements agree.
    """
    problem, options = run.problem, run.options
    if not problem.has_measurements:
        return run, (), None
    if options.time_offsets == "auto":
        if options.sizes == "estimate" and problem.scale == "known":
            run = replace(run, problem=with_free_sizes(problem, problem.targets), stated=problem)
        return run, (), None
    looks_at_sizes = options.sizes in ("correct", "estimate") and problem.scale != "shared"
    if not looks_at_sizes and not _asked(problem, run) and run.recording is None:
        return run, (), None
    sizes: tuple[TargetSize, ...] = ()
    targets = [name for name in problem.targets if name not in _estimated(problem)]
    if options.sizes == "correct":
        # Not those of clouds: the first fits have no noise of A, beside which registrations contradict their lengths.
        measured = {pair.target for pair in problem.pairs if pair not in problem.directed}
        targets = [name for name in targets if name in measured]
    now = _Settled(problem, dict(run.moved_s))
    if looks_at_sizes and targets:
        run.tell("looking at the targets' sizes")
        free = targets
        if options.sizes == "correct":
            told = _told(run, with_free_sizes(problem, targets), now.moved_s)
            if told is not None and told.refined is not None:
                sizes = tuple(size for size in sizes_in(told.refined) if size.target in targets)
                now = replace(told, problem=with_sizes_of(told.problem, problem))
            free = [size.target for size in sizes if size.is_doubted]
        if free:
            now = replace(now, problem=with_free_sizes(now.problem, free))
    stated = None if now.problem.scale == problem.scale else problem
    told = _told(run, now.problem, now.moved_s)
    now = told or now
    run = replace(run, problem=now.problem, stated=stated, moved_s=now.moved_s)
    if told is None or told.refined is None:
        return run, sizes, None
    by, inliers = None, told.inliers
    if run.recording is not None:
        if options.sizes == "check" and problem.scale == "known":
            sizes = _sizes_as_seen(run, told.inliers, told.refined)
        better, by, inliers = with_estimated_intrinsics(run, told.refined, told.inliers)
        if better.times > run.times:
            again, other_sizes, other = settled_measurements(better)
            if other is not None and other.corners is not None:
                return again, other_sizes, other
        else:
            run = better
    return replace(run, agreed=_agreed(run, inliers)), sizes, by


def _sizes_as_seen(run: Run, inliers: Inliers, near: Refined) -> tuple[TargetSize, ...]:
    """Sizes that count as known, estimated from the measurements that agree; empty if none is determined."""
    kept = agreeing(run.problem, inliers)
    free = with_free_sizes(kept, kept.targets)
    how = run.options.refinement(_asked(kept, run), noise_groups="all", carrier_model="propagated")
    try:
        with warnings.catch_warnings(action="ignore", category=RwhecWarning):  # the answer takes the stated sizes
            return tuple(sizes_in(refine(free, solve(free, options=run.options.solve), how, near=near)))
    except RwhecError:  # harmless: the stated sizes are compared with the answer then
        return ()


def _agreed(run: Run, inliers: Inliers) -> tuple[Solution, Inliers] | None:
    """The measurements that agree and their certified solution; None where they are to be looked for again."""
    if run.options.robust == "none" or run.options.noise == "given" or not inliers:
        return None
    return run.solution_of(agreeing(run.problem, inliers)), inliers


def _told(run: Run, problem: Problem, moved_s: Mapping[str, float]) -> _Settled | None:
    """A at offsets that have converged, without outliers; None if no answer determines the offsets."""
    path, asked = run.options.carrier_path, _asked(problem, run)
    total = dict(moved_s)
    noise: NoiseScale = "given" if run.options.noise == "given" else "estimate"
    how = run.options.refinement(asked, noise_groups="all", carrier_model="propagated")
    try:
        with warnings.catch_warnings(action="ignore", category=RwhecWarning):  # users get those of the answer
            for _ in range(ROUNDS):
                solution, inliers, agree = _first(run, problem), Inliers(), None
                if run.options.robust != "none":
                    # The offsets of a log are nearly known from cleaning; those of other problems may be large, and
                    # make outliers.
                    beside = () if run.recording is not None else asked
                    agree = refined_with_outliers(replace(run, problem=problem), solution, beside, noise)
                    solution, inliers = agree.solution, agree.inliers
                refined = refined_by(agreeing(problem, inliers), solution, how, run.tell, agree)
                moved = refined.time_offsets_s
                if path is None or max(map(abs, moved.values()), default=0.0) < SAME_S:
                    break
                problem = paired_again(problem, path, moved)
                total |= {name: total.get(name, 0.0) + more for name, more in moved.items()}
    except (CountError, NoiseError, OutlierError, ScaleError, UnderdeterminedError):
        return None  # the answer estimates the offsets itself, and stated sizes are compared with it
    return _Settled(problem, total, refined, inliers)


def _first(run: Run, problem: Problem) -> Solution | None:
    """The certified solution of all measurements; None where it has no positive scale, and outliers are looked for."""
    try:
        return run.solution_of(problem)
    except ScaleError:
        if run.options.robust == "none":
            raise
        return None


def _asked(problem: Problem, run: Run) -> tuple[str, ...]:
    """The sensors whose clocks are asked for, where their A lies on the path."""
    path, asked = run.options.carrier_path, offsets_of(problem, run.options)
    names = tuple(problem.sensors) if asked is True else asked or ()
    return names if path is not None and names and lies_on(problem, path, names) else ()


def lies_on(problem: Problem, path: Trajectory, sensors: Collection[str]) -> bool:
    """Whether A of the sensors' measurements is that of a path at their stamps."""
    for pair in problem.pairs:
        if pair.sensor in sensors and not pair.is_motion:
            raw = problem.measurements(*pair)
            if raw.stamps_ns is None or not (np.abs(path.at(raw.stamps_ns)[0] - raw.A) < ON_PATH).all():
                return False
    return True


def paired_again(problem: Problem, path: Trajectory, offsets_s: Mapping[str, float]) -> Problem:
    """The problem with A of some sensors later by their offsets, s, along a path; their stamps are as much later."""

    def later(pair: Pair) -> Measurements:
        raw = problem.measurements(*pair)
        if pair.is_motion or raw.stamps_ns is None or pair.sensor not in offsets_s:
            return raw
        stamps_ns = raw.stamps_ns + round(1e9 * offsets_s[pair.sensor])
        return replace(raw, A=path.at(stamps_ns)[0], stamps_ns=stamps_ns)

    return problem.with_measurements({pair: later(pair) for pair in problem.pairs})


def with_free_sizes(problem: Problem, targets: Collection[str]) -> Problem:
    """The problem with the sizes of some targets estimated, beside those that are already."""
    free = {*targets, *_estimated(problem)}
    result = summed_again(problem)
    known = {pair.target: problem.fixed_scales.get(pair.target, 1.0) for pair in problem.pairs}
    result.scale = free_scale(problem)
    if result.scale == "per_target":
        result.fixed_scales = {name: scale for name, scale in known.items() if name not in free}
    return result


def _estimated(problem: Problem) -> set[str]:
    """Targets, and sensors with motions, whose scale is estimated."""
    if problem.scale == "known":
        return set()
    return {pair.target for pair in problem.pairs} - set(problem.fixed_scales)
