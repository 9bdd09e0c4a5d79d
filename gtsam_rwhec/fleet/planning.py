"""From a manifest to tasks: which logs there are, what solves what, in which order."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

from gtsam_rwhec.errors import ManifestError, RwhecError
from gtsam_rwhec.fleet.manifest import LogSource, Manifest, Robot
from gtsam_rwhec.fleet.map_log import LogTask
from gtsam_rwhec.fleet.merging import CHUNK, Member, MergeTask
from gtsam_rwhec.fleet.rig_source import RigSource, read_rig_source
from gtsam_rwhec.fleet.solve_robot import Each, UnitTask
from gtsam_rwhec.fleet.stores import listed, local_path, stamp_of
from gtsam_rwhec.fleet.without_secrets import shown, without_secrets

#: So many requests to stores at the same time.
THREADS = 16
_NOT_OF_NAMES = re.compile(r"[^A-Za-z0-9_.-]+")
Asked = TypeVar("Asked")
Told = TypeVar("Told")


@dataclass(frozen=True)
class FleetOptions:
    """The options of a fleet's run.

    Attributes
    ----------
    each : "robot", "day" or "log"
        What is solved together.
    refine : bool
        From the measurements, with all that ``calibrate`` does; by default from the moments.
    """

    each: Each = "robot"
    refine: bool = False


@dataclass(frozen=True)
class PlannedLog:
    """A log of a robot: the task that maps it, or why there is none."""

    robot: str
    url: str
    task: LogTask | None = None
    failure: str = ""


@dataclass(frozen=True)
class Plan:
    """The tasks of a run.

    Attributes
    ----------
    logs : tuple of PlannedLog
    merges : tuple of MergeTask
        In an order in which each comes after its inputs.
    units : tuple of UnitTask
    """

    logs: tuple[PlannedLog, ...]
    merges: tuple[MergeTask, ...]
    units: tuple[UnitTask, ...]


def many(function: Callable[[Asked], Told], of: Iterable[Asked]) -> list[Told]:
    """Ask stores many things at the same time; the answers are in the order of the questions."""
    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(function, of))


def planned(manifest: Manifest, options: FleetOptions) -> Plan:
    """Look for the logs of a manifest, and plan what is to be done.

    Raises
    ------
    RigError
        The rig file of all robots cannot be read. That of one robot is a failure of this robot's logs.
    ManifestError
        A log is said to be of two robots.
    """
    if manifest.shared_rig is not None:
        read_rig_source(manifest.shared_rig).parsed()
    urls = list(dict.fromkeys(source.rig for robot in manifest.robots for source in robot.logs))
    rigs = dict(zip(urls, many(_rig, urls), strict=True))
    entries = [(robot, source) for robot in manifest.robots for source in robot.logs]
    expanded = [log for several in many(_listed, entries) for log in several]
    _refuse_shared_logs(manifest, expanded)
    logs = tuple(many(lambda log: _with_task(*log, rigs), dict.fromkeys(expanded)))
    return _tasks(manifest, logs, options)


def _rig(url: str) -> RigSource | str:
    """A rig file; or why it cannot be used."""
    try:
        source = read_rig_source(url)
        source.parsed()
        return source
    except (RwhecError, OSError) as error:
        return without_secrets(str(error))


def _listed(entry: tuple[Robot, LogSource]) -> list[tuple[str, str, str, str]]:
    """Robot, log, rig file and failure of each log of an entry."""
    robot, source = entry
    if not source.is_pattern:
        return [(robot.name, source.url, source.rig, "")]
    try:
        found = listed(source.url)
    except (RwhecError, OSError) as error:
        return [(robot.name, source.url, source.rig, without_secrets(str(error)))]
    if not found:
        words = f"no log matches {shown(source.url)} ({source.place})"
        return [(robot.name, source.url, source.rig, words)]
    return [(robot.name, url, source.rig, "") for url in found]


def _refuse_shared_logs(manifest: Manifest, logs: Sequence[tuple[str, str, str, str]]) -> None:
    owner: dict[str, tuple[str, str]] = {}
    for robot, url, rig, failure in logs:
        first = owner.setdefault(url, (robot, rig))
        if failure or first == (robot, rig):
            continue
        twice = f"{shown(manifest.where)}: {shown(url)} is a log of {first[0]}"
        if first[0] != robot:
            raise ManifestError(f"{twice} and of {robot}; a log is of one robot")
        raise ManifestError(f"{twice} with {shown(first[1])} and with {shown(rig)}; give it once")


def _with_task(robot: str, url: str, rig_url: str, failure: str, rigs: Mapping[str, RigSource | str]) -> PlannedLog:
    rig = rigs[rig_url]
    if failure or isinstance(rig, str):
        return PlannedLog(robot, url, failure=failure or str(rig))
    try:
        path = local_path(url)  # whole: the same log whatever folder a run or a worker is started in
        return PlannedLog(robot, url, LogTask(url if path is None else os.path.abspath(path), stamp_of(url), rig))
    except (RwhecError, OSError) as error:
        return PlannedLog(robot, url, failure=without_secrets(str(error)))


def _tasks(manifest: Manifest, logs: tuple[PlannedLog, ...], options: FleetOptions) -> Plan:
    of_robot: dict[str, list[PlannedLog]] = {robot.name: [] for robot in manifest.robots}
    for log in logs:
        of_robot[log.robot].append(log)
    merges: list[MergeTask] = []
    units: list[UnitTask] = []
    if options.each == "log":
        for robot in manifest.robots:
            names = _names(robot.name, of_robot[robot.name])
            units += [
                _unit(name, None, [log], options, merges)
                for name, log in zip(names, of_robot[robot.name], strict=True)
                if log.task is not None
            ]
        return Plan(logs, (), tuple(units))
    for robot in manifest.robots:
        if robot.site is None:
            units.append(_unit(robot.name, None, of_robot[robot.name], options, merges))
    for site, robots in manifest.sites.items():
        units.append(_unit(site, site, [log for robot in robots for log in of_robot[robot.name]], options, merges))
    return Plan(logs, tuple(merges), tuple(unit for unit in units if unit.inputs))


def _names(robot: str, logs: Sequence[PlannedLog]) -> list[str]:
    """A name of each log alone: the file's, with a number where several have it."""
    taken: dict[str, int] = {}
    names = []
    for log in logs:
        stem = shown(log.url).rpartition("/")[2].removesuffix(".mcap")
        name = f"{robot}@{_NOT_OF_NAMES.sub('_', stem)}"
        taken[name] = taken.get(name, 0) + 1
        names.append(name if taken[name] == 1 else f"{name}.{taken[name]}")
    return names


def _unit(
    name: str, site: str | None, logs: Sequence[PlannedLog], options: FleetOptions, merges: list[MergeTask]
) -> UnitTask:
    """A unit of some logs; where they are many, the tasks that merge chunks of them are added to `merges`."""
    there = sorted(((log.task.key, log.robot, log.task) for log in logs if log.task is not None), key=lambda o: o[:2])
    members = tuple(Member(robot, key) for key, robot, _ in there)
    rigs = {(robot, task.rig.sha256): task.rig for _, robot, task in sorted(there, key=lambda one: one[1:2])}
    inputs = tuple(member.key for member in members)
    of_level = members
    while len(inputs) > CHUNK and options.each == "robot":
        chunks = [inputs[i : i + CHUNK] for i in range(0, len(inputs), CHUNK)]
        of_chunk = [of_level[i : i + CHUNK] for i in range(0, len(inputs), CHUNK)]
        level = (
            [MergeTask(of, chunk, site) for of, chunk in zip(of_chunk, chunks, strict=True)]
            if of_level
            else [MergeTask((), chunk, site) for chunk in chunks]
        )
        merges += level
        inputs, of_level = tuple(task.key for task in level), ()
    return UnitTask(
        name,
        site,
        of_level,
        inputs,
        tuple((robot, rig) for (robot, _), rig in rigs.items()),
        options.each,
        options.refine,
    )
