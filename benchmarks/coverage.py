"""Do 95 % ellipsoids hold the truth in 95 % of runs, and is the refined estimate as good as can be?

    python benchmarks/coverage.py [--runs 1000] [--workers 2]

Coverage: simulated problems (a rig with one sensor and one target, or two of each, among 40 or 20 poses), Langevin and
Gaussian noise of 0.5 degrees and 5 mm or 2 degrees and 20 mm on B, A exact or with 0.3 degrees and 2 mm, scale known
or shared; every frame, the scale and the relative poses on each carrier; with the noise given (chi-square quantiles)
and estimated (F quantiles). Every run has its own rig and its own motion.

Efficiency: the mean squared error of many runs of one rig at small noise, over the Cramer-Rao bound at the truth.

Exits with 1 if a bar is missed.
"""

from __future__ import annotations

import itertools
import os
import sys
import time
import warnings
from collections import Counter, defaultdict
from dataclasses import dataclass
from typing import Literal

import numpy as np
from bars import Row, each_done, given_options, print_rows, wide_console
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import Noise, general, perturb
from gtsam_rwhec.simulate.simulated_noise import rotations_of_vectors

FloatArray = NDArray[np.float64]
CONFIDENCE = 0.95
BAR = 0.02
EFFICIENCY_BAR = 0.05
CHUNK = 25
CARRIER = rw.CarrierNoise(rotation_rad=np.radians(0.3), translation_m=0.002)


@dataclass(frozen=True)
class Case:
    """One kind of problem."""

    kind: Literal["langevin", "gaussian"]
    rotation_deg: float
    translation_mm: float
    scale: Literal["known", "shared"]
    frames: int
    noisy_A: bool

    @property
    def sigma_m(self) -> float:
        return 1e-3 * self.translation_mm

    @property
    def sigma_rad(self) -> float:
        return float(np.radians(self.rotation_deg))

    @property
    def words(self) -> tuple[str, ...]:
        return (
            self.kind,
            f"{self.rotation_deg:g}, {self.translation_mm:g}",
            self.scale,
            f"{self.frames} x {self.frames}",
            "0.3 deg, 2 mm" if self.noisy_A else "exact",
        )


CASES = [
    Case(kind, *noise, scale, frames, noisy_A)
    for kind, noise, scale, frames, noisy_A in itertools.product(
        ("langevin", "gaussian"), ((0.5, 5.0), (2.0, 20.0)), ("known", "shared"), (1, 2), (False, True)
    )
]


def gaussian(poses: FloatArray, sigma_rad: float, sigma_m: float, generator: np.random.Generator) -> FloatArray:
    """R Exp(omega), t + eps, both Gaussian."""
    noisy = poses.copy()
    noisy[:, :3, :3] = noisy[:, :3, :3] @ rotations_of_vectors(generator.normal(0.0, sigma_rad, (len(poses), 3)))
    noisy[:, :3, 3] += generator.normal(0.0, sigma_m, (len(poses), 3))
    return noisy


def simulate(case: Case, seed: np.random.SeedSequence) -> tuple[rw.simulate.Simulation, rw.Problem]:
    """The truth, and a problem with noise on B, and on A where it is the same for all that see it."""
    world, noise, carriers = (np.random.default_rng(s) for s in seed.spawn(3))
    count = 40 if case.frames == 1 else 20
    exact = general(case.frames, case.frames, seed=world, number_of_measurements=count, scale=case.scale)
    problem = rw.Problem(scale=case.scale)
    kappa = 0.5 / case.sigma_rad**2
    A_at: dict[int, FloatArray] = {}
    for pair in exact.problem.pairs:
        raw = exact.problem.measurements(*pair)
        if case.kind == "langevin":
            B = perturb(raw.B, Noise(case.sigma_m, kappa), noise)
        else:
            B = gaussian(raw.B, case.sigma_rad, case.sigma_m, noise)
        A = raw.A
        if case.noisy_A:
            for stamp, pose in zip(raw.stamps_ns, raw.A, strict=True):
                if int(stamp) not in A_at:
                    noisy = gaussian(pose[None], CARRIER.rotation_rad, CARRIER.translation_m, carriers)
                    A_at[int(stamp)] = noisy[0]
            A = np.array([A_at[int(stamp)] for stamp in raw.stamps_ns])
        problem.add(*pair, A, B, case.sigma_m, kappa, stamps_ns=raw.stamps_ns)
    return exact, problem


def refined_of(case: Case, problem: rw.Problem, noise: Literal["given", "estimate"]) -> rw.Refined:
    """Solve and refine."""
    with warnings.catch_warnings(action="ignore", category=rw.errors.RwhecWarning):
        # A's noise makes the costs larger than the weights of B predict; what is not unique has infinite variances.
        solution = rw.solve(problem)
        options = rw.RefineOptions(noise=noise, carrier_noise=CARRIER if case.noisy_A else None)
        return rw.refine(problem, solution, options)


def held(refined: rw.Refined, truth: rw.simulate.Simulation) -> dict[str, bool]:
    """Whether each frame, the scale and each relative pose are inside their ellipsoids."""
    result = {}
    for kind, poses, true in (("X", refined.X, truth.X), ("Y", refined.Y, truth.Y)):
        for name, T in true.items():
            result[f"{kind} {name}"] = refined.contains(name, T, CONFIDENCE)
        if len(poses) > 1:
            first, second = list(poses)[:2]
            T, covariance = refined.relative(first, second)
            error = rw.pose_covariances.error_of(T, np.linalg.inv(true[first]) @ true[second])
            square = float(error @ np.linalg.solve(covariance, error)) if np.isfinite(covariance).all() else 0.0
            result[f"relative {kind}"] = square <= refined.squared_radius(6, CONFIDENCE)
    if refined.scale_mode == "shared":
        error = float(refined.scale) - float(truth.scale)
        result["scale"] = error**2 <= refined.covariance("scale")[0, 0] * refined.squared_radius(1, CONFIDENCE)
    return result


@dataclass(frozen=True)
class Outcome:
    """Of some runs of one case: for each noise source, how many of each quantity held; runs with something free."""

    held: Counter[tuple[str, str]]
    runs: int
    free: int


def run_chunk(case: Case, seeds: list[np.random.SeedSequence]) -> Outcome:
    """Simulate, solve, refine with given and with estimated noise."""
    counts: Counter[tuple[str, str]] = Counter()
    free = 0
    for seed in seeds:
        truth, problem = simulate(case, seed)
        for noise in ("given", "estimate"):
            refined = refined_of(case, problem, noise)
            free += bool(refined.free_directions)
            for quantity, inside in held(refined, truth).items():
                counts[noise, quantity] += inside
    return Outcome(counts, len(seeds), free)


def efficiency(runs: int, seed: int = 3) -> list[Row]:
    """Mean squared errors over the Cramer-Rao bound, frame by frame, rotation and translation apart."""
    rows = []
    for scale in ("known", "shared"):
        case = Case("langevin", 0.1, 1.0, scale, 2, False)
        world = np.random.SeedSequence(seed)
        kappa = 0.5 / case.sigma_rad**2
        exact = general(2, 2, seed=np.random.default_rng(world), number_of_measurements=20, scale=scale)
        at_truth = rw.Problem(scale=scale)
        for pair in exact.problem.pairs:
            raw = exact.problem.measurements(*pair)
            at_truth.add(*pair, raw.A, raw.B, case.sigma_m, kappa)
        bound = rw.refine(at_truth, rw.solve(at_truth), rw.RefineOptions(noise="given"))
        squares: dict[str, list[FloatArray]] = defaultdict(list)
        for of_run in np.random.SeedSequence(seed + 1).spawn(runs):
            generator = np.random.default_rng(of_run)
            problem = rw.Problem(scale=scale)
            for pair in exact.problem.pairs:
                raw = exact.problem.measurements(*pair)
                problem.add(*pair, raw.A, perturb(raw.B, Noise(case.sigma_m, kappa), generator), case.sigma_m, kappa)
            refined = refined_of(case, problem, "given")
            for poses, true in ((refined.X, exact.X), (refined.Y, exact.Y)):
                for name, T in true.items():
                    squares[name].append(rw.pose_covariances.error_of(poses[name], T) ** 2)
            if scale == "shared":
                squares["scale"].append(np.array([(float(refined.scale) - float(exact.scale)) ** 2]))
        ratios = []
        for name, values in squares.items():
            mean, variance = np.mean(values, axis=0), np.diag(bound.covariance(name))
            blocks = (slice(0, 3), slice(3, 6)) if len(variance) == 6 else (slice(0, 1),)
            ratios += [mean[block].sum() / variance[block].sum() for block in blocks]
        worst = max(ratios, key=lambda ratio: abs(ratio - 1.0))
        everything = float(np.mean(ratios))
        rows.append(
            Row(
                f"mean squared error over the Cramer-Rao bound, {scale} scale, {runs} runs of 0.1 deg and 1 mm",
                f"mean {everything:.3f}, worst of {len(ratios)}: {worst:.3f}",
                "1 +- 0.05",
                abs(everything - 1.0) <= EFFICIENCY_BAR and abs(worst - 1.0) <= EFFICIENCY_BAR,
            )
        )
    return rows


def print_table(console: Console, results: dict[Case, Outcome]) -> list[tuple[Case, str, str, float]]:
    """The table, and all shares that miss the bar."""
    table = Table(title="Share of runs whose 95 % ellipsoid holds the truth, %: noise given / estimated")
    for header in ("noise", "deg, mm", "scale", "frames", "A", "X", "Y", "relative", "scale"):
        table.add_column(header, no_wrap=True)
    missed = []
    for case, outcome in results.items():
        cells = []
        for group in ("X ", "Y ", "relative", "scale"):
            shares = []
            for noise in ("given", "estimate"):
                chosen = {
                    q: n / outcome.runs for (s, q), n in outcome.held.items() if s == noise and q.startswith(group)
                }
                if chosen:
                    worst = max(chosen.values(), key=lambda share: abs(share - CONFIDENCE))
                    shares.append(worst)
                    missed += [(case, noise, q, s) for q, s in chosen.items() if abs(s - CONFIDENCE) > BAR]
            colour = "red" if any(abs(s - CONFIDENCE) > BAR for s in shares) else "green"
            cells.append(
                f"[{colour}]" + " / ".join(f"{100 * s:.1f}" for s in shares) + f"[/{colour}]" if shares else ""
            )
        table.add_row(*case.words, *cells)
    console.print(table)
    return missed


def coverage(runs: int, workers: int, seed: int, console: Console) -> dict[Case, Outcome]:
    """All cases, in chunks over processes."""
    seeds = dict(zip(CASES, np.random.SeedSequence(seed).spawn(len(CASES)), strict=True))
    results: dict[Case, list[Outcome]] = {case: [] for case in CASES}
    chunks = []
    for case in CASES:
        of_runs = seeds[case].spawn(runs)
        chunks += [(case, of_runs[first : first + CHUNK]) for first in range(0, runs, CHUNK)]
    for (case, _), outcome in each_done(run_chunk, chunks, workers, "coverage"):
        results[case].append(outcome)
    return {case: joined(outcomes) for case, outcomes in results.items()}


def joined(outcomes: list[Outcome]) -> Outcome:
    """All runs of one case."""
    held: Counter[tuple[str, str]] = Counter()
    for outcome in outcomes:
        held.update(outcome.held)  # unlike a sum of counters, it keeps what held in no run
    return Outcome(held, sum(o.runs for o in outcomes), sum(o.free for o in outcomes))


def main() -> int:
    """Run both; 0 if the bars are met."""
    arguments = given_options(runs=1000, efficiency_runs=4000, workers=os.cpu_count() or 1, seed=0)
    console = wide_console()
    begin = time.perf_counter()
    status = 0
    if arguments.runs:
        results = coverage(arguments.runs, arguments.workers, arguments.seed, console)
        missed = print_table(console, results)
        for case, noise, quantity, share in missed:
            console.print(f"missed: {' '.join(case.words)}, noise {noise}, {quantity}: {100 * share:.1f} %")
        shares = [n / o.runs for o in results.values() for n in o.held.values()]
        free = sum(o.free for o in results.values())
        console.print(
            f"{len(CASES)} cases of {arguments.runs} runs (seed {arguments.seed}) in {time.perf_counter() - begin:.0f} "
            f"s: {len(shares)} shares, mean {100 * np.mean(shares):.2f} %, from {100 * min(shares):.1f} to "
            f"{100 * max(shares):.1f} %; bar 95 +- 2 %, missed by {len(missed)}; {free} answers called not unique."
        )
        status = int(bool(missed))
    if arguments.efficiency_runs:
        status = max(status, print_rows("Efficiency", efficiency(arguments.efficiency_runs)))
    return status


if __name__ == "__main__":
    sys.exit(main())
