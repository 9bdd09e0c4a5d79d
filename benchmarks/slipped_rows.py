"""Are rows that slipped found, with the row where they begin, and repaired; and is no good problem accused?

    python benchmarks/slipped_rows.py [--logs 100] [--good 1000] [--seed 0]

Slipped: simulated logs of 15 to 300 images, at stations or on a smooth path, of one or two sensors, with noise of 0.05
to 1.5 degrees and up to 10 % of wrong measurements. Of the images one to three have no detection, and a script leaves
those out of B and not of A; in some logs poses are left out of A. A path turns by 1 to 8 degrees from row to row, and
has noise up to 0.3 degrees: a slip by less than the noise is none. A log counts as found if the first row is the true
one, or among the rows that are said to fit as well. Good: the 16 kinds of benchmarks/misreadings.py, and the same logs
without a slip, some with a clock that is late by part of a row. Exits with 1 if a bar is missed.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass

import numpy as np
from bars import Row, run_script
from misreadings import good_problems, solved
from rwhec_factors.se3 import expmap, inverse, logmap

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.misreadings import is_plain
from gtsam_rwhec.calibration.slipped_rows import Slip, Slips, slips_of
from gtsam_rwhec.calibration.trial_fits import Sampled, residual_of, signal_of
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.simulate.simulated_noise import random_poses


@dataclass(frozen=True)
class Log:
    """A log whose rows slipped; ``rows`` has the first row of each slip, counted from one."""

    problem: rw.Problem
    rows: tuple[int, ...]
    words: str
    lost_poses: int  #: Rows at a slip that have no pose at all: the slip may as well begin after them

    def has(self, number: int, slip: Slip) -> bool:
        """Whether a slip begins where the log's does."""
        return slip.between[0] <= self.rows[number] + self.lost_poses and self.rows[number] <= slip.between[1]


def path_of(n: int, g: np.random.Generator) -> Array:
    """Poses (n, 4, 4) of a smooth path, with 1 to 8 degrees from one to the next."""
    step = np.radians(np.exp(g.uniform(0.0, np.log(8.0))))
    waves = np.arange(n)[:, None, None] * g.uniform(0.5, 1.5, (1, 2, 6)) + g.uniform(0.0, 200.0, (1, 2, 6))
    xi = np.sin(0.2 * waves).sum(axis=1)
    speed = np.median(np.linalg.norm(np.diff(xi[:, :3], axis=0), axis=1))
    # as many radians a row as asked for: slower waves, and not smaller ones
    phase = np.arange(n) * step / (0.5 * speed)
    waves = phase[:, None, None] * g.uniform(0.5, 1.5, (1, 2, 6)) + g.uniform(0.0, 200.0, (1, 2, 6))
    return expmap(np.repeat([0.5, 0.25], 3) * np.sin(0.2 * waves).sum(axis=1))


def stations_of(n: int, g: np.random.Generator) -> Array:
    """Poses (n, 4, 4) at which an arm stands: 10 to 40 degrees and 0.1 to 0.4 m about a middle."""
    size = np.repeat([np.radians(g.uniform(10.0, 40.0)), g.uniform(0.1, 0.4)], 3)
    return expmap(g.normal(size=(n, 6)) * size / np.sqrt(2.0))


def log_of(seed: int, *, lost: int | None = None, late: float = 0.0) -> Log:
    """A log; ``lost``: how many images have no detection, by default one to three; ``late``: rows of a path."""
    g = np.random.default_rng(seed)
    n = round(np.exp(g.uniform(np.log(15), np.log(300))))
    is_path = bool(g.random() < 0.5)
    degrees = np.exp(g.uniform(np.log(0.05), np.log(0.3 if is_path else 1.5)))
    sensors = ("cam_0", "cam_1")[: int(g.integers(1, 3))]
    wrong, of_poses = g.uniform(0.0, 0.1) * (g.random() < 0.5), bool(g.random() < 0.2)
    lost = int(g.integers(1, 4)) if lost is None else lost
    total = n + lost
    moved = path_of if is_path else stations_of
    fine = moved(total, g)
    out = np.sort(g.choice(np.arange(2, total - 4), lost, replace=False)) if lost else np.zeros(0, dtype=int)
    X = random_poses(1, 0.5, g)[0]
    problem = rw.Problem()
    for sensor in sensors:
        Y = random_poses(1, 0.5, g)[0]
        noise = expmap(g.normal(size=(total, 6)) * np.repeat([np.radians(degrees), 0.01 * degrees], 3))
        B = inverse(Y) @ fine @ X @ noise
        if late and is_path:
            B[:-1] = B[:-1] @ expmap(late * logmap(inverse(B[:-1]) @ B[1:]))
        bad = g.random(total) < wrong
        B[bad] = random_poses(int(bad.sum()), 1.0, g)
        A = fine
        first, second = (np.delete(A, out, axis=0), B) if of_poses else (A, np.delete(B, out, axis=0))
        problem.add("tag", sensor, first[:n], second[:n])
    # the k-th image that is lost makes the row of the next one slip, among the rows that are left
    at = [int(row) - k * (not of_poses) + 1 for k, row in enumerate(out.tolist())]
    rows = tuple(row for row in dict.fromkeys(at) if not (of_poses and row - 1 in at))
    kind = "path" if is_path else "stations"
    words = f"seed {seed}: {n} rows, {kind}, {degrees:.2g} deg, {len(sensors)} sensors, {100 * wrong:.0f} % wrong"
    return Log(
        problem, rows, f"{words}, {lost} {'poses' if of_poses else 'images'} lost, slips at {rows}", of_poses * lost
    )


def slips_in(problem: rw.Problem) -> Slips | None:
    """The detection as ``calibrate`` calls it."""
    solution = solved(problem)
    sampled = Sampled.of(problem)
    if sampled is None:
        return None
    plain = solution is not None and (residual := residual_of(problem, solution)) is not None
    return slips_of(problem, solution, is_plain=plain and is_plain(residual, signal_of(sampled.as_read())))


def rows(logs: int, good: int, seed: int) -> list[Row]:
    warnings.simplefilter("ignore")
    found = exact = whole = 0
    widths, begin = [], time.process_time()
    for number in range(logs):
        log = log_of(seed + number)
        slips = slips_in(log.problem)
        if slips is None:
            print(f"not found: {log.words}")
            continue
        of_one = [slip for slip in slips.slips if slip.pair == slips.slips[0].pair]
        low, high = of_one[0].between
        is_right = log.has(0, of_one[0])
        if not is_right:
            print(f"another row ({'; '.join(map(str, of_one))}): {log.words}")
        found += is_right
        exact += of_one[0].from_row == log.rows[0]
        all_right = len(of_one) == len(log.rows) and all(log.has(number, slip) for number, slip in enumerate(of_one))
        whole += all_right
        if is_right and not all_right:
            print(f"other slips ({'; '.join(map(str, of_one))}): {log.words}")
        widths.append(high - low + 1)
    seconds = (time.process_time() - begin) / max(logs, 1)
    accused, slow = 0, 0.0
    kinds = good_problems()
    begin = time.process_time()
    for number in range(good):
        g = np.random.default_rng(seed + number)
        if number % 2:
            name = list(kinds)[number // 2 % len(kinds)]
            problem = kinds[name](seed + number, g)
        else:
            log = log_of(100_000 + seed + number, lost=0, late=(0.0, 0.5, 0.3, 0.9)[number // 2 % 4])
            name, problem = log.words, log.problem
        start = time.process_time()
        slips = slips_in(problem)
        slow = max(slow, time.process_time() - start)
        if slips is not None:
            accused += 1
            print(f"accused: {name}, number {number}: {'; '.join(map(str, slips.slips))}")
    each = (time.process_time() - begin) / max(good, 1)
    return [
        Row("slips found, with the row", f"{found} of {logs}", ">= 95 %", found >= 0.95 * logs),
        Row(
            "  of these the very row; the median number of rows that fit as well",
            f"{exact}; {np.median(widths or [0]):.0f}",
        ),
        Row("  every slip of the log with its row", f"{whole}"),
        Row("  seconds of a log, with making and solving it", f"{seconds:.2f}"),
        Row("good problems accused", f"{accused} of {good}", "0", accused == 0),
        Row("  seconds of a good problem; the longest", f"{each:.2f}; {slow:.2f}"),
    ]


if __name__ == "__main__":
    run_script("Slipped rows", rows, logs=100, good=1000, seed=0)
