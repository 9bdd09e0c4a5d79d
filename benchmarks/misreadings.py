"""Is each misreading named with its cure, and is no good problem accused?

    python benchmarks/misreadings.py [--good 1000] [--seed 0]

Misread: the real dataset, the shipped demo data and five simulated rigs, in each of the ways of
tests/misread_problems.py that change residuals. Good: problems of 16 kinds, from three measurements to streams with
correlated errors, with outliers up to 40 %, large noise, little motion, errors of the arm that nobody models, unknown
scales, wrong weights. A good problem is accused if a misreading is named or its residuals are called implausible.
Exits with 1 if a bar is missed.
"""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from bars import Row, run_script, utias_folder
from misread_problems import KINDS, KINDS_OF_GRAPHS, Kind, misread
from rwhec_factors.se3 import expmap

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.misreadings import misreadings
from gtsam_rwhec.calibration.trial_fits import implausible
from gtsam_rwhec.errors import RwhecError
from gtsam_rwhec.simulate import Motion, Noise, cameras, general, sphere
from gtsam_rwhec.simulate.simulated_noise import random_poses
from gtsam_rwhec.solver.solution import Solution

DEMO = Path(__file__).resolve().parents[1] / "data" / "demo"
NOISE = Noise(0.003, 0.5 / np.radians(0.3) ** 2)
ROUGH = Noise(0.01, 0.5 / np.radians(1.0) ** 2)


def rigs() -> Iterator[tuple[str, rw.Problem, bool]]:
    """Problems to misread: name, problem, and whether several targets or sensors tell the roles."""
    yield "real dataset", rw.read_csv(utias_folder()), True
    yield "demo data", rw.read_csv(DEMO), True
    yield "one sensor, one target", general(1, 1, seed=1, noise=NOISE).problem, False
    yield "two sensors, one target", general(1, 2, seed=2, noise=NOISE, number_of_measurements=30).problem, True
    small = Motion(max_angle_rad=np.radians(40.0), extent_m=0.3)
    arm = general(2, 2, seed=3, noise=ROUGH, number_of_measurements=40, motion=small, noise_in_A=NOISE).problem
    yield "two of each, an arm's motion, 1 degree and 1 cm", arm, True
    with_motions = general(3, 2, seed=4, noise=NOISE, odometry=30, odometry_noise=NOISE).problem
    # A sensor with motions of its own cannot be named as a target.
    yield "three targets, two sensors, and their motions", with_motions, False
    yield "one sensor, a path", sphere(NOISE, 5).problem, False


def solved(problem: rw.Problem) -> Solution | None:
    """The solution, or None where there is none."""
    try:
        return rw.solve(problem)
    except RwhecError:
        return None


def with_outliers(problem: rw.Problem, share: float, generator: np.random.Generator) -> rw.Problem:
    """The problem with a share of each pair's B replaced by random poses within two metres."""
    result = rw.Problem(problem.scale)
    for pair in problem.pairs:
        raw = problem.measurements(*pair)
        B = raw.B.copy()
        wrong = generator.permutation(len(B))[: int(share * len(B))]
        B[wrong] = random_poses(len(wrong), 2.0, generator)
        result.add(*pair, raw.A, B, raw.sigma, raw.kappa)
    return result


def otherwise_weighed(problem: rw.Problem, sigma: float | None, kappa: float | None) -> rw.Problem:
    """The problem with other weights, or with none."""
    result = rw.Problem(problem.scale)
    for pair in problem.pairs:
        raw = problem.measurements(*pair)
        result.add(*pair, raw.A, raw.B, sigma, kappa)
    return result


def with_errors_of_the_arm(problem: rw.Problem, size: float, generator: np.random.Generator) -> rw.Problem:
    """The problem with a twist in A that depends smoothly on the pose: size rad and 0.5 m of it."""
    W = generator.normal(0.0, size / 2.0, (6, 12)) * np.repeat([1.0, 0.5], 3)[:, None]
    result = rw.Problem(problem.scale)
    for pair in problem.pairs:
        raw = problem.measurements(*pair)
        features = raw.A[:, :3, :].reshape(len(raw.A), 12)
        result.add(*pair, raw.A @ expmap(features @ W.T), raw.B, raw.sigma, raw.kappa)
    return result


def correlated(generator: np.random.Generator) -> rw.Problem:
    """A path whose errors of B are correlated in time (0.95 from one to the next), 1 degree and 1 cm."""
    exact = sphere(None, int(generator.integers(1 << 30)), number_of_measurements=200).problem
    raw = exact.measurements(*exact.pairs[0])
    errors = generator.normal(0.0, 1.0, (200, 6)) * np.repeat([np.radians(1.0), 0.01], 3)
    for i in range(1, 200):
        errors[i] = 0.95 * errors[i - 1] + np.sqrt(1.0 - 0.95**2) * errors[i]
    result = rw.Problem()
    result.add("tag", "cam", raw.A, raw.B @ expmap(errors))
    return result


def good_problems() -> dict[str, Callable[[int, np.random.Generator], rw.Problem]]:
    """Kinds of good problems: each makes one from a seed and a generator."""

    def noise(g: np.random.Generator, low: float, high: float) -> Noise:
        degrees = np.exp(g.uniform(np.log(low), np.log(high)))
        return Noise(0.01 * degrees, 0.5 / np.radians(degrees) ** 2)

    def frames(g: np.random.Generator) -> tuple[int, int]:
        return int(g.integers(1, 4)), int(g.integers(1, 4))

    def rig(s: int, g: np.random.Generator, low: float = 0.1, high: float = 1.0, **kwargs: object) -> rw.Problem:
        options = {"number_of_measurements": int(g.integers(10, 60)), "noise": noise(g, low, high)} | kwargs
        return general(*frames(g), seed=s, **options).problem  # type: ignore[arg-type]

    small = Motion(max_angle_rad=np.radians(10.0), extent_m=0.1)
    return {
        "three to eight measurements": lambda s, g: (
            general(1, 1, seed=s, noise=noise(g, 0.1, 5.0), number_of_measurements=int(g.integers(3, 9))).problem
        ),
        "several frames": rig,
        "outliers to 40 %": lambda s, g: with_outliers(rig(s, g), g.uniform(0.05, 0.4), g),
        "outliers to 40 %, few measurements": lambda s, g: with_outliers(
            rig(s, g, number_of_measurements=int(g.integers(5, 15))), g.uniform(0.1, 0.4), g
        ),
        "noise of 3 to 12 degrees": lambda s, g: rig(s, g, 3.0, 12.0),
        "planar or about one axis": lambda s, g: rig(
            s, g, motion=str(g.choice(["planar", "single_axis"])), scale=str(g.choice(["known", "shared"]))
        ),
        "nearly planar": lambda s, g: rig(s, g, motion=Motion("planar", wobble_rad=0.03, wobble_m=0.01)),
        "no rotation": lambda s, g: rig(s, g, motion="none"),
        "little motion": lambda s, g: rig(s, g, 0.3, 3.0, motion=small),
        "a scale per target": lambda s, g: rig(s, g, scale="per_target"),
        "motions": lambda s, g: (
            general(0, 2, seed=s, odometry=20, odometry_noise=noise(g, 0.1, 3.0), scale="shared").problem
        ),
        "noise in A": lambda s, g: rig(s, g, noise_in_A=noise(g, 0.3, 2.0)),
        "errors of the arm": lambda s, g: with_errors_of_the_arm(rig(s, g), np.radians(g.uniform(0.1, 2.0)), g),
        "wrong weights": lambda s, g: otherwise_weighed(rig(s, g), *((3.0, 1e5), (1e-6, 1.0), (None, None))[s % 3]),
        "correlated in time": lambda s, g: correlated(g),
        "the paper's": lambda s, g: (
            (sphere(Noise(0.05, 12.0, "released"), s) if s % 2 else cameras(Noise(0.02, 40.0, "released"), s)).problem
        ),
    }


def named(name: str, problem: rw.Problem, kinds: tuple[Kind, ...]) -> tuple[list[Row], float]:
    """A row for each kind of misreading, and the seconds that all took."""
    rows, seconds = [], 0.0
    for kind in kinds:
        wrong = misread(problem, kind)
        solution = solved(wrong)
        begin = time.process_time()
        found = misreadings(wrong, solution)
        seconds += time.process_time() - begin
        hit = any(one.mistake is kind.mistake and kind.words in str(one) for one in found)
        others = [one.likely for one in found if kind.words not in str(one)]
        # One pair cannot tell A inverted from B inverted: both are said.
        figure = ("named" if hit else "NOT named") + (f", or: {'; '.join(others)}" if others else "")
        rows.append(Row(f"  {name}: {kind.name}", figure, "named", hit))
    return rows, seconds


def accused(number: int, kinds: dict[str, Callable[[int, np.random.Generator], rw.Problem]]) -> tuple[str, list[str]]:
    """The kind of a good problem, and what it is accused of."""
    kind = list(kinds)[number % len(kinds)]
    problem = kinds[kind](number, np.random.default_rng(number))
    solution = solved(problem)
    return kind, [str(one) for one in (*misreadings(problem, solution), implausible(problem, solution)) if one]


def rows(good: int, seed: int) -> list[Row]:
    warnings.simplefilter("ignore")
    table = []
    for name, problem, is_graph in rigs():
        begin = time.process_time()
        found_as_it_is = misreadings(problem, solved(problem))
        cost = time.process_time() - begin
        found, seconds = named(name, problem, KINDS + (KINDS_OF_GRAPHS if is_graph else ()))
        table.append(Row(f"{name}: as it is", str(len(found_as_it_is)), "0", not found_as_it_is))
        table.append(
            Row(f"{name}: seconds as it is, with solving; a misreading", f"{cost:.3f}; {seconds / len(found):.2f}")
        )
        table += found
    accusations: Counter[str] = Counter()
    kinds = good_problems()
    begin = time.process_time()
    for number in range(seed, seed + good):
        kind, reasons = accused(number, kinds)
        for reason in reasons:
            accusations[kind] += 1
            print(f"accused: {kind}, seed {number}: {reason}")
    seconds = time.process_time() - begin
    total = accusations.total()
    table.append(Row("good problems accused", f"{total} of {good}", "0", total == 0))
    table.append(Row("seconds of a good problem, with making and solving it", f"{seconds / max(good, 1):.3f}"))
    return table


if __name__ == "__main__":
    run_script("Misreadings", rows, good=1000, seed=0)
