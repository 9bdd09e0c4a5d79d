"""The pairs (A, B) of a cleaned log as arrays, and the problem that they make."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.errors import NoiseError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import Log, PairRecord
from gtsam_rwhec.pipeline.cleaning_stage import PAIR_TOPIC
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.trajectories.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class MeasuredPairs:
    """All measurements of one target by one sensor, those that are not used too.

    Attributes
    ----------
    stamps_ns : (N,) integers
        The sensor's.
    A, B : (N, 4, 4) arrays
        T_sensorcarrier_targetcarrier, T_sensor_target; metres.
    covariance : (N, 6, 6) array or None
        Of B.
    reasons : tuple of N str
        Empty for those that are used.
    """

    stamps_ns: np.ndarray
    A: Array
    B: Array
    covariance: Array | None
    reasons: tuple[str, ...]

    @property
    def used(self) -> np.ndarray:
        """(N,) booleans."""
        return np.array([not reason for reason in self.reasons], dtype=bool)

    def at(self, path: Trajectory, offset_s: float) -> MeasuredPairs:
        """With A taken anew from the carriers' path, the sensor's clock being off by `offset_s`."""
        A, _ = path.at(self.stamps_ns + round(1e9 * offset_s))
        return replace(self, A=A)


def read_pairs(log: Log, rig: Rig) -> dict[Pair, MeasuredPairs]:
    """Pairs of a cleaned log by (target, sensor), each in order of time; of those that the rig file has."""
    there = {topic.name for topic in log.topics()}
    topics = [PAIR_TOPIC.format(sensor=sensor) for sensor in rig.sensors]
    found: dict[Pair, list[PairRecord]] = defaultdict(list)
    for record in log.records([topic for topic in topics if topic in there]):
        if isinstance(record, PairRecord) and record.target in rig.targets and record.sensor in rig.sensors:
            found[Pair(record.target, record.sensor)].append(record)
    return {pair: _stacked(sorted(found[pair], key=lambda r: r.stamp_ns)) for pair in sorted(found)}


def _stacked(records: list[PairRecord]) -> MeasuredPairs:
    covariances = [record.covariance for record in records]
    return MeasuredPairs(
        np.array([record.stamp_ns for record in records], dtype=np.int64),
        np.array([record.A for record in records]),
        np.array([record.B for record in records]),
        None if any(c is None for c in covariances) else np.array(covariances),
        tuple(record.reason for record in records),
    )


def problem_of(
    pairs: Mapping[Pair, MeasuredPairs],
    rig: Rig,
    offsets_s: Mapping[str, float],
    *,
    scale: ScaleMode,
    known_sizes: tuple[str, ...] = (),
) -> Problem:
    """The problem of the pairs that are used.

    Parameters
    ----------
    pairs : dict of (target, sensor) to MeasuredPairs
    rig : Rig
        For its noise.
    offsets_s : dict of sensor to float
        What A was taken with: the problem's stamps are the carriers'.
    scale : "known", "shared" or "per_target"
    known_sizes : tuple of str
        Targets whose size is known, with scale="per_target".

    Raises
    ------
    NoiseError
        Where ``noise: {corner_px: ...}`` is asked for and a measurement has no covariance; covariances that are none.
    """
    problem = Problem(scale)
    has_covariances = all(measured.covariance is not None for measured in pairs.values())
    for pair, measured in pairs.items():
        used = measured.used
        if not used.any():
            continue
        weights: dict[str, object] = {}
        noise = rig.noise
        if noise != "estimate" and noise.rotation_deg is not None and noise.translation_mm is not None:
            deviation_rad = np.radians(noise.rotation_deg)
            weights = {"sigma": 1e-3 * noise.translation_mm, "kappa": 1.0 / (2.0 * deviation_rad**2)}
        elif has_covariances:
            assert measured.covariance is not None
            weights = {"covariances": measured.covariance[used]}
        elif noise != "estimate":
            raise NoiseError(
                f"{pair}: noise: {{corner_px: ...}} needs corners, and the detections of {pair.sensor} are poses "
                "without a covariance; give rotation_deg and translation_mm, or estimate"
            )
        try:
            problem.add(
                *pair,
                measured.A[used],
                measured.B[used],
                stamps_ns=measured.stamps_ns[used] + round(1e9 * offsets_s.get(pair.sensor, 0.0)),
                source="the cleaned log",
                **weights,  # type: ignore[arg-type]
            )
        except NoiseError as error:
            raise NoiseError(
                f"{error}. These are the log's: noise: {{rotation_deg: ..., translation_mm: ...}} in the rig file "
                "takes their place"
            ) from error
    for target in known_sizes:
        if target in problem.targets:
            problem.fix_scale(target)
    return problem
