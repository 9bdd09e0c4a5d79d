"""Trajectories of odometry and SLAM against poses of motion capture: is an answer ever wrong with "use"?

    python benchmarks/trajectories.py [--runs 100] [--kinds walk,bend] [--movers flown] [--workers 2] [--seed 0]
        [--roads stream] [--keep runs.jsonl]

A body is tracked (white noise of a pose), and carries a camera whose own trajectory errs in one of six ways: a random
walk, a bias of its rates, a scale that drifts, a walk that loop closures correct at once, a clock that is late and
stretched, a map that is bent. The body is flown, driven, or held in a hand. "stream": the trajectory is a target, the
map, seen by the camera, and the body's poses are a path; "odometry": both are tracks of `calibrate_odometries`.

Bars: at most one answer in 600 is outside its own 99.99 % ellipsoid with "use"; 95 % ellipsoids of the camera hold the
truth in 93 to 98 % of all runs, and in 90 to 99 % of each kind. Exits with 1 if a bar is missed.
"""

from __future__ import annotations

import itertools
import os
import sys
import time
import warnings
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from bars import Row, Share, benchmark_parser, each_done, keep_line, kept_lines, print_rows
from rwhec_factors import se3
from scipy.special import fdtrc

import gtsam_rwhec as rw
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.simulate.simulated_noise import rotations_of_vectors

KINDS = ("walk", "bias", "scale", "loops", "clock", "bend")
MOVERS = ("flown", "driven", "held")
MAP, CAMERA, BODY = "map", "camera", "body"
#: Poses a second of the camera's trajectory and of motion capture.
CAMERA_HZ, CAPTURE_HZ = 15.0, 60.0
#: White noise of a pose: of motion capture, and of the trajectory; rad and m.
CAPTURE, WHITE = (float(np.radians(0.05)), 0.0003), (float(np.radians(0.04)), 0.0015)
#: Root mean squares along (m) and about (rad) x, y, z, and the slowest and the fastest of the waves, Hz.
MOTION = {
    "flown": ((2.5, 2.5, 0.6), (0.15, 0.15, 1.2), (0.02, 0.25)),
    "driven": ((8.0, 8.0, 0.05), (0.02, 0.02, 1.5), (0.01, 0.15)),
    "held": ((0.5, 0.5, 0.25), (0.35, 0.35, 0.6), (0.05, 0.6)),
}
WAVES = 6


@dataclass(frozen=True)
class Sequence:
    """The truth T_body_camera, the body's path, and the camera's trajectory T_map_camera with its stamps."""

    T_body_camera: Array
    path: Trajectory
    stamps_ns: np.ndarray
    T_map_camera: Array


def simulate(kind: str, mover: str, seed: int) -> Sequence:
    """One sequence of 40 to 120 s."""
    rng = np.random.default_rng([seed, zlib.crc32(f"{kind} {mover}".encode())])
    seconds, start = rng.uniform(40.0, 120.0), 100.0
    motion = waves_of(mover, rng)
    T_body_camera = se3.pose(rotations_of_vectors(rng.normal(0.0, 0.6, 3)), rng.normal(0.0, 0.08, 3))
    captured = start + np.arange(0.0, seconds, 1.0 / CAPTURE_HZ)
    path = motion(captured) @ se3.expmap(white(len(captured), CAPTURE, rng))
    seen = start + np.arange(0.5, seconds - 0.5, 1.0 / CAMERA_HZ)
    stamps = seen
    if kind == "clock":
        stretch = 10.0 ** rng.uniform(-5.0, -3.3) * rng.choice([-1.0, 1.0])
        stamps = seen + rng.uniform(-0.03, 0.03) + stretch * (seen - start)
    T_world_camera = motion(seen) @ T_body_camera
    T = np.linalg.inv(T_world_camera[0]) @ T_world_camera
    T = erring(kind, T, seen - seen[0], rng) @ se3.expmap(white(len(T), WHITE, rng))
    return Sequence(T_body_camera, Trajectory(nanoseconds(captured), path), nanoseconds(stamps), T)


def waves_of(mover: str, rng: np.random.Generator) -> Any:
    """The pose (N, 4, 4) of a body at times (N,): sums of waves; what is driven or flown looks along its way."""
    extents, turns, (low, high) = MOTION[mover]
    frequency = low * (high / low) ** rng.uniform(0.0, 1.0, (WAVES, 6))
    phase = rng.uniform(0.0, 2.0 * np.pi, (WAVES, 6))
    amplitude = rng.normal(0.0, 1.0, (WAVES, 6)) * (low / frequency) ** 0.5
    amplitude *= np.array([*turns, *extents]) * np.sqrt(2.0) / np.sqrt((amplitude**2).sum(axis=0))
    amplitude *= rng.uniform(0.5, 1.3)

    def motion(t: Array) -> Array:
        at = np.sin(2.0 * np.pi * frequency * t[:, None, None] + phase) * amplitude
        found = at.sum(axis=1)
        return se3.pose(rotations_of_vectors(found[:, :3]), found[:, 3:])

    return motion


def erring(kind: str, T: Array, t: Array, rng: np.random.Generator) -> Array:
    """The trajectory as it was estimated: T_map_camera (N, 4, 4) at seconds t (N,), without its white noise."""
    steps = se3.logmap(np.linalg.inv(T[:-1]) @ T[1:])
    dt = np.diff(t)[:, None]
    if kind in ("walk", "loops"):
        size = np.repeat([np.radians(0.05), 0.004], 3) * 2.0 ** rng.uniform(-1.5, 1.5)  # a root of a second
        steps = steps + rng.standard_normal(steps.shape) * size * np.sqrt(dt)
    elif kind == "bias":
        steps = (
            steps + rng.standard_normal(6) * np.repeat([np.radians(0.01), 0.0005], 3) * 2.0 ** rng.uniform(-1, 2) * dt
        )
    elif kind == "scale":
        walk = np.cumsum(rng.standard_normal(len(t)) * 0.004 * 2.0 ** rng.uniform(-1.5, 1.5) * np.sqrt(t[1] - t[0]))
        steps = steps.copy()
        steps[:, 3:] *= np.exp(walk[1:, None])
    elif kind == "bend":
        extent = np.ptp(T[:, :3, 3], axis=0).max()
        bent = np.radians(2.0) * 2.0 ** rng.uniform(-1.5, 1.0) / extent
        axes = rng.standard_normal((3, 3)) * bent
        about = T[:, :3, 3] @ axes.T  # rad, that grow with the place
        moved = T.copy()
        moved[:, :3, :3] = rotations_of_vectors(about) @ T[:, :3, :3]
        moved[:, :3, 3] += 0.5 * np.cross(about, T[:, :3, 3])
        return moved
    else:
        return T
    result = np.empty_like(T)
    result[0] = T[0]
    for k, step in enumerate(se3.expmap(steps)):
        result[k + 1] = result[k] @ step
    if kind == "loops":
        for at in np.sort(rng.choice(np.arange(len(t) // 6, len(t)), rng.integers(1, 5), replace=False)):
            kept = rng.uniform(0.0, 0.3)
            off = se3.logmap((T[at] @ np.linalg.inv(result[at]))[None])[0]
            result[at:] = se3.expmap((1.0 - kept) * off[None])[0] @ result[at:]
    return result


def white(count: int, size: tuple[float, float], rng: np.random.Generator) -> Array:
    """Twists (N, 6), rad and m."""
    return rng.standard_normal((count, 6)) * np.repeat(size, 3)


def nanoseconds(seconds: Array) -> np.ndarray:
    """Whole ones."""
    return np.round(1e9 * seconds).astype(np.int64)


def stream(sequence: Sequence) -> tuple[str, Array, Array, float, tuple[str, ...]]:
    """The verdict, T_body_camera, its covariance, its degrees of freedom, and the grounds, of the target road."""
    at, gaps = sequence.path.at(sequence.stamps_ns)
    there = np.isfinite(gaps)
    problem = rw.Problem()
    A, B = np.linalg.inv(at[there]), np.linalg.inv(sequence.T_map_camera[there])
    problem.add(MAP, CAMERA, A, B, stamps_ns=sequence.stamps_ns[there])
    path = Trajectory(sequence.path.stamps_ns, np.linalg.inv(sequence.path.T))  # T_sensorcarrier_targetcarrier, as A
    found = rw.calibrate(problem, rw.CalibrateOptions(carrier_path=path, time_offsets=True))
    grounds = tuple(ground.value for ground in found.judgement.grounds)
    if found.refined is None or not np.isfinite(found.refined.covariance(CAMERA)).all():
        return found.verdict.value, np.full((4, 4), np.nan), np.full((6, 6), np.nan), np.nan, grounds
    refined = found.refined
    return (
        found.verdict.value,
        refined.Y[CAMERA].matrix(),
        refined.covariance(CAMERA),
        refined.degrees_of_freedom,
        grounds,
    )


def odometry(sequence: Sequence) -> tuple[str, Array, Array, float, tuple[str, ...]]:
    """The same, of the road of odometries: motion capture is one of them."""
    tracks = [
        rw.odometry.OdometryTrack(BODY, sequence.path.stamps_ns, np.linalg.inv(sequence.path.T[0]) @ sequence.path.T),
        rw.odometry.OdometryTrack(CAMERA, sequence.stamps_ns, sequence.T_map_camera),
    ]
    found = rw.odometry.calibrate_odometries(tracks, reference=BODY)
    grounds = tuple(ground.value for ground in found.judgement.grounds)
    covariance = found.covariance_of(CAMERA)
    T = found.T_reference_sensor[CAMERA] if np.isfinite(covariance).all() else np.full((4, 4), np.nan)
    return found.judgement.verdict.value, T, covariance, np.inf, grounds


ROADS = {"stream": stream, "odometry": odometry}


def run(road: str, kind: str, mover: str, seed: int) -> dict[str, Any]:
    """One sequence calibrated: a line of the campaign."""
    sequence = simulate(kind, mover, seed)
    began = time.perf_counter()
    with warnings.catch_warnings(action="ignore"):
        try:
            verdict, T, covariance, freedom, grounds = ROADS[road](sequence)
        except rw.errors.RwhecError as error:
            verdict, T, covariance, freedom, grounds = (
                "refused",
                np.full((4, 4), np.nan),
                np.eye(6),
                np.inf,
                (str(error),),
            )
    one = {"road": road, "kind": kind, "mover": mover, "seed": seed, "verdict": verdict, "grounds": grounds}
    one |= {"seconds": round(time.perf_counter() - began, 2), "frames": len(sequence.stamps_ns)}
    if np.isfinite(T).all():
        error = se3.logmap((np.linalg.inv(T) @ sequence.T_body_camera)[None])[0]
        squares = float(error @ np.linalg.solve(covariance, error))
        freedom = min(freedom, 1e6)
        deviations = np.sqrt(np.diagonal(covariance).reshape(2, 3).max(axis=1))
        one |= {
            "chi2": squares, "chance": float(fdtrc(6, freedom, squares / 6.0)), "freedom": freedom,
            "deg": float(np.degrees(np.linalg.norm(error[:3]))), "mm": float(1e3 * np.linalg.norm(error[3:])),
            "sigma_deg": float(np.degrees(deviations[0])), "sigma_mm": float(1e3 * deviations[1]),
        }  # fmt: skip
    return one


def rows_of(runs: list[dict[str, Any]]) -> list[Row]:
    """The bars, for all runs and by kind."""
    wrong = [one for one in runs if one["verdict"] == "use" and one.get("chance", 1.0) < 1e-4]
    most = max(len(runs) // 600, 1)
    rows = [Row("use, and outside 99.99 %", f"{len(wrong)} of {len(runs)}", f"<= {most}", len(wrong) <= most)]
    pooled = Share.of([one["chance"] >= 0.05 for one in runs if "chance" in one])
    rows.append(Row("95 % ellipsoids of the camera", str(pooled), "93 to 98 %", pooled.meets(0.93, 0.98)))
    for by in ("kind", "mover", "road"):
        for name in dict.fromkeys(one[by] for one in runs):
            of = [one for one in runs if one[by] == name]
            share = Share.of([one["chance"] >= 0.05 for one in of if "chance" in one])
            said = " ".join(
                f"{v} {sum(o['verdict'] == v for o in of)}" for v in ("use", "care", "do_not_use", "refused")
            )
            bad = sum(one["verdict"] == "use" and one.get("chance", 1.0) < 1e-4 for one in of)
            medians = " ".join(
                f"{key} {float(np.median([one[key] for one in of if key in one] or [np.nan])):.2g}"
                for key in ("chi2", "deg", "sigma_deg", "mm", "sigma_mm", "seconds")
            )
            figure = f"{share}; {said}; wrong with use {bad}; medians: {medians}"
            rows.append(Row(f"{by} {name}", figure, "90 to 99 %", share.meets(0.90, 0.99)))
    return rows


def main() -> int:
    parser = benchmark_parser(__doc__)
    parser.add_argument("--runs", type=int, default=6, help="of each kind and mover")
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--movers", default=",".join(MOVERS))
    parser.add_argument("--roads", default="stream")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="file of JSON lines: runs that it has are not run again")
    given = parser.parse_args()
    kept = {(one["road"], one["kind"], one["mover"], one["seed"]): one for one in kept_lines(given.keep)}
    seeds = range(given.seed, given.seed + given.runs)
    calls = list(itertools.product(given.roads.split(","), given.kinds.split(","), given.movers.split(","), seeds))
    for call, one in each_done(run, [call for call in calls if call not in kept], given.workers, "sequences"):
        kept[call] = one
        keep_line(given.keep, one)
    return print_rows("Trajectories", rows_of([kept[call] for call in calls]))


if __name__ == "__main__":
    sys.exit(main())
