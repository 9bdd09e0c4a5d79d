"""A long log of a rig that is carried past targets along a path that drifts: how long ``rw.calibrate`` takes.

    python benchmarks/long_log.py [--seed 0] [--measurements 3000] [--store]

Twenty-one targets hang in a room; two cameras on a rig see those in front of them. The rig's pose comes from
visual-inertial odometry, whose error is a random walk of yaw and position (0.5 degrees and 5 cm a minute). Cameras err
by 0.3 degrees and 4 mm an axis, and every fifth measurement is no measurement of its target at all: another target's
pose, or any pose. Nothing is told of this. ``refine(noise="estimate", robust="gnc")`` is timed beside it. Times are on
the clock; the processor's own are in brackets, for a machine that does other work too.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from bars import Row, benchmark_parser, print_rows
from numpy.typing import NDArray
from rwhec_factors.se3 import inverse, pose

import gtsam_rwhec as rw
from gtsam_rwhec.errors import RwhecWarning
from gtsam_rwhec.simulate import Noise, perturb
from gtsam_rwhec.simulate.simulated_noise import random_poses, rotations_of_vectors

Array = NDArray[np.float64]
Masks = dict[tuple[str, str], NDArray[np.bool_]]
TARGETS, SENSORS = 21, 2
#: Pictures a second, and the share of measurements that are wrong.
RATE_HZ, OUTLIERS = 10.0, 0.2
#: The walk's standard deviations after a second, rad and m.
DRIFT_RAD, DRIFT_M = np.radians(0.5) / np.sqrt(60.0), 0.05 / np.sqrt(60.0)
CAMERA = Noise(sigma_m=0.004, kappa=0.5 / np.radians(0.3) ** 2)
#: Cameras see targets up to this far away and this far off their axis.
RANGE_M, FIELD_RAD = 4.0, np.radians(50.0)
#: s: the whole of solve and refine on two cores; and the longest time without a word.
BAR_S, SILENCE_S = 20.0, 5.0


@dataclass(frozen=True)
class LongLog:
    """The problem, which measurements are good, and the true poses of the cameras on the rig."""

    problem: rw.Problem
    good: Masks
    Y: dict[str, Array]


def long_log(seed: int, measurements: int = 3000) -> LongLog:
    """As many measurements as asked for, of a rig that walks round a room until it has them."""
    generator = np.random.default_rng(seed)
    X = _targets(generator)
    mounts = [rotations_of_vectors(np.array([[0.0, 0.0, angle]]))[0] for angle in (-0.6, 0.7)]
    look = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # optical axis z along the rig's x
    Y = {
        f"cam_{k}": pose(R @ look, np.array([0.1, 0.15 * (k - 0.5), 0.05]) + 0.02 * generator.normal(size=3))
        for k, R in enumerate(mounts)
    }
    seconds = measurements / RATE_HZ
    while True:
        truth = _walk(np.arange(0.0, seconds, 1.0 / RATE_HZ), generator)
        seen = [
            (j, k, np.flatnonzero(_visible(inverse(Yk) @ inverse(truth) @ Xj)))
            for j, Xj in enumerate(X.values())
            for k, Yk in enumerate(Y.values())
        ]
        rows = np.concatenate([np.c_[at, np.full_like(at, j), np.full_like(at, k)] for j, k, at in seen])
        if len(rows) >= measurements:
            break
        seconds *= 1.5
    rows = rows[generator.permutation(len(rows))[:measurements]]  # the detector misses some
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    at, j, k = rows.T
    names_X, names_Y = list(X), list(Y)
    B = perturb(
        inverse(np.array(list(Y.values()))[k]) @ inverse(truth[at]) @ np.array(list(X.values()))[j], CAMERA, generator
    )
    good = generator.random(measurements) >= OUTLIERS
    another = generator.permutation(measurements)
    wrong = np.where(
        (generator.random(measurements) < 0.5)[:, None, None], B[another], random_poses(measurements, 3.0, generator)
    )
    B = np.where(good[:, None, None], B, wrong)
    A = inverse(_with_drift(truth, generator))[at]  # T_rig_world, as odometry has it
    problem, masks = rw.Problem(), {}
    for target in range(TARGETS):
        for sensor in range(SENSORS):
            own = (j == target) & (k == sensor)
            if not own.any():
                continue
            pair = (names_X[target], names_Y[sensor])
            problem.add(*pair, A[own], B[own], stamps_ns=np.round(at[own] * 1e9 / RATE_HZ).astype(np.int64))
            masks[pair] = good[own]
    return LongLog(problem, masks, Y)


def _targets(generator: np.random.Generator) -> dict[str, Array]:
    """T_world_tag on the walls of a room of 8 x 6 m, facing inwards."""
    result = {}
    for number, around in enumerate(np.linspace(0.0, 2.0 * np.pi, TARGETS, endpoint=False)):
        outward = np.array([np.cos(around), np.sin(around), 0.0])
        place = np.array([4.0, 3.0, 0.0]) * outward + np.array([0.0, 0.0, 1.4]) + 0.3 * generator.normal(size=3)
        z = -outward
        R = np.column_stack([np.cross([0.0, 0.0, 1.0], z), [0.0, 0.0, 1.0], z])
        R = R @ rotations_of_vectors(0.2 * generator.normal(size=(1, 3)))[0]
        result[f"tag_{number}"] = pose(R, place)
    return result


def _walk(t: Array, generator: np.random.Generator) -> Array:
    """T_world_rig (N, 4, 4): a person walks round the room and looks about; rig's x is forward, z is up."""
    phase = generator.uniform(0.0, 2.0 * np.pi, 8)
    around = 2.0 * np.pi * t / 45.0
    place = np.c_[
        2.0 * np.cos(around) + 0.3 * np.sin(0.9 * t + phase[0]),
        1.4 * np.sin(around) + 0.3 * np.sin(0.7 * t + phase[1]),
        1.4 + 0.2 * np.sin(0.8 * t + phase[2]),
    ]
    yaw = around + 0.9 * np.sin(0.5 * t + phase[3])
    pitch, roll = 0.5 * np.sin(0.6 * t + phase[4]), 0.5 * np.sin(0.45 * t + phase[5])
    zero = np.zeros_like(t)
    R = rotations_of_vectors(np.c_[zero, zero, yaw]) @ rotations_of_vectors(np.c_[zero, pitch, zero])
    return pose(R @ rotations_of_vectors(np.c_[roll, zero, zero]), place)


def _with_drift(truth: Array, generator: np.random.Generator) -> Array:
    """T_world_rig as odometry has it: each step errs, in yaw and in position, and errors add up."""
    count, step = len(truth), np.sqrt(1.0 / RATE_HZ)
    yaw = np.zeros((count, 3))
    yaw[1:, 2] = np.cumsum(generator.normal(scale=DRIFT_RAD * step, size=count - 1))
    turned = rotations_of_vectors(yaw)
    steps = np.einsum("nij,nj->ni", turned[:-1], np.diff(truth[:, :3, 3], axis=0))
    steps += generator.normal(scale=DRIFT_M * step, size=(count - 1, 3))
    return pose(turned @ truth[:, :3, :3], truth[0, :3, 3] + np.vstack([np.zeros(3), np.cumsum(steps, axis=0)]))


def _visible(B: Array) -> NDArray[np.bool_]:
    """Whether a target is in front of the camera, near, within its field, and faces it."""
    distance = np.linalg.norm(B[:, :3, 3], axis=1)
    off_axis = np.arccos(np.clip(B[:, 2, 3] / distance, -1.0, 1.0))
    facing = -np.einsum("ni,ni->n", B[:, :3, 2], B[:, :3, 3]) / distance
    visible: NDArray[np.bool_] = (distance < RANGE_M) & (off_axis < FIELD_RAD) & (facing > 0.4)
    return visible


class Silence:
    """A progress that keeps the longest time between two words."""

    def __init__(self) -> None:
        self.last, self.longest, self.before, self.words = time.perf_counter(), 0.0, "", 0
        self.stage = "the start"

    def __call__(self, stage: str) -> None:
        now = time.perf_counter()
        if now - self.last > self.longest:
            self.longest, self.before = now - self.last, self.stage
        self.last, self.stage = now, stage
        self.words += 1


def rows(seed: int = 0, measurements: int = 3000) -> list[Row]:
    """One log: time, silence, and what was found."""
    log = long_log(seed, measurements)
    frames = len(log.problem.targets) + len(log.problem.sensors)
    what = f"long log, {frames} frames, {measurements} measurements, drift, {100 * OUTLIERS:.0f} % outliers"
    robust = rw.RefineOptions(noise="estimate", robust="gnc")
    return _timed(f"{what}: rw.calibrate", log, lambda told: _calibrated(log.problem, told)) + _timed(
        f"{what}: refine alone", log, lambda told: _refined(log.problem, robust, told)
    )


def _calibrated(problem: rw.Problem, told: Silence) -> tuple[Masks, dict[str, Array]]:
    found = rw.calibrate(problem, progress=told)
    return dict(found.outliers.inliers), {name: found.Y[name].matrix() for name in found.Y}


def _refined(problem: rw.Problem, options: rw.RefineOptions, told: Silence) -> tuple[Masks, dict[str, Array]]:
    found = rw.refine(problem, None, options, progress=told)
    return dict(found.inliers), {name: pose.matrix() for name, pose in found.Y.items()}


def _timed(what: str, log: LongLog, call: Callable[[Silence], tuple[Masks, dict[str, Array]]]) -> list[Row]:
    """The rows of one call, which gives its inliers and the cameras' poses."""
    told = Silence()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RwhecWarning)
        start, work = time.perf_counter(), time.process_time()
        inliers, Y = call(told)
        seconds, work = time.perf_counter() - start, time.process_time() - work
    told("the end")
    kept = sum(int((inliers[pair] & ~mask).sum()) for pair, mask in log.good.items())
    lost = sum(int((~inliers[pair] & mask).sum()) for pair, mask in log.good.items())
    worst = max(float(np.linalg.norm(Y[name][:3, 3] - T[:3, 3])) for name, T in log.Y.items())
    return [
        Row(what, f"{seconds:.1f} s ({work:.1f} s)", f"<= {BAR_S:.0f} s", seconds <= BAR_S),
        Row(
            "    longest time without a word",
            f"{told.longest:.1f} s (after: {told.before})",
            f"<= {SILENCE_S:.0f} s",
            told.longest <= SILENCE_S,
        ),
        Row("    outliers kept; good ones left out", f"{kept}; {lost}"),
        Row("    cameras on the rig, largest error", f"{1e3 * worst:.1f} mm"),
    ]


def main() -> int:
    """Print the table."""
    parser = benchmark_parser(__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--measurements", type=int, default=3000)
    arguments = parser.parse_args()
    return print_rows("Long log", rows(arguments.seed, arguments.measurements), store=arguments.store)


if __name__ == "__main__":
    raise SystemExit(main())
