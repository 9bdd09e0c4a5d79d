"""Third stage: synchronised pairs to a certified, refined calibration, with sizes and clocks looked into."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from gtsam_rwhec.errors import LogError, RwhecError, RwhecWarning, ScaleError
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.logs import open_log
from gtsam_rwhec.pipeline.carriers import Carriers, read_carriers
from gtsam_rwhec.pipeline.changed_rig import rig_for_solving
from gtsam_rwhec.pipeline.log_metadata import CLEANING, DETECTION, read_cameras, read_report
from gtsam_rwhec.pipeline.measured_pairs import MeasuredPairs, problem_of, read_pairs
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.refinement.options import RefineOptions
from gtsam_rwhec.refinement.refined import Refined
from gtsam_rwhec.refinement.refining import refine
from gtsam_rwhec.results.stage_reports import (
    CleaningReport,
    DetectionReport,
    LogFields,
    SizeFields,
    TimeOffsetFields,
    TrackCount,
    contradicted,
)
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.solving.certified_solution import solve
from gtsam_rwhec.vision.camera import Camera

Pairs = dict[Pair, MeasuredPairs]
Stage = Literal["outliers", "clocks", "answer"]
#: Why a measurement that came this far is not used.
OUTLIER = "outlier (robust estimation)"
#: Rounds of taking A anew at the refined time offsets, and the change (s) that ends them.
ROUNDS, SETTLED_S = 6, 2e-5
#: Clocks that change by less change no outliers.
SAME_OUTLIERS_S = 1e-4


@dataclass(frozen=True, eq=False)
class Calibrated:
    """A calibration from a log.

    Attributes
    ----------
    refined : Refined
        Poses, covariances, scales; ``time_offsets_s`` in full, not against the first guess.
    pairs : dict of (target, sensor) to MeasuredPairs
        Every measurement, with A at the final time offsets, and the reason for those that are not used.
    log : LogFields
        Where they came from and what became of them.
    cameras : dict of sensor to Camera
    rig : Rig
    """

    refined: Refined
    pairs: dict[Pair, MeasuredPairs]
    log: LogFields
    cameras: dict[str, Camera]
    rig: Rig


def solve_log(clean_path: str | Path, rig: Rig | None = None, *, progress: Progress | None = None) -> Calibrated:
    """Calibrate from a cleaned log.

    Parameters
    ----------
    clean_path
        What ``clean_log`` wrote.
    rig : Rig, optional
        Left out, the one that is embedded in the log.
    progress : callable, optional

    Raises
    ------
    LogError
        A log without pairs.
    RwhecError
        What ``solve`` and ``refine`` raise.
    """
    tell = progress or silent
    with open_log(clean_path) as log:
        rig = rig_for_solving(log, rig)
        cleaning = read_report(log, CLEANING, CleaningReport)
        detection = read_report(log, DETECTION, DetectionReport)
        cameras = read_cameras(log)
        pairs = read_pairs(log, rig)
        if not any(measured.used.any() for measured in pairs.values()):
            raise LogError(f"{clean_path}: no pair of measurements in it is to be used")
        carriers = read_carriers(log, rig)
    offsets = dict(cleaning.time_offsets_s)
    estimated = tuple(
        name for name, sensor in rig.sensors.items() if sensor.time_offset == "estimate" and _is_used(pairs, name)
    )
    missing = [name for name in estimated if name not in offsets]
    if missing:
        raise LogError(f"{clean_path}, metadata {CLEANING}: it has no time offset of {', '.join(missing)}")
    run = _Run(rig, carriers, estimated, tell)
    # A log that was solved before is solved anew: outliers and clocks as cleaning left them.
    pairs = run.at(_with_outliers(pairs), offsets)
    sizes: tuple[SizeFields, ...] = ()
    known: tuple[str, ...] = tuple(target.name for target in rig.target_list)
    if rig.sizes != "known":
        sizes, offsets = run.sizes(pairs, offsets)
        pairs = run.at(pairs, offsets)
        known = tuple(size.target for size in sizes if not size.is_free)
    scale: ScaleMode = "known" if rig.sizes == "known" or all(not s.is_free for s in sizes) else "per_target"
    pairs, offsets = run.settled(pairs, offsets, scale, known)
    if rig.sizes == "known":
        sizes = run.looked_into(pairs, offsets)
    refined = run.refined(pairs, offsets, scale, known, stage="answer")
    offsets |= {name: offsets[name] + value for name, value in refined.time_offsets_s.items()}
    outliers = tuple(_outlier_count(pair, measured) for pair, measured in pairs.items())
    refined = replace(
        refined,
        time_offsets_s={name: offsets[name] for name in estimated},
        inlier_counts={
            Pair(count.target, count.sensor): (count.used, count.used + sum(count.removed.values()))
            for count in outliers
            if rig.cleaning.robust == "gnc" and (count.used or count.removed)
        },
    )
    if scale == "per_target":  # what they came out as, with the others known
        sizes = tuple(_final(size, refined) if size.is_free else size for size in sizes)
    fields = LogFields(
        sensor_carrier=rig.carriers.sensors,
        target_carrier=rig.carriers.targets,
        detection=detection,
        cleaning=cleaning,
        outliers=outliers,
        sizes=sizes,
        time_offsets=tuple(
            TimeOffsetFields(
                sensor=name,
                offset_s=offsets[name],
                sigma_s=_sigma(refined, f"time_offset:{name}") if name in estimated else None,
            )
            for name in rig.sensors
            if name in offsets
        ),
        contradicted=contradicted(outliers),
    )
    return Calibrated(refined, pairs, fields, cameras, rig)


@dataclass(frozen=True, eq=False)
class _Run:
    """What stays the same from one solution to the next."""

    rig: Rig
    carriers: Carriers
    estimated: tuple[str, ...]
    tell: Progress

    def settled(
        self, pairs: Pairs, offsets: dict[str, float], scale: ScaleMode, known: tuple[str, ...]
    ) -> tuple[Pairs, dict[str, float]]:
        """Outliers marked, and time offsets with A taken anew at them, until neither changes.

        By turns: outliers with the clocks as they are, then clocks without the outliers.
        """
        outliers: dict[Pair, np.ndarray] = {}
        marked = pairs
        for _ in range(ROUNDS):
            before = dict(offsets)
            if self.rig.cleaning.robust == "gnc":
                found = self.refined(pairs, offsets, scale, known, stage="outliers")
                same = outliers.keys() == found.inliers.keys() and all(
                    np.array_equal(outliers[pair], mask) for pair, mask in found.inliers.items()
                )
                outliers, marked = found.inliers, without_outliers(pairs, found.inliers)
            else:
                same = True
            for _ in range(ROUNDS if self.estimated else 0):
                change = self.refined(marked, offsets, scale, known, stage="clocks").time_offsets_s
                offsets = offsets | {sensor: offsets[sensor] + value for sensor, value in change.items()}
                pairs, marked = self.at(pairs, offsets), self.at(marked, offsets)
                if max(abs(value) for value in change.values()) < SETTLED_S:
                    break
            moved = max((abs(offsets[sensor] - before[sensor]) for sensor in self.estimated), default=0.0)
            if same or moved < SAME_OUTLIERS_S:
                break
        return marked, offsets

    def at(self, pairs: Pairs, offsets: Mapping[str, float]) -> Pairs:
        """A anew at time offsets, where these were estimated; the others as cleaning left them."""
        return {
            pair: measured.at(self.carriers.trajectory, offsets[pair.sensor])
            if pair.sensor in self.estimated
            else measured
            for pair, measured in pairs.items()
        }

    def refined(
        self, pairs: Pairs, offsets: Mapping[str, float], scale: ScaleMode, known: tuple[str, ...], *, stage: Stage
    ) -> Refined:
        """One certified solution, refined.

        "outliers" and "clocks" are steps on the way, with A's noise carried into each measurement on its own; the
        "answer" lets measurements of one instant share it, which is slow and makes the covariances right.
        """
        problem = problem_of(pairs, self.rig, offsets, scale=scale, known_sizes=known if scale == "per_target" else ())
        robust = self.rig.cleaning.robust
        if robust == "gnc" and stage != "outliers":
            robust = "none"  # they are out already
        clocks = self.estimated if stage != "outliers" else ()
        options = RefineOptions(
            noise="estimate" if self.rig.noise == "estimate" else "given",
            robust=robust,
            carrier_noise=self.carriers.noise,
            carrier_model="auto" if stage == "answer" else "propagated",
            time_offsets=clocks,
            carrier_path=self.carriers.trajectory if clocks else None,
        )
        with warnings.catch_warnings():
            if stage != "answer":
                warnings.simplefilter("ignore", RwhecWarning)
            solution = solve(problem, progress=self.tell)
            return refine(problem, solution, options, progress=self.tell)

    def sizes(self, pairs: Pairs, offsets: dict[str, float]) -> tuple[tuple[SizeFields, ...], dict[str, float]]:
        """Every target's stated size against what all measurements say of it, and the clocks that go with that."""
        self.tell("looking at the targets' sizes")
        check = self.rig.sizes == "check"
        try:
            with warnings.catch_warnings():
                if check:  # a trial; of the answer everything is told
                    warnings.simplefilter("ignore", RwhecWarning)
                marked, offsets = self.settled(pairs, offsets, "per_target", ())
                refined = self.refined(marked, offsets, "per_target", (), stage="clocks")
        except ScaleError:
            if not check:
                raise
            return (), offsets
        sizes = self._found_sizes(refined)
        return tuple(s.model_copy(update={"is_free": s.is_doubted or not check}) for s in sizes), offsets

    def looked_into(self, pairs: Pairs, offsets: Mapping[str, float]) -> tuple[SizeFields, ...]:
        """What the measurements that are used say of sizes that were taken as known; none where they cannot tell."""
        self.tell("looking at the targets' sizes")
        try:
            return self._found_sizes(self.refined(pairs, offsets, "per_target", (), stage="clocks"))
        except RwhecError:
            return ()  # with sizes free there is no answer; nobody asked for one

    def _found_sizes(self, refined: Refined) -> tuple[SizeFields, ...]:
        assert not isinstance(refined.scale, float)
        stated = {target.name: target.length_m for target in self.rig.target_list}
        return tuple(
            SizeFields(
                target=target,
                stated_m=stated[target],
                scale=scale,
                sigma=_sigma(refined, f"scale:{target}"),
                is_free=False,
            )
            for target, scale in refined.scale.items()
        )


def _final(size: SizeFields, refined: Refined) -> SizeFields:
    assert not isinstance(refined.scale, float)
    scale = refined.scale[size.target]
    return size.model_copy(update={"scale": scale, "sigma": _sigma(refined, f"scale:{size.target}")})


def _sigma(refined: Refined, name: str) -> float | None:
    """None where it is infinite."""
    variance = float(refined.covariance(name)[0, 0])
    return math.sqrt(variance) if math.isfinite(variance) else None


def _is_used(pairs: Mapping[Pair, MeasuredPairs], sensor: str) -> bool:
    return any(measured.used.any() for pair, measured in pairs.items() if pair.sensor == sensor)


def without_outliers(pairs: Pairs, inliers: Mapping[Pair, np.ndarray]) -> Pairs:
    """Mark what the robust estimation left out; inliers (n,) are of each pair's measurements that were used."""
    result = {}
    for pair, measured in pairs.items():
        reasons = list(measured.reasons)
        if pair in inliers:
            for i in np.flatnonzero(measured.used)[~inliers[pair]].tolist():
                reasons[i] = OUTLIER
        result[pair] = replace(measured, reasons=tuple(reasons))
    return result


def _with_outliers(pairs: Pairs) -> Pairs:
    return {
        pair: replace(measured, reasons=tuple("" if why == OUTLIER else why for why in measured.reasons))
        for pair, measured in pairs.items()
    }


def _outlier_count(pair: Pair, measured: MeasuredPairs) -> TrackCount:
    out = measured.reasons.count(OUTLIER)
    return TrackCount(
        target=pair.target, sensor=pair.sensor, used=int(measured.used.sum()), removed={OUTLIER: out} if out else {}
    )
