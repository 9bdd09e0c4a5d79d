"""What `rw.calibrate` says where its user's assumptions are wrong, with no option given.

    python benchmarks/wrong_assumptions.py [--runs 1000] [--rows NAME ...] [--jobs 2]

An arm holds two cameras that see two targets, 40 measurements of each pair at the same 40 stations, two seconds apart.
B's noise is 0.3 degrees and 3 mm an axis; each row adds one thing that the user does not know of. Printed are the
shares of 95 % ellipsoids that hold the truth (of the targets, of the sensors, of one sensor in the other), and of
verdicts that are not USE. A row is met where every share's 99 % binomial interval meets 92 to 98 %, or the verdict is
not USE in at least 99 % of runs. Exits with 1 if one is missed.
"""

from __future__ import annotations

import os
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from bars import Row, Share, each_done, run_script
from rwhec_factors.se3 import inverse
from simulated_arms import ARM, BENT_RAD, FloatArray, moved_by, white

import gtsam_rwhec as rw
from gtsam_rwhec.errors import RwhecError, RwhecWarning
from gtsam_rwhec.simulate.simulated_noise import random_poses

STATIONS, PERIOD_NS = 40, 2_000_000_000
ROTATION_RAD, TRANSLATION_M = float(np.radians(0.3)), 0.003
#: A's noise in a row: this many metres a radian, as B's.
METRES_A_RADIAN = TRANSLATION_M / ROTATION_RAD
LEVEL, BAND, NOT_USED, CHUNK = 0.95, (0.92, 0.98), 0.99, 10
NAMES = ("targets", "sensors", "between sensors")


@dataclass(frozen=True)
class Wrong:
    """One row: what is not as the user assumes."""

    noise_of_A_deg: float = 0.0
    #: Each measurement's noise is this share of the one before it of the same pair, and new noise.
    correlation: float = 0.0
    #: Steps of a walk on top of white noise, as a share of that.
    walk: float = 0.0
    tails: float = np.inf
    arm: float = 0.0
    tag: float = 0.0
    outliers: float = 0.0


CASES = {
    "nothing": Wrong(),
    "A's noise 0.1 degrees": Wrong(noise_of_A_deg=0.1),
    "A's noise 0.3 degrees": Wrong(noise_of_A_deg=0.3),
    "A's noise 1 degree": Wrong(noise_of_A_deg=1.0),
    "B correlated, AR(1) .9": Wrong(correlation=0.9),
    "B correlated, AR(1) .98": Wrong(correlation=0.98),
    "random walk in B": Wrong(walk=0.5),
    "Student t, 3 degrees of freedom": Wrong(tails=3.0),
    "Student t, 2 degrees of freedom": Wrong(tails=2.0),
    "arm's joints 0.1 degrees, links 0.5 mm off": Wrong(arm=1.0),
    "four times that": Wrong(arm=4.0),
    "a tag's size 1 % wrong": Wrong(tag=0.01),
    "a tag's size 3 % wrong": Wrong(tag=0.03),
    "20 % outliers": Wrong(outliers=0.2),
    "40 % outliers": Wrong(outliers=0.4),
}


@dataclass(frozen=True)
class World:
    """The truth, and the problem that its user has."""

    X: dict[str, FloatArray]
    Y: dict[str, FloatArray]
    problem: rw.Problem


def simulate(wrong: Wrong, generator: np.random.Generator) -> World:
    """One world: where things are, how the arm stood, and what was measured."""
    joints = BENT_RAD + np.radians(generator.uniform(-40.0, 40.0, (STATIONS, 6)))
    true_arm = ARM.misbuilt(wrong.arm * np.radians(0.1), wrong.arm * 5e-4, generator) if wrong.arm else ARM
    T_base_hand, reported = true_arm.hand(joints), ARM.hand(joints)
    if wrong.noise_of_A_deg:
        sigma = np.radians(wrong.noise_of_A_deg)
        reported = moved_by(reported, white(STATIONS, sigma, METRES_A_RADIAN * sigma, generator))
    # Cameras within 15 cm of the hand, targets within 40 cm of a place on the table before the arm.
    sensors = random_poses(2, 0.15, generator)
    targets = random_poses(2, 0.4, generator)
    targets[:, :3, 3] += ARM.hand(BENT_RAD[None])[0, :3, 3] * [1.0, 1.0, 0.0]
    X = {f"target_{j}": T for j, T in enumerate(targets)}
    Y = {f"camera_{k}": T for k, T in enumerate(sensors)}
    problem = rw.Problem()
    stamps = PERIOD_NS * np.arange(1, STATIONS + 1)
    for target, T_base_target in X.items():
        for sensor, T_hand_sensor in Y.items():
            B = inverse(T_base_hand @ T_hand_sensor) @ T_base_target
            B[:, :3, 3] *= 1.0 + wrong.tag * (target == "target_0")
            B = moved_by(B, noise_of(wrong, generator))
            gross = generator.permutation(STATIONS)[: round(wrong.outliers * STATIONS)]
            B[gross] = random_poses(len(gross), 1.0, generator)
            problem.add(target, sensor, inverse(reported), B, stamps_ns=stamps)
    return World(X, Y, problem)


def noise_of(wrong: Wrong, generator: np.random.Generator) -> FloatArray:
    """The noise xi (N, 6) of one pair's measurements, in order of time."""
    xi = white(STATIONS, ROTATION_RAD, TRANSLATION_M, generator)
    if wrong.correlation:
        new = np.sqrt(1.0 - wrong.correlation**2)
        for i in range(1, STATIONS):
            xi[i] = wrong.correlation * xi[i - 1] + new * xi[i]
    if wrong.walk:
        xi += wrong.walk * np.cumsum(white(STATIONS, ROTATION_RAD, TRANSLATION_M, generator), axis=0)
    if np.isfinite(wrong.tails):
        xi *= np.sqrt(wrong.tails / generator.chisquare(wrong.tails, (STATIONS, 1)))
    return xi


@dataclass(frozen=True)
class Outcome:
    """Of some runs: what held, by name; verdicts; runs in which the call raised."""

    held: dict[str, Share]
    verdicts: Counter[str]
    runs: int

    def __add__(self, other: Outcome) -> Outcome:
        held = {
            name: Share(self.held[name].held + other.held[name].held, self.held[name].runs + other.held[name].runs)
            for name in NAMES
        }
        return Outcome(held, self.verdicts + other.verdicts, self.runs + other.runs)

    @property
    def not_used(self) -> Share:
        """Verdicts that are not USE."""
        return Share(self.runs - self.verdicts["use"], self.runs)

    @property
    def is_met(self) -> bool:
        """By the shares of ellipsoids, or by the verdicts."""
        return all(self.held[name].meets(*BAND) for name in NAMES) or self.not_used.value >= NOT_USED


def held_by(calibration: rw.Calibration, world: World) -> dict[str, list[bool]]:
    """Which 95 % ellipsoids hold the truth; none where a frame has no ellipsoid."""
    if calibration.refined is None or set(calibration.X | calibration.Y) != set(world.X | world.Y):
        return {name: [] for name in NAMES}
    T, covariance = calibration.relative(*world.Y)
    first, second = world.Y.values()
    error = rw.pose_covariances.error_of(T, inverse(first) @ second)
    known = bool(np.isfinite(covariance).all())
    square = float(error @ np.linalg.solve(covariance, error)) if known else 0.0
    return {
        "targets": [calibration.contains(name, T, LEVEL) for name, T in world.X.items()],
        "sensors": [calibration.contains(name, T, LEVEL) for name, T in world.Y.items()],
        "between sensors": [square <= calibration.squared_radius(6, LEVEL)],
    }


def run_chunk(name: str, seeds: list[np.random.SeedSequence]) -> Outcome:
    """Simulate and calibrate."""
    held: dict[str, list[bool]] = {name: [] for name in NAMES}
    verdicts: Counter[str] = Counter()
    for seed in seeds:
        world = simulate(CASES[name], np.random.default_rng(seed))
        try:
            with warnings.catch_warnings(action="ignore", category=RwhecWarning):
                calibration = rw.calibrate(world.problem)
        except RwhecError as error:
            verdicts[f"raised {type(error).__name__}"] += 1
            continue
        verdicts[calibration.verdict.value] += 1
        for what, outcomes in held_by(calibration, world).items():
            held[what] += outcomes
    return Outcome({name: Share.of(outcomes) for name, outcomes in held.items()}, verdicts, len(seeds))


def outcomes(names: list[str], runs: int, jobs: int, seed: int = 0) -> dict[str, Outcome]:
    """All rows, in chunks over processes; each row's runs are the same whichever others are run."""
    of_row = dict(zip(CASES, np.random.SeedSequence(seed).spawn(len(CASES)), strict=True))
    nothing = Outcome(dict.fromkeys(NAMES, Share(0, 0)), Counter(), 0)
    found = dict.fromkeys(names, nothing)
    chunks = []
    for name in names:
        of_runs = of_row[name].spawn(runs)
        chunks += [(name, of_runs[first : first + CHUNK]) for first in range(0, runs, CHUNK)]
    for (name, _), outcome in each_done(run_chunk, chunks, jobs, "wrong assumptions"):
        found[name] += outcome
    return found


def table(runs: int, jobs: int, rows: Sequence[str]) -> list[Row]:
    """The table against the bar."""
    result = []
    for name, outcome in outcomes(list(rows), runs, jobs).items():
        shares = ", ".join(f"{what} {outcome.held[what].value:.3f}" for what in NAMES)
        said = ", ".join(f"{verdict} {number}" for verdict, number in outcome.verdicts.most_common())
        result.append(Row(name, f"{shares}; {said}", "meets .92 to .98, or not USE in .99", outcome.is_met))
    return result


if __name__ == "__main__":
    run_script("Wrong assumptions, {runs} runs a row", table, runs=1000, jobs=os.cpu_count() or 1, rows=tuple(CASES))
