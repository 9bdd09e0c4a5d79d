"""The problem of a unit from the measurements that its partial results keep: what ``--refine`` calibrates from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.fitting.fit_options import CarrierNoise
from gtsam_rwhec.fleet.log_facts import Weighting
from gtsam_rwhec.fleet.map_log import measurements_file, partial_file
from gtsam_rwhec.fleet.merging import Merged, sensor_name
from gtsam_rwhec.fleet.partial import KeptLog, checksum, read_kept
from gtsam_rwhec.fleet.receipts import below
from gtsam_rwhec.fleet.stores import read_bytes
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.problem.measurements import GivenMeasurements, Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.rig import Rig

#: Pixels: the standard deviation of a corner where the rig file states none, as for one log.
CORNER_PX = 0.1


@dataclass(frozen=True, eq=False)
class MeasuredProblem:
    """The problem of a unit with raw measurements, and what its rig files state beside it.

    Attributes
    ----------
    problem : Problem
    carrier_noise : CarrierNoise or None
    estimated : tuple of str
        Sensors whose clocks are to be estimated along `path`.
    path : Trajectory or None
    covariances : dict of (target, sensor) to (N, 6, 6) array
        Of the pairs whose measurements all have one, whether or not they are weighted by it.
    logs : tuple of str
        In the order of time.
    log_of : dict of (target, sensor) to (N,) integers
        The place of each measurement's log among `logs`.
    """

    problem: Problem
    carrier_noise: CarrierNoise | None
    estimated: tuple[str, ...] = ()
    path: Trajectory | None = None
    covariances: dict[Pair, Array] = field(default_factory=dict)
    logs: tuple[str, ...] = ()
    log_of: dict[Pair, np.ndarray] = field(default_factory=dict)


def measured_problem(of: Merged, rigs: Mapping[str, Rig], output: str, *, at_site: bool) -> MeasuredProblem:
    """Read the measurements of a unit's logs.

    Parameters
    ----------
    of : Merged
    rigs : dict of str to Rig
        By robot.
    output : str
        URL of the run's output.
    at_site : bool
        Whether several robots are solved together: their clocks are not estimated then.

    Raises
    ------
    FileFormatError
        A file is damaged, or is not that of its partial result.
    """
    rig = next(iter(rigs.values()))
    free = rig.sizes == "estimate"
    problem = Problem("per_target" if free else "known")
    boards = {target.name: target.corners() for each in rigs.values() for target in each.target_list}
    paths: list[tuple[np.ndarray, Array]] = []
    covariances: dict[Pair, list[Array | None]] = {}
    log_of: dict[Pair, list[np.ndarray]] = {}
    logs = sorted(of.logs, key=lambda one: (one.facts.begin_ns, one.key))
    common_s = {} if at_site else _common_offsets(of, rig)
    for i, log in enumerate(logs):
        file = measurements_file(partial_file(log.key))
        content = read_bytes(below(output, file))
        if checksum(content) != log.facts.measurements_sha256:
            raise FileFormatError(f"{file} is not the file of its partial result; remove both, and run again")
        kept = _at_offsets(read_kept(content, file), log.facts.cleaning.time_offsets_s, common_s)
        names = {s: sensor_name(log.robot, s) for s in rigs[log.robot].sensors} if at_site else {}
        _add(problem, kept, names, log.facts.weighting, rig, log.facts.url)
        for pair, one in kept.pairs.items():
            named = Pair(pair.target, names.get(pair.sensor, pair.sensor))
            covariances.setdefault(named, []).append(one.covariances)
            log_of.setdefault(named, []).append(np.full(len(one.A), i))
        for name, camera in ((name, log.facts.camera(name)) for name in log.facts.cameras):
            if name in problem.sensors and name not in problem.cameras and _has_corners(problem, name):
                problem.cameras[name] = camera
        if kept.path is not None:
            paths.append(kept.path)
    if problem.cameras:
        problem.boards.update({name: boards[name] for name in problem.targets if name in boards})
        problem.corner_px = rig.corner_px or CORNER_PX
    noise = rig.carriers.noise
    estimated = tuple(
        name for name, sensor in rig.sensors.items() if sensor.time_offset == "estimate" and name in problem.sensors
    )
    has_path = bool(paths) and not at_site
    return MeasuredProblem(
        problem,
        None
        if noise is None
        else CarrierNoise(
            float(np.radians(noise.rotation_deg)), 1e-3 * noise.translation_mm, about=of.logs[0].facts.about
        ),
        estimated if has_path else (),
        _joined(paths) if has_path else None,
        {pair: np.concatenate(whole) for pair, of_logs in covariances.items() if (whole := _whole(of_logs))},
        tuple(log.facts.url for log in logs),
        {pair: np.concatenate(places) for pair, places in log_of.items()},
    )


def _whole(covariances: list[Array | None]) -> list[Array]:
    """The covariances of all logs; none where one log has none."""
    there = [one for one in covariances if one is not None]
    return there if len(there) == len(covariances) else []


def _common_offsets(of: Merged, rig: Rig) -> dict[str, float]:
    """One time offset for each sensor whose clock is estimated: the mean of what the logs' rotations tell, seconds."""
    found: dict[str, list[float]] = {}
    for log in of.logs:
        for name, offset_s in log.facts.cleaning.time_offsets_s.items():
            if name in rig.sensors and rig.sensors[name].time_offset == "estimate":
                found.setdefault(name, []).append(offset_s)
    return {name: float(np.mean(values)) for name, values in found.items()}


def _at_offsets(kept: KeptLog, taken_s: Mapping[str, float], common_s: Mapping[str, float]) -> KeptLog:
    """The measurements of a log with A at common time offsets in place of those at which it was taken."""
    if kept.path is None or not common_s:
        return kept
    path = Trajectory.of(*kept.path, "the carriers' path of a log")
    pairs = {}
    for pair, one in kept.pairs.items():
        if pair.sensor in common_s:
            change_ns = round(1e9 * common_s[pair.sensor]) - round(1e9 * taken_s[pair.sensor])
            stamps = one.stamps_ns + change_ns
            pairs[pair] = replace(one, stamps_ns=stamps, A=path.at(stamps)[0])
        else:
            pairs[pair] = one
    return replace(kept, pairs=pairs)


def _add(problem: Problem, kept: KeptLog, names: Mapping[str, str], weighting: Weighting, rig: Rig, where: str) -> None:
    sigma = kappa = None
    if weighting == "stated" and rig.noise != "estimate" and rig.noise.rotation_deg and rig.noise.translation_mm:
        sigma, kappa = 1e-3 * rig.noise.translation_mm, 1.0 / (2.0 * np.radians(rig.noise.rotation_deg) ** 2)
    for pair, one in kept.pairs.items():
        covariances = one.covariances if weighting == "covariances" else None
        given = GivenMeasurements(one.A, one.B, sigma, kappa, None, one.stamps_ns, covariances, where, one.pixels)
        problem.add_batch(Pair(pair.target, names.get(pair.sensor, pair.sensor)), given)


def _has_corners(problem: Problem, sensor: str) -> bool:
    return any(
        batch.pixels is not None for pair in problem.pairs if pair.sensor == sensor for batch in problem.batches(*pair)
    )


def _joined(paths: list[tuple[np.ndarray, Array]]) -> Trajectory:
    """One path of several logs, in order of time; of two poses at a stamp the first is taken."""
    stamps = np.concatenate([stamps for stamps, _ in paths])
    T = np.concatenate([T for _, T in paths])
    stamps, first = np.unique(stamps, return_index=True)
    return Trajectory.of(stamps, T[first], "the carriers' paths of the logs")
