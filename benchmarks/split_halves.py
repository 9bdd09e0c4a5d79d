"""Each half of a dense log calibrated apart: are the two answers as near as their covariances claim?

    python benchmarks/split_halves.py [--runs 300] [--frames 1500] [--jobs 2]

The logs are those of `dense_logs.py`. The difference of the two hand-eye poses, squared by the sum of their
covariances, is within the 99 % bound in 98 to 100 % of runs if the covariances are true. (What both halves do not see,
such as the arm's constant error, is in both covariances and in neither difference.) Exits with 1 if not.
"""

from __future__ import annotations

import os
import warnings
from collections import Counter
from dataclasses import dataclass

import dense_logs
import numpy as np
from bars import Row, Share, each_done, run_script
from scipy.special import chdtri

import gtsam_rwhec as rw
from gtsam_rwhec.errors import RwhecWarning

LEVEL, BAND = 0.99, (0.98, 1.0)
FRAMES = {"camera on hand": dense_logs.CAMERA, "board": dense_logs.BOARD}


@dataclass(frozen=True)
class Halves:
    """Of one log, by frame: the squared difference over its covariance, the claimed bound, mm; both verdicts."""

    squares: dict[str, float]
    bounds: dict[str, float]
    distance_mm: dict[str, float]
    verdicts: tuple[str, str]
    #: Whether each half's own 95 % ellipsoid holds the true camera.
    held: tuple[bool, bool]


def run(seed: np.random.SeedSequence, frames: int) -> Halves:
    """Simulate a log, and calibrate its halves."""
    log = dense_logs.simulate(frames, np.random.default_rng(seed))
    with warnings.catch_warnings(action="ignore", category=RwhecWarning):
        halves = [rw.calibrate(log.problem(part)) for part in (slice(0, frames // 2), slice(frames // 2, frames))]
    squares, bounds, distances = {}, {}, {}
    for name, frame in FRAMES.items():
        first, second = ((half.X | half.Y)[frame] for half in halves)
        error = rw.pose_covariances.error_of(first, second.matrix())
        covariance = sum(half.covariance(frame) for half in halves)
        # A free direction has an infinite variance: then nothing is claimed that the difference could contradict.
        known = bool(np.isfinite(covariance).all())
        squares[name] = float(error @ np.linalg.solve(covariance, error)) if known else 0.0
        bounds[name] = max(half.squared_radius(6, LEVEL) for half in halves)
        distances[name] = 1e3 * float(np.linalg.norm(first.translation() - second.translation()))
    first_verdict, second_verdict = (half.verdict.value for half in halves)
    first_held, second_held = (half.contains(dense_logs.CAMERA, log.Y, 0.95) for half in halves)
    return Halves(squares, bounds, distances, (first_verdict, second_verdict), (first_held, second_held))


def runs_of(runs: int, frames: int, jobs: int, seed: int = 0) -> list[Halves]:
    """All runs, in processes if there are several jobs."""
    calls = [(of_run, frames) for of_run in np.random.SeedSequence(seed).spawn(runs)]
    return [halves for _, halves in each_done(run, calls, jobs, "split halves")]


def rows(runs: int, frames: int, jobs: int) -> list[Row]:
    """The shares against the bar."""
    found = runs_of(runs, frames, jobs)
    said = Counter(verdict for halves in found for verdict in halves.verdicts)
    words = ", ".join(f"{verdict} {number}" for verdict, number in said.most_common())
    result = []
    for name in FRAMES:
        within = Share.of([halves.squares[name] <= halves.bounds[name] for halves in found])
        chi2 = Share.of([halves.squares[name] <= chdtri(6, 1.0 - LEVEL) for halves in found])
        squares = [halves.squares[name] for halves in found]
        apart = np.median([halves.distance_mm[name] for halves in found])
        is_camera = name == "camera on hand"
        result.append(
            Row(
                f"halves of {frames:,} frames, {name}: difference within the claimed 99 % bound",
                f"{within}; of chi2(6) {100 * chi2.value:.1f} %; squares: median {np.median(squares):.2f}, most "
                f"{max(squares):.1f}; median distance {apart:.2f} mm; {words}",
                f"{100 * BAND[0]:g} to {100 * BAND[1]:g} %" if is_camera else "",
                BAND[0] <= within.value <= BAND[1] if is_camera else None,
            )
        )
    truth = Share.of([held for halves in found for held in halves.held])
    result.append(Row("    95 % ellipsoids of a half that hold the true camera", str(truth)))
    return result


if __name__ == "__main__":
    run_script("Split halves, {runs} logs", rows, runs=300, frames=1500, jobs=os.cpu_count() or 1)
