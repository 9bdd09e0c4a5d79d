"""The problem of a robot, or of the robots of a site, from the measurements of their logs, which must agree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from rwhec_factors import se3
from rwhec_factors.batch import BatchResiduals
from scipy.special import chdtrc

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.errors import RigError
from gtsam_rwhec.files.terminal_text import some
from gtsam_rwhec.fitting.fit_options import CarrierNoise
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fleet.partial_result import LogFacts, PairMeasurements, PartialResult
from gtsam_rwhec.fleet.stores import shown
from gtsam_rwhec.fleet.tasks import Receipt
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.problem.corners import candidates_of
from gtsam_rwhec.problem.measurements import GivenMeasurements, Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.rig import Rig

#: Pixels: the default standard deviation of a corner, the same as for one log.
CORNER_PX = 0.1
#: A message names at most this many contradictions.
MOST_NAMED = 10


@dataclass(frozen=True, eq=False)
class UnitLog:
    """A log of a unit: its robot, the receipt of its file, its measurements and facts with the unit's names."""

    robot: str
    receipt: Receipt
    partial: PartialResult

    @property
    def facts(self) -> LogFacts:
        """The facts about the log."""
        return self.partial.facts


@dataclass(frozen=True, eq=False)
class UnitProblem:
    """The problem of a unit, with the clocks and the noise that its rig files state."""

    problem: Problem
    carrier_noise: CarrierNoise | None
    estimated: tuple[str, ...]  #: Sensors whose clocks are to be estimated along `path`
    path: Trajectory | None
    log_of: dict[Pair, np.ndarray]  #: by (target, sensor): The index of each measurement's log in the unit


def sensor_name(robot: str, sensor: str) -> str:
    """The name of a robot's sensor where several robots are solved together."""
    return f"{robot}/{sensor}"


def unit_problem(logs: Sequence[UnitLog], rigs: Mapping[str, Rig], *, at_site: bool) -> UnitProblem:
    """The problem of a unit, from its logs in order of time; `RigError` if they contradict each other.

    At a site several robots are solved together, each with carriers of its own: their clocks are not estimated.
    """
    rig = next(iter(rigs.values()))
    noise_is = check_logs(logs, rig)
    problem = Problem("per_target" if rig.sizes == "estimate" else "known")
    problem.sensor_carrier, problem.target_carrier = None if at_site else rig.carriers.sensors, rig.carriers.targets
    clocks = () if at_site else tuple(n for n, one in rig.sensors.items() if one.time_offset == "estimate")
    common_s = _common_offsets(logs, clocks)
    paths: list[tuple[np.ndarray, Array]] = []
    log_of: dict[Pair, list[np.ndarray]] = {}
    for i, log in enumerate(logs):
        moved = _at_offsets(log.partial, common_s)
        for pair, one in moved.items():
            _add(problem, pair, one, rig, noise_is, log.facts.url)
            log_of.setdefault(pair, []).append(np.full(len(one.A), i))
        for name in log.facts.cameras:
            if name in problem.sensors and any(p.sensor == name and one.pixels is not None for p, one in moved.items()):
                problem.cameras[name] = log.facts.camera(name)
        if log.partial.path is not None:
            paths.append(log.partial.path)
    if problem.cameras:
        boards = {target.name: target.corners() for each in rigs.values() for target in each.target_list}
        problem.boards.update({name: boards[name] for name in problem.targets if name in boards})
        problem.corner_px = rig.corner_px or CORNER_PX
    noise = rig.carriers.noise
    estimated = tuple(name for name in clocks if name in problem.sensors) if paths else ()
    return UnitProblem(
        problem,
        None
        if noise is None
        else CarrierNoise(
            float(np.radians(noise.rotation_deg)), 1e-3 * noise.translation_mm, about=logs[0].facts.about
        ),
        estimated,
        _joined(paths) if estimated else None,
        {pair: np.concatenate(places) for pair, places in log_of.items()},
    )


def _common_offsets(logs: Sequence[UnitLog], clocks: Sequence[str]) -> dict[str, float]:
    """One time offset, seconds, for each sensor whose clock is estimated: the mean of the logs' offsets."""
    told = {name: [log.facts.cleaning.time_offsets_s.get(name) for log in logs] for name in clocks}
    known = {name: [offset_s for offset_s in each if offset_s is not None] for name, each in told.items()}
    return {name: float(np.mean(each)) for name, each in known.items() if each}


def _at_offsets(log: PartialResult, common_s: Mapping[str, float]) -> Mapping[Pair, PairMeasurements]:
    """The measurements of a log, with A interpolated at the common time offsets instead of the log's own."""
    if log.path is None or not common_s:
        return log.pairs
    path = Trajectory.of(*log.path, "the carriers' path of a log")
    taken_s = log.facts.cleaning.time_offsets_s
    pairs = dict(log.pairs)
    for pair, one in log.pairs.items():
        if pair.sensor in common_s:
            stamps = one.stamps_ns + round(1e9 * common_s[pair.sensor]) - round(1e9 * taken_s[pair.sensor])
            pairs[pair] = replace(one, stamps_ns=stamps, A=path.at(stamps)[0])
    return pairs


def _add(problem: Problem, pair: Pair, one: PairMeasurements, rig: Rig, noise_is: str, where: str) -> None:
    sigma = kappa = None
    if noise_is == STATED and rig.noise != "estimate" and rig.noise.rotation_deg and rig.noise.translation_mm:
        sigma, kappa = 1e-3 * rig.noise.translation_mm, 1.0 / (2.0 * np.radians(rig.noise.rotation_deg) ** 2)
    covariances = one.covariances if noise_is == OF_CORNERS else None
    problem.add_batch(
        pair, GivenMeasurements(one.A, one.B, sigma, kappa, None, one.stamps_ns, covariances, where, one.pixels)
    )


def _joined(paths: list[tuple[np.ndarray, Array]]) -> Trajectory:
    """The paths of several logs as one, in order of time; the first of two poses with the same stamp counts."""
    stamps, first = np.unique(np.concatenate([stamps for stamps, _ in paths]), return_index=True)
    return Trajectory.of(stamps, np.concatenate([T for _, T in paths])[first], "the carriers' paths of the logs")


#: How the noise of a log's measurements is known.
STATED, OF_CORNERS, UNKNOWN = "stated", "from corners", "detections without corners or covariances"


def check_logs(logs: Sequence[UnitLog], rig: Rig) -> str:
    """How the logs know their noise; a RigError if the logs differ in this or in their cameras."""
    found: list[str] = []
    cameras: dict[str, UnitLog] = {}
    for log in logs:
        for name in log.facts.cameras:
            first = cameras.setdefault(name, log)
            one, other = first.facts.camera(name), log.facts.camera(name)
            same = (one.model, one.width, one.height) == (other.model, other.width, other.height)
            if not (same and np.array_equal(one.K, other.K) and np.array_equal(one.D, other.D)):
                said = f"fx {one.K[0, 0]:g} and fx {other.K[0, 0]:g}"
                found.append(f"{name} has other intrinsics in {log.facts.url} than in {first.facts.url} ({said})")
    known = [_noise_of(log.partial, rig) for log in logs]
    found += [
        f"the noise of {log.facts.url} is known otherwise ({own}) than that of {logs[0].facts.url} ({known[0]}): state "
        "it in the rig file (noise: {rotation_deg: ..., translation_mm: ...})"
        for log, own in zip(logs, known, strict=True)
        if own != known[0]
    ]
    _refuse(found)
    return known[0]


def _noise_of(log: PartialResult, rig: Rig) -> str:
    if rig.noise != "estimate" and rig.noise.rotation_deg is not None and rig.noise.translation_mm is not None:
        return STATED
    return OF_CORNERS if all(one.covariances is not None for one in log.pairs.values()) else UNKNOWN


def check_rigs(rigs: Mapping[str, Sequence[tuple[str, Rig]]]) -> None:
    """Refuse rig files (by robot, each with its URL) that contradict each other.

    A `RigError` names all differences in the type or size of a target, the intrinsics of a robot's sensor, the
    carriers' frames, or the treatment of sizes and noise.
    """
    found: list[str] = []
    everyone = [(robot, url, rig) for robot, several in rigs.items() for url, rig in several]
    first_robot, first_url, first = everyone[0]
    for robot, url, rig in everyone[1:]:
        own, others = shown(url), shown(first_url)
        for name in sorted(first.targets.keys() & rig.targets.keys()):
            if differs := _difference(first.targets[name], rig.targets[name]):
                found.append(f"target {name} differs between {others} and {own} ({differs})")
        stated = {
            "the carrier of the targets": (first.carriers.targets, rig.carriers.targets),
            "sizes": (first.sizes, rig.sizes),
            "noise": (first.noise, rig.noise),
        }
        if robot == first_robot:
            stated["the carrier of the sensors"] = first.carriers.sensors, rig.carriers.sensors
            for name in sorted(first.sensors.keys() & rig.sensors.keys()):
                one, other = first.sensors[name].intrinsics, rig.sensors[name].intrinsics
                if one != other:
                    differs = _difference(one, other) if one and other else ""
                    found.append(f"sensor {name} has other intrinsics in {own} than in {others} ({differs})")
        found += [f"{what} is {a} in {others} and {b} in {own}" for what, (a, b) in stated.items() if a != b]
    _refuse(found)


def _refuse(found: list[str]) -> None:
    if found:
        raise RigError(
            "rig files or logs that are to be solved together contradict each other: "
            f"{some(found, MOST_NAMED, between='; ')}. Correct the wrong one, or solve them apart (robots of their "
            "own, --each log)"
        )


def _difference(one: object, other: object) -> str:
    before, now = (dict(each) for each in (one, other))  # type: ignore[call-overload]
    keys = [key for key in before.keys() | now.keys() if before.get(key) != now.get(key)]
    return ", ".join(f"{key}: {before.get(key)} and {now.get(key)}" for key in sorted(keys)[:3])


#: Logs disagree on a frame if its changes are this many times the noise, and less likely than this by chance.
TIMES, CHANCE = 2.0, 1e-6


def disagreeing_logs(found: Calibration, measured: UnitProblem, logs: Sequence[str]) -> tuple[Finding, ...]:
    """A finding if frames are elsewhere in one of the logs (URLs) than in the others, by more than the noise.

    With the information M = sum J' C^-1 J of a log, its measurements alone would move a frame by
    d = M^-1 sum J' C^-1 r. About the logs' mean of d, sum (d - mean)' M (d - mean) is a chi-square where they agree.
    Errors of the carriers' poses that differ between logs count as a disagreement: the covariance does not hold them
    either.
    """
    refined = found.refined
    if refined is None or len(logs) < 2:
        return ()
    worst, words = TIMES, ""
    for name, (scores, information) in _by_frame(refined, measured, len(logs)).items():
        there = np.flatnonzero(np.linalg.cond(information) < 1e12)
        if len(there) < 2:
            continue
        shifts = np.linalg.solve(information[there], scores[there][:, :, None])[:, :, 0]
        shifts -= np.linalg.solve(information[there].sum(axis=0), scores[there].sum(axis=0))
        squares = np.einsum("li,lij,lj->l", shifts, information[there], shifts)
        freedom = 6.0 * (len(there) - 1)
        times = float(np.sqrt(squares.sum() / freedom))
        if times <= worst or chdtrc(freedom, squares.sum()) > CHANCE:
            continue
        worst, most = times, int(np.argmax(squares))
        mm, degrees = 1e3 * np.linalg.norm(shifts[most, 3:]), np.degrees(np.linalg.norm(shifts[most, :3]))
        words = (
            f"the logs disagree, {times:.1f} times as much as their noise explains, most about {name}: "
            f"{logs[there[most]]} puts it {mm:.2g} mm and {degrees:.2g} degrees from the common answer. Something may "
            "have moved between logs: calibrate with --each log or --each day, and ask fleet watch when"
        )
    return (Finding(Ground.COVARIANCE_DOUBTED, words),) if words else ()


def _by_frame(refined: Refined, measured: UnitProblem, logs: int) -> dict[str, tuple[Array, Array]]:
    """The scores (L, 6) and information (L, 6, 6) of each frame by log, under the noise of all residuals."""
    frames: dict[str, tuple[Array, Array]] = {}
    squares, count = 0.0, 0
    for pair in measured.problem.pairs:
        scale = refined.scale if isinstance(refined.scale, float) else refined.scale.get(pair.target, 1.0)
        X, Y = refined.X[pair.target].matrix(), refined.Y[pair.sensor].matrix()
        A, B, C = _measurements(refined, measured, pair)
        linear = BatchResiduals(A, B).linearize(X, Y, scale)
        W = np.linalg.inv(C)
        Wr = np.einsum("nij,nj->ni", W, linear.residual)
        squares, count = squares + float((linear.residual * Wr).sum()), count + Wr.size
        for name, J in zip(pair.frames, (linear.target, linear.sensor), strict=True):
            scores, information = frames.setdefault(name, (np.zeros((logs, 6)), np.zeros((logs, 6, 6))))
            np.add.at(scores, measured.log_of[pair], -np.einsum("nij,ni->nj", J, Wr))
            np.add.at(information, measured.log_of[pair], np.swapaxes(J, 1, 2) @ W @ J)
    variance = squares / max(count, 1)
    return {name: (scores / variance, information / variance) for name, (scores, information) in frames.items()}


def _measurements(refined: Refined, measured: UnitProblem, pair: Pair) -> tuple[Array, Array, Array]:
    """A by the answer's clocks, B, and its covariances; for an answer from corners, B by the corners."""
    problem = measured.problem
    raw = problem.measurements(*pair)
    A, offset_s = raw.A, refined.time_offsets_s.get(pair.sensor)
    if measured.path is not None and offset_s is not None and raw.stamps_ns is not None:
        A = measured.path.at(raw.stamps_ns + round(1e9 * offset_s))[0]
    if raw.pixels is not None and refined.reprojection is not None and problem.corner_px is not None:
        estimated = refined.intrinsics.get(pair.sensor)
        camera = problem.cameras[pair.sensor] if estimated is None else estimated.camera
        boards = candidates_of(camera, problem.boards[pair.target], raw.pixels, problem.corner_px, str(pair))
        X, Y = refined.X[pair.target].matrix(), refined.Y[pair.sensor].matrix()
        return A, *boards.chosen(boards.nearer(se3.inverse(Y[None]) @ A @ X))
    if raw.covariances is not None:
        return A, raw.B, raw.covariances
    noise = refined.noise[pair]
    variances = np.repeat([noise.rotation_rad**2, noise.translation_m**2], 3)
    return A, raw.B, np.tile(np.diag(variances), (len(raw.A), 1, 1))
