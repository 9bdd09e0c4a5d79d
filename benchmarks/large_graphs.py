"""Graphs with thousands of frames: time, memory and verdict of ``rw.solve``, each graph in a process of its own.

    python benchmarks/large_graphs.py [--case NAME ...] [--share 1.0] [--keep-measurements]

The graphs (--case), each with ten measurements a pair:

    sparse       500 targets and 500 sensors: a random spanning tree, and 0.5 % of all other pairs
    star         10,000 targets and 8 sensors: every sensor sees every target
    warehouse    5,000 tags and 40 robots with 4 cameras each, every robot with a motion of its own: 100,000 pairs

The bar is for the call ``rw.solve(problem)``, which splits the graph, solves it, proves the answer and asks what the
motion determines. Simulating, and adding the measurements to the problem, come before it and are printed apart. Memory
is the largest resident set of the process up to the end, with Python, the libraries and the problem in it.
A problem keeps moments only, unless --keep-measurements is given. --share makes all graphs smaller: 0.1
is a tenth of the frames. Seconds of the clock depend on who else uses the machine; those of the processor do so less.
"""

from __future__ import annotations

import resource
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass

import numpy as np
from bars import Row, alone, at_most, run_script
from rwhec_factors.se3 import inverse, pose

import gtsam_rwhec as rw
from gtsam_rwhec.errors import NotCertifiedWarning, NotUniqueWarning
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.simulate.simulated_noise import Noise, perturb, random_poses, rotations_of_vectors
from gtsam_rwhec.simulate.simulated_rigs import Motion, bipartite_edges, carrier_poses

MEASUREMENTS = 10
#: Of a small rig.
NOISE = Noise(sigma_m=0.01, kappa=125.0)
#: Of a camera that sees tags of a hall: 0.9 degrees about each axis.
NOISE_OF_TAGS = Noise(sigma_m=0.01, kappa=2000.0)
#: Half the length of a hall's sides, m; tags hang up to as high as the second number.
HALL_M, HEIGHT_M = 40.0, 6.0
#: A robot sees a tag from about so far, m.
REACH_M = 3.0
#: Standard deviation of a robot's tilt on ramps and a floor that is not flat, rad: without it heights are free.
TILT_RAD = 0.2
#: A robot sees so many tags with each of its cameras, the last of them anywhere in the hall.
TAGS_OF_ROBOT, ELSEWHERE = 625, 125


@dataclass(frozen=True)
class Bar:
    """What must be reached: seconds, and resident set in GB."""

    seconds: float
    gigabytes: float


BARS = {"sparse": Bar(5.0, 0.5), "star": Bar(6.0, 0.6), "warehouse": Bar(60.0, 4.0)}


@dataclass(frozen=True)
class Seen:
    """What one sensor, or some, saw: names of pairs, the pair's index of each measurement (N,), and A, B (N, 4, 4)."""

    pairs: list[tuple[str, str]]
    index: np.ndarray
    A: Array
    B: Array


@dataclass(frozen=True)
class Measured:
    """What a process found; seconds of the clock and of the processor."""

    size: str
    building_s: float
    building_gb: float
    clock_s: float
    processor_s: float
    peak_gb: float
    status: str
    relative_gap: float
    unique: bool
    stages: dict[str, float]


def _seen(edges: np.ndarray, A: Array, X: Array, Y: Array, noise: Noise, draw: np.random.Generator) -> Seen:
    """Measurements of edges (E, 2), of target and sensor, with A (E * MEASUREMENTS, 4, 4) in the edges' order."""
    index = np.repeat(np.arange(len(edges)), MEASUREMENTS)
    B = inverse(Y[edges[index, 1]]) @ A @ X[edges[index, 0]]
    names = [(f"target{j}", f"sensor{k}") for j, k in edges.tolist()]
    return Seen(names, index, A, perturb(B, noise, draw))


def rig(targets: int, sensors: int, graph: str, probability: float) -> Iterator[Seen]:
    """A rig in a room, as `rw.simulate.general` has it, sensor by sensor; each pair has poses of its own."""
    frames, edges_of, draw = np.random.default_rng(1).spawn(3)
    X, Y = random_poses(targets, 2.0, frames), random_poses(sensors, 0.5, frames)
    edges = np.array(bipartite_edges(graph, targets, sensors, edges_of, probability))  # type: ignore[arg-type]
    edges = edges[np.argsort(edges[:, 1], kind="stable")]
    for own in np.array_split(edges, max(1, len(edges) // 10_000)):
        A = inverse(carrier_poses(Motion("general"), len(own) * MEASUREMENTS, draw))
        yield _seen(own, A, X, Y, NOISE, draw)


def warehouse(tags: int, robots: int, cameras: int) -> Iterator[Seen]:
    """Robots that drive in a hall, robot by robot: A = T_robot_hall, with any yaw and some tilt."""
    frames, draw = np.random.default_rng(2).spawn(2)
    X = random_poses(tags, HALL_M, frames)
    X[:, 2, 3] = frames.uniform(0.0, HEIGHT_M, tags)
    X = X[np.argsort(X[:, 0, 3])]  # along the hall, so that neighbours in number are neighbours in place
    Y = random_poses(robots * cameras, 0.5, frames)
    count = min(TAGS_OF_ROBOT, tags)
    for robot in range(robots):
        zone = (robot * tags // robots + np.arange(count - ELSEWHERE * count // TAGS_OF_ROBOT)) % tags
        others = np.setdiff1d(np.arange(tags), zone)
        seen = np.r_[zone, draw.choice(others, min(count - len(zone), len(others)), replace=False)]
        sensors = robot * cameras + np.arange(cameras)
        edges = np.stack(np.meshgrid(seen, sensors, indexing="ij"), axis=-1).reshape(-1, 2)
        number = len(edges) * MEASUREMENTS
        yaw = draw.uniform(-np.pi, np.pi, number)[:, None] * [0.0, 0.0, 1.0]
        tilt = draw.normal(0.0, TILT_RAD, (number, 2)) @ [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
        R = rotations_of_vectors(yaw) @ rotations_of_vectors(tilt)
        t = np.repeat(X[edges[:, 0], :3, 3], MEASUREMENTS, axis=0) + draw.normal(0.0, REACH_M, (number, 3))
        yield _seen(edges, inverse(pose(R, t)), X, Y, NOISE_OF_TAGS, draw)


def measurements(name: str, share: float) -> tuple[Noise, Iterator[Seen]]:
    """The noise and the measurements of a case."""

    def of(count: int, least: int) -> int:
        return max(least, round(share * count))

    if name == "sparse":
        return NOISE, rig(of(500, 10), of(500, 10), "random", 0.005)
    if name == "star":
        return NOISE, rig(of(10_000, 20), 8, "complete", 0.0)
    return NOISE_OF_TAGS, warehouse(of(5_000, 50), of(40, 2), 4)


def run(name: str, share: float, keep: bool) -> Measured:
    """Build a case and solve it in this process."""
    noise, batches = measurements(name, share)
    problem = rw.Problem(keep_measurements=keep)
    building = 0.0
    for seen in batches:
        start = time.process_time()
        problem.add_many(seen.pairs, seen.index, seen.A, seen.B, noise.sigma_m, noise.kappa)
        building += time.process_time() - start
        del seen  # the problem has what it needs of it
    size = f"{len(problem.targets)} x {len(problem.sensors)} frames, {len(problem.pairs)} pairs"
    building_gb = _gigabytes()
    clock, processor = time.perf_counter(), time.process_time()
    with warnings.catch_warnings(action="ignore", category=NotUniqueWarning):
        warnings.simplefilter("ignore", NotCertifiedWarning)
        solution = rw.solve(problem)
    clock, processor = time.perf_counter() - clock, time.process_time() - processor
    certificate = solution.certificate
    return Measured(
        size=size,
        building_s=building,
        building_gb=building_gb,
        clock_s=clock,
        processor_s=processor,
        peak_gb=_gigabytes(),
        status=str(certificate.status),
        relative_gap=certificate.relative_gap,
        unique=solution.identifiability.is_unique,
        stages=dict(certificate.seconds),
    )


def _gigabytes() -> float:
    """The largest resident set of this process so far."""
    per_unit = 1.0 if sys.platform == "darwin" else 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * per_unit / 1e9


def rows(case: Sequence[str], share: float, keep_measurements: bool) -> list[Row]:
    """A process for each case; without bars where graphs are smaller."""
    table = []
    for name in case:
        try:
            found = alone(run, name, share, keep_measurements)
        except BrokenProcessPool as error:
            table.append(Row(name, f"the process ended: {error}", "an answer", met=False))
            continue
        seconds, gigabytes = (BARS[name].seconds, BARS[name].gigabytes) if share == 1.0 else (None, None)
        own = f" (processor {found.processor_s:.1f} s)"
        table += [
            at_most(f"{name}: {found.size}: solve", found.clock_s, seconds, " s", ".1f", own),
            at_most("    peak memory", found.peak_gb, gigabytes, " GB", ".2f"),
            Row(
                "    status, relative gap",
                f"{found.status}, {found.relative_gap:.1e}{'' if found.unique else ', not unique'}",
                "certified",
                found.status == "certified",
            ),
            Row("    stages", ", ".join(f"{stage} {seconds:.2f} s" for stage, seconds in found.stages.items())),
            Row("    adding the measurements", f"{found.building_s:.1f} s, up to {found.building_gb:.2f} GB"),
        ]
    return table


if __name__ == "__main__":
    run_script("Large graphs", rows, case=tuple(BARS), share=1.0, keep_measurements=False)
