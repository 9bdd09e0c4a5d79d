"""Solving in rounds: outliers, then time offsets, again and again until both stay the same; the targets' sizes."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.calibration.calibrate_options import CalibrateOptions
from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.misreadings import Misreading, exchange_of, reading_of
from gtsam_rwhec.calibration.stages import calibrate
from gtsam_rwhec.errors import RwhecError, RwhecWarning, ScaleError
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.fitting.fit_options import RefineOptions
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.refinement_from_poses import refine
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.results.log_history import SizeFields
from gtsam_rwhec.results.removed_measurements import RemovalReason
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.carrier_motion import CarrierMotion
from gtsam_rwhec.runs.measured_pairs import MeasuredPairs, problem_of
from gtsam_rwhec.solver.solution import solve

Pairs = dict[Pair, MeasuredPairs]
#: A solution serves to find outliers, to estimate time offsets, as the answer, or for plots of what was misread.
Purpose = Literal["outliers", "time offsets", "answer", "plots"]
#: Reasons for which cleaning removes a measurement that does not agree with the carriers' motion.
OF_THE_MOTION = (RemovalReason.NO_CONSENSUS, RemovalReason.ROTATION_OFF, RemovalReason.TRANSLATION_OFF)
#: Words of a misreading of B alone, or of A and B.
OF_B = re.compile(r"of B |of A and B |^B is |^A and B are")
#: At most this many rounds estimate outliers and time offsets, and compute A again at the new time offsets.
ROUNDS = 6
#: Seconds. If no time offset changes by more than this, the rounds end.
SETTLED_S = 2e-5
#: Seconds. If no time offset changes by more than this, outliers are not searched for again.
SAME_OUTLIERS_S = 1e-4


@dataclass(frozen=True, eq=False)
class SynchronisedPairs:
    """Measured pairs by (target, sensor), with A at their sensors' time offsets; these offsets, seconds."""

    pairs: Pairs
    offsets_s: dict[str, float]


@dataclass(frozen=True, eq=False)
class SolvingRounds:
    """Solves and refines the problem of a log again and again; `estimated` has the sensors with a free time offset."""

    rig: Rig
    motion: CarrierMotion
    estimated: tuple[str, ...]
    progress: Progress

    def settled(
        self, given: SynchronisedPairs, free_sizes: Collection[str]
    ) -> tuple[SynchronisedPairs, Refined | None]:
        """Mark outliers and estimate time offsets until neither changes.

        Each round finds outliers at the present time offsets, then time offsets without the outliers. Beside the pairs
        is the refinement that says that no time offset changes; None where there is none.
        """
        last: Refined | None = None
        outliers: dict[Pair, np.ndarray] = {}
        everything = marked = given
        for _ in range(ROUNDS):
            before = everything.offsets_s
            is_same = True
            if self.rig.cleaning.robust == "gnc":
                inliers = self.refined(everything, free_sizes, "outliers").inliers
                is_same = outliers.keys() == inliers.keys() and all(
                    np.array_equal(outliers[pair], mask) for pair, mask in inliers.items()
                )
                outliers = inliers
                marked = SynchronisedPairs(with_outliers_marked(everything.pairs, inliers), before)
            for _ in range(ROUNDS if self.estimated else 0):
                found = self.refined(marked, free_sizes, "time offsets")
                change = found.time_offsets_s
                offsets = marked.offsets_s | {name: marked.offsets_s[name] + value for name, value in change.items()}
                everything, marked = self.at(everything.pairs, offsets), self.at(marked.pairs, offsets)
                if max(abs(value) for value in change.values()) < SETTLED_S:
                    last = found
                    break
                last = None
            moved = max((abs(marked.offsets_s[name] - before[name]) for name in self.estimated), default=0.0)
            if is_same or moved < SAME_OUTLIERS_S:
                break
        return marked, last

    def misreadings(self, given: SynchronisedPairs) -> tuple[Misreading, ...]:
        """Likely misreadings of the poses, at least exchanged carriers, before any measurement is left out.

        What cleaning removed because it does not agree with the carriers' motion counts: a misreading makes it so.
        """
        problem = problem_of(without_marks(given.pairs, OF_THE_MOTION), self.rig, given.offsets_s)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RwhecWarning)
            try:
                found = self._misread(problem)
                if found and self.rig.carriers.poses.parent_and_child[0] == self.rig.carriers.targets:
                    # A is the inverse of the poses as they were written, and those were misread.
                    found = min(found, self._misread(turned_round(problem)) or found, key=_is_left)
            except ScaleError:
                return ()
            exchanged = exchange_of(problem).misreading if not found else None
            return found if exchanged is None else (exchanged,)

    def _misread(self, problem: Problem) -> tuple[Misreading, ...]:
        """Likely misreadings of a problem; what this library itself found in images was not misread."""
        found = reading_of(problem, solve(problem, progress=self.progress), self.progress).misreadings
        if any(sensor.images is None for sensor in self.rig.sensors.values()):
            return found
        return tuple(one for one in found if not OF_B.search(one.likely)) or found

    def may_be_exchanged(self, given: SynchronisedPairs) -> bool:
        """Whether the measurements are too few to tell that the carriers are not exchanged."""
        return exchange_of(problem_of(given.pairs, self.rig, given.offsets_s)).is_open

    def at(self, pairs: Pairs, offsets_s: Mapping[str, float]) -> SynchronisedPairs:
        """The pairs with A at new time offsets. Pairs of sensors with a stated offset stay as they are."""
        path = self.motion.trajectory
        moved = {
            pair: measured.at(path, offsets_s[measured.sensor]) if measured.sensor in self.estimated else measured
            for pair, measured in pairs.items()
        }
        return SynchronisedPairs(moved, dict(offsets_s))

    def refined(self, given: SynchronisedPairs, free_sizes: Collection[str], purpose: Purpose) -> Refined:
        """One certified solution, refined.

        In the answer, measurements of one instant share the noise of A: this is slow, and makes the covariances right.
        For all other purposes the noise of A is propagated into each measurement separately.
        """
        problem = problem_of(given.pairs, self.rig, given.offsets_s, free_sizes)
        robust = self.rig.cleaning.robust
        if robust == "gnc" and purpose != "outliers":
            robust = "none"  # the outliers are marked already
        estimated = self.estimated if purpose in ("time offsets", "answer") else ()
        options = RefineOptions(
            noise="estimate" if self.rig.noise == "estimate" else "given",
            robust=robust,
            carrier_noise=self.motion.noise,
            carrier_model="auto" if purpose == "answer" else "propagated",
            time_offsets=estimated,
            carrier_path=self.motion.trajectory if estimated else None,
        )
        with warnings.catch_warnings():
            if purpose != "answer":
                warnings.simplefilter("ignore", RwhecWarning)
            solution = solve(problem, progress=self.progress)
            return refine(problem, solution, options, progress=self.progress)

    def calibrated(
        self, given: SynchronisedPairs, free_sizes: Collection[str], *, is_late: bool = False
    ) -> Calibration:
        """The answer from the measurements that are left, with everything that ``calibrate`` finds and judges.

        Where a clock was late, drift and systematic errors are not looked for: they would take its place.
        """
        problem = problem_of(given.pairs, self.rig, given.offsets_s, free_sizes)
        problem.sensor_carrier, problem.target_carrier = self.rig.carriers.sensors, self.rig.carriers.targets
        options = CalibrateOptions(
            noise="estimate" if self.rig.noise == "estimate" else "given",
            robust="none",  # the outliers are marked already
            sizes="known",  # the rounds have looked at them
            carrier_noise=self.motion.noise,
            drift="none" if is_late else "auto",
            systematic=not is_late,
            time_offsets=self.estimated or False,
            carrier_path=self.motion.trajectory if self.estimated else None,
        )
        return calibrate(problem, options, progress=self.progress)

    def sizes(self, given: SynchronisedPairs) -> tuple[tuple[SizeFields, ...], SynchronisedPairs]:
        """Estimate the sizes of all targets, and the time offsets that go with these sizes.

        A size is free in the answer if the rig file says estimate, or if the measurements contradict the stated size.
        """
        self.progress("looking at the targets' sizes")
        is_check = self.rig.sizes == "check"
        marked = given
        try:
            with warnings.catch_warnings():
                if is_check:  # users get only the warnings of the answer
                    warnings.simplefilter("ignore", RwhecWarning)
                marked, last = self.settled(given, self.rig.targets)
                refined = last or self.refined(marked, self.rig.targets, "time offsets")
        except ScaleError:
            if not is_check:
                raise
            return (), self.at(given.pairs, marked.offsets_s)
        sizes = self._sizes_in(refined)
        sizes = tuple(size.model_copy(update={"is_free": size.is_doubted or not is_check}) for size in sizes)
        return sizes, self.at(given.pairs, marked.offsets_s)

    def sizes_as_seen(self, given: SynchronisedPairs) -> tuple[SizeFields, ...]:
        """Measured scales of sizes that the solver takes as known, if the measurements determine them; else empty."""
        self.progress("looking at the targets' sizes")
        try:
            return self._sizes_in(self.refined(given, self.rig.targets, "time offsets"))
        except RwhecError:
            return ()  # the answer uses the stated sizes and does not need these estimates

    def _sizes_in(self, refined: Refined) -> tuple[SizeFields, ...]:
        assert not isinstance(refined.scale, float)
        stated = {target.name: target.length_m for target in self.rig.target_list}
        return tuple(
            SizeFields(
                target=target,
                stated_m=stated[target],
                scale=scale,
                sigma=sigma_of(refined, Unknown(UnknownKind.SCALE, target)),
                is_free=False,
            )
            for target, scale in refined.scale.items()
            if target in stated  # odometries have a scale of their own, and no size
        )


def sigma_of(refined: Refined, unknown: Unknown) -> float | None:
    """The standard deviation of a scalar, or None if it is infinite."""
    variance = float(refined.covariance(unknown)[0, 0])
    return math.sqrt(variance) if math.isfinite(variance) else None


def with_outliers_marked(pairs: Pairs, inliers: Mapping[Pair, np.ndarray]) -> Pairs:
    """The pairs with their outliers marked; `inliers` has a boolean for each used measurement of a pair."""
    result = {}
    for pair, measured in pairs.items():
        reasons = list(measured.reasons)
        if pair in inliers:
            for i in np.flatnonzero(measured.used)[~inliers[pair]].tolist():
                reasons[i] = RemovalReason.OUTLIER
        result[pair] = replace(measured, reasons=tuple(reasons))
    return result


def turned_round(problem: Problem) -> Problem:
    """The same measurements with A and B inverted, and targets and sensors exchanged: B^-1 = X^-1 A^-1 Y."""
    turned = Problem(problem.scale)
    for target, sensor in problem.pairs:
        measured = problem.measurements(target, sensor)
        turned.add(sensor, target, se3.inverse(measured.A), se3.inverse(measured.B))
    return turned


def _is_left(misreadings: tuple[Misreading, ...]) -> float:
    """The product of the residuals that the first reading leaves."""
    return misreadings[0].rotation_deg[1] * misreadings[0].translation_mm[1]


def without_marks(pairs: Pairs, reasons: Collection[str]) -> Pairs:
    """The pairs with the measurements that these reasons removed."""
    return {
        pair: replace(measured, reasons=tuple("" if why in reasons else why for why in measured.reasons))
        for pair, measured in pairs.items()
    }


def without_outlier_marks(pairs: Pairs) -> Pairs:
    """The pairs without marks of outliers: a log that was solved before is solved from the beginning."""
    return without_marks(pairs, (RemovalReason.OUTLIER,))
