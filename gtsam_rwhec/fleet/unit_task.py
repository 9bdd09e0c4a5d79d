"""Calibrate one robot, or the robots of a site, from the measurements of their logs; write result files and rows."""

from __future__ import annotations

import datetime
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Literal

from gtsam_rwhec.calibration.calibrate_options import CalibrateOptions
from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.stages import calibrate
from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.fitting.refined import Refined, sigma_of
from gtsam_rwhec.fleet.fleet_rows import RobotRow, RowFrame, read_rows, rows_json
from gtsam_rwhec.fleet.manifest import RigSource
from gtsam_rwhec.fleet.partial_result import (
    FORMAT_VERSION,
    PartialResult,
    findings_of_logs,
    history_of_logs,
    read_partial,
    removed_in_logs,
    with_sensor_names,
)
from gtsam_rwhec.fleet.stores import read_bytes, write_once
from gtsam_rwhec.fleet.tasks import Receipt, below, filed, key_of
from gtsam_rwhec.fleet.unit_problem import UnitLog, UnitProblem, check_rigs, disagreeing_logs, sensor_name, unit_problem
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.results.log_history import LogFields, TimeOffsetFields
from gtsam_rwhec.results.result_file import result_json
from gtsam_rwhec.results.result_judgement import judge, short_of_measurements
from gtsam_rwhec.rig import Rig

FOLDER = "answers"
#: What is solved together: all logs of a robot (or of a site), those of a day (UTC), or each log alone.
Each = Literal["robot", "day", "log"]


@dataclass(frozen=True)
class UnitTask:
    """The robot, site or log that one task solves."""

    name: str  #: The robot, the site, or the log's name
    site: str | None  #: The site whose robots are solved together
    logs: tuple[tuple[str, Receipt], ...]  #: The partial results
    rigs: tuple[tuple[str, RigSource], ...]  #: Each rig file of each robot once
    each: Each = "robot"

    @property
    def key(self) -> str:
        """A checksum of everything that the answer depends on."""
        rigs = [(robot, source.sha256) for robot, source in self.rigs]
        logs = [(robot, receipt.file) for robot, receipt in self.logs]
        return key_of(FORMAT_VERSION, version("gtsam-rwhec"), self.name, self.site, self.each, rigs, logs)

    @property
    def file(self) -> str:
        """The path of the answer in the output."""
        return f"{FOLDER}/{self.key}.answer"


@dataclass(frozen=True)
class Answer:
    """The content of a task's file: rows, and a result file's content for each unit."""

    rows: tuple[RobotRow, ...]
    results: dict[str, str]

    def packed(self) -> bytes:
        """The bytes of the file."""
        rows = rows_json(self.rows).decode("utf-8", "surrogateescape")
        return json.dumps({"rows": rows, "results": self.results}).encode()

    @staticmethod
    def read(content: bytes, where: str) -> Answer:
        """An answer from the bytes of its file; a FileFormatError where it is damaged."""
        try:
            facts = json.loads(content)
            return Answer(read_rows(facts["rows"].encode("utf-8", "surrogateescape"), where), facts["results"])
        except (KeyError, TypeError, ValueError) as error:
            raise FileFormatError(f"{where} is no answer of this version; remove it, and run again") from error


def result_file(unit: str) -> str:
    """The path of a unit's result file in the output."""
    return f"robots/{unit}/result.json"


def solve_unit(task: UnitTask, output: str) -> Receipt:
    """Solve a unit from the partial results of its logs; write its result files.

    Raises `RigError` if rig files or logs contradict each other, `RwhecError` as ``calibrate`` does.
    """

    def content(folder: Path) -> bytes:
        answer = _answer(task, output, folder)
        write_results(output, answer)
        return answer.packed()

    return filed(output, task.key, task.file, content)


def write_results(output: str, answer: Answer) -> None:
    """Write the result files of an answer that are missing or are those of another run."""
    for unit, text in answer.results.items():
        write_once(below(output, result_file(unit)), text.encode("utf-8", "surrogateescape"))


def _answer(task: UnitTask, output: str, folder: Path) -> Answer:
    sources: dict[str, list[tuple[str, Rig]]] = {}
    for number, (robot, source) in enumerate(task.rigs):
        place = folder / str(number)
        place.mkdir()
        sources.setdefault(robot, []).append((source.url, source.rig(place)))
    check_rigs(sources)
    rigs = {robot: joined_rig([rig for _, rig in several]) for robot, several in sources.items()}
    read = [_read(output, robot, receipt, rigs[robot], at_site=task.site is not None) for robot, receipt in task.logs]
    units: dict[str, list[UnitLog]] = {}
    for log in sorted(read, key=lambda one: (one.facts.begin_ns, one.receipt.key)):
        day = datetime.datetime.fromtimestamp(log.facts.begin_ns // 10**9, datetime.UTC).date().isoformat()
        units.setdefault(f"{task.name}@{day}" if task.each == "day" else task.name, []).append(log)
    rows: list[RobotRow] = []
    results: dict[str, str] = {}
    for unit, logs in units.items():
        measured = unit_problem(logs, rigs, at_site=task.site is not None)
        found, history = calibrated_unit(measured, logs, rigs, at_site=task.site is not None)
        results[unit] = result_json(found, history, "the result of a unit").decode("utf-8", "surrogateescape")
        robots = dict.fromkeys(log.robot for log in logs)
        rows += [_row(unit, task.site, robot, logs, measured, found, history) for robot in robots]
    return Answer(tuple(rows), results)


def joined_rig(rigs: Sequence[Rig]) -> Rig:
    """One rig with the sensors and targets of all rig files of a robot, which agree (`check_rigs`)."""
    sensors = {name: sensor for rig in reversed(rigs) for name, sensor in rig.sensors.items()}
    targets = {name: target for rig in reversed(rigs) for name, target in rig.targets.items()}
    return rigs[0].model_copy(update={"sensors": sensors, "targets": targets})


def _read(output: str, robot: str, receipt: Receipt, rig: Rig, *, at_site: bool) -> UnitLog:
    content = read_bytes(below(output, receipt.file))
    if hashlib.sha256(content).hexdigest() != receipt.sha256:
        raise FileFormatError(
            f"{receipt.file} is damaged: its checksum is not that of its receipt. Remove both, and run again"
        )
    log = read_partial(content, receipt.file)
    if at_site:
        names = {sensor: sensor_name(robot, sensor) for sensor in rig.sensors}
        pairs = {Pair(pair.target, names[pair.sensor]): one for pair, one in log.pairs.items()}
        log = PartialResult(with_sensor_names(log.facts, names), pairs, log.path)
    return UnitLog(robot, receipt, log)


def calibrated_unit(
    measured: UnitProblem, logs: Sequence[UnitLog], rigs: Mapping[str, Rig], *, at_site: bool
) -> tuple[Calibration, LogFields]:
    """The calibration of a unit with its logs' findings and history.

    `rigs` are by robot. `at_site` says that several robots are solved together.
    """
    rig, facts = next(iter(rigs.values())), [log.facts for log in logs]
    found = calibrate(
        measured.problem,
        CalibrateOptions(
            noise="estimate" if rig.noise == "estimate" else "given",
            robust="auto" if rig.cleaning.robust == "gnc" else "none",
            sizes="known" if rig.sizes == "known" else "check",
            carrier_noise=measured.carrier_noise,
            systematic=rig.carriers.arm,
            time_offsets=measured.estimated or False,
            carrier_path=measured.path,
        ),
    )
    counts = dict(found.outliers.counts) or {p: (len(at), len(at)) for p, at in measured.log_of.items()}
    carriers = "each robot's own" if at_site else rig.carriers.sensors, rig.carriers.targets
    history = _with_offsets(history_of_logs(facts, carriers, counts), found)
    poses: dict[str, int] = {}
    for log in facts:
        for name, number in log.poses.items():
            poses[name] = poses.get(name, 0) + number
    findings = (
        *found.findings,
        *findings_of_logs(facts),
        *short_of_measurements(history, poses),
        *disagreeing_logs(found, measured, [log.facts.url for log in logs]),
        *(() if measured.estimated else _of_clocks(history)),
    )
    notes = (*found.notes, *dict.fromkeys(words for log in facts for words in log.warnings))
    judgement = found.judgement
    if found.solution is not None:
        judgement = judge(found.solution, found.refined, history, findings)
    return replace(found, findings=findings, judgement=judgement, notes=notes), history


def _with_offsets(history: LogFields, found: Calibration) -> LogFields:
    """The history with the total clock offsets: those of cleaning plus those of the refinement."""
    refined = found.refined
    if not isinstance(refined, Refined) or not refined.time_offsets_s:
        return history
    offsets = []
    for one in history.time_offsets:
        change_s = refined.time_offsets_s.get(one.sensor)
        if change_s is not None:
            sigma_s = sigma_of(refined, f"time_offset:{one.sensor}")
            one = TimeOffsetFields(sensor=one.sensor, offset_s=one.offset_s + change_s, sigma_s=sigma_s)
        offsets.append(one)
    return history.model_copy(update={"time_offsets": tuple(offsets)})


def _of_clocks(history: LogFields) -> tuple[Finding, ...]:
    """A finding if clocks were estimated from rotations alone: the poses' covariance does not include their errors."""
    sigmas = history.cleaning.coarse_sigma_s
    if not sigmas:
        return ()
    told = ", ".join(f"{name} to +-{1e3 * sigma_s:.1f} ms" for name, sigma_s in sigmas.items())
    words = (
        f"time offsets are those that rotations alone tell, log by log ({told}), and the poses' standard deviations do "
        "not hold their errors; a robot that is solved alone has them estimated with its poses"
    )
    return (Finding(Ground.COVARIANCE_DOUBTED, words),)


def _row(
    unit: str,
    site: str | None,
    robot: str,
    of: Sequence[UnitLog],
    measured: UnitProblem,
    found: Calibration,
    history: LogFields,
) -> RobotRow:
    """The row of one robot with the costs of its logs. Failed logs and the answer's cost are added later."""
    logs = [log for log in of if log.robot == robot]
    own = sensor_name(robot, "") if site is not None else ""
    pairs = [pair for pair in measured.problem.pairs if pair.sensor.startswith(own)]
    sensors = [name for name in found.Y if any(name == pair.sensor for pair in pairs)]
    targets = [name for name in found.X if any(name == pair.target for pair in pairs)]
    frames = [RowFrame(name[len(own) :], "sensor", found.Y[name].matrix()) for name in sensors]
    frames += [RowFrame(name, "target", found.X[name].matrix()) for name in targets]
    refined, certificate = found.refined, None if found.solution is None else found.solution.certificate
    used = {count.pair: count.used for count in history.outliers}
    facts = [log.facts for log in logs]
    said = [*(finding.words for finding in found.findings), *(words for one in facts for words in one.warnings)]
    return RobotRow(
        unit=unit,
        robot=robot,
        site=site,
        begin_ns=min(one.begin_ns for one in facts),
        end_ns=max(one.end_ns for one in facts),
        verdict=found.verdict,
        reason=found.verdict_reason,
        grounds=found.judgement.grounds,
        status=None if certificate is None else certificate.status,
        frames=tuple(frames),
        covariance=None if refined is None or not frames else refined.covariance(*sensors, *targets),
        constant_errors=() if found.noise.model is None else found.noise.model.constant_deviations,
        degrees_of_freedom=math.inf if refined is None else refined.degrees_of_freedom,
        scale=found.scale,
        measurements_sha256=hashlib.sha256("".join(log.receipt.sha256 for log in of).encode()).hexdigest(),
        logs=len(logs),
        measurements=sum(used.get(pair, len(measured.log_of[pair])) for pair in pairs),
        result=result_file(unit),
        removed=removed_in_logs(facts),
        findings=tuple(dict.fromkeys(said)),
        cpu_s=sum(log.receipt.cpu_s for log in logs),
        bytes_read=sum(log.receipt.bytes_read for log in logs),
        peak_bytes=max(log.receipt.peak_bytes for log in logs),
    )
