"""Problems of 130 to 400 frames that the multipliers of R'R = I do not prove: how many are proven now, and how.

    python benchmarks/large_duals.py [--problems 100] [--most 400] [--kinds star chain ...] [--seed 1]

Drawn at random: stars, stars of several sensors, chains, and graphs with 2 % of the pairs, of 2 to 6 measurements a
pair; with noise of 20 to 50 degrees and 10 to 50 cm, or with noise of half a degree and 10 to 40 % of measurements that
have nothing to do with the pose; with known and shared scale. What R'R = I proves, with the first answer or a better
one, is not counted. CPU seconds are those of the whole search.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence

import numpy as np
from bars import Row, run_script

import gtsam_rwhec as rw
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.simulate.simulated_noise import random_poses
from gtsam_rwhec.solver.certificate import Cause, Multipliers
from gtsam_rwhec.solver.parts import parts_of
from gtsam_rwhec.solver.search import Found, Search
from gtsam_rwhec.solver.solve_options import SolveOptions

KINDS = ("star", "many sensors", "chain", "graph")


def pairs_of(kind: str, frames: int, generator: np.random.Generator) -> list[tuple[int, int]]:
    """(target, sensor) of each pair."""
    if kind == "star":
        return [(j, 0) for j in range(frames - 1)]
    if kind == "many sensors":
        return [(j, k) for j in range(frames - 6) for k in range(6) if k == j % 6 or generator.random() < 0.3]
    half = frames // 2
    chain = [(j, j) for j in range(half)] + [(j, j + 1) for j in range(half - 1)]
    if kind == "chain":
        return chain
    more = np.argwhere(generator.random((half, half)) < 0.02)
    return sorted(set(chain) | {(int(j), int(k)) for j, k in more})


def drawn(kind: str, frames: int, generator: np.random.Generator) -> rw.Problem:
    """A problem whose measurements are noisy or wrong."""
    pairs = pairs_of(kind, frames, generator)
    targets, sensors = (max(each) + 1 for each in zip(*pairs, strict=True))
    count = int(generator.integers(2, 7))
    scale: rw.ScaleMode = "shared" if generator.random() < 0.25 else "known"
    large = Noise(float(generator.uniform(0.1, 0.5)), float(0.5 / np.radians(generator.uniform(20.0, 50.0)) ** 2))
    small = Noise(0.01, 6500.0)
    is_noisy, wrong = generator.random() < 0.5, float(generator.uniform(0.1, 0.4))
    seed = int(generator.integers(2**31))
    counts = {Pair(f"target{j}", f"sensor{k}"): count for j, k in pairs}
    simulation = general(
        targets,
        sensors,
        seed=seed,
        graph=pairs,
        number_of_measurements=counts,
        noise=large if is_noisy else small,
        scale=scale,
    )
    if is_noisy:
        return simulation.problem
    problem = rw.Problem(scale=scale)
    for pair in simulation.problem.pairs:
        kept = simulation.problem.measurements(*pair)
        B = kept.B.copy()
        bad = np.flatnonzero(generator.random(len(B)) < wrong)
        B[bad] = random_poses(len(bad), 2.0, generator)
        problem.add(*pair, kept.A, B, sigma=small.sigma_m, kappa=small.kappa)
    return problem


def is_by_orthogonality(found: Found) -> bool:
    """Whether the multipliers of R'R = I prove the answer."""
    return found.is_closed and found.path.multipliers is Multipliers.KKT


def rows(problems: int, most: int, kinds: Sequence[str], seed: int) -> list[Row]:
    """Searches until so many problems needed more."""
    generator = np.random.default_rng(seed)
    tried, causes, of_kind, seconds = 0, Counter[Cause](), Counter[tuple[str, bool]](), list[float]()
    while sum(causes.values()) < problems:
        kind = kinds[tried % len(kinds)]
        problem = drawn(kind, int(generator.integers(130, most + 1)), generator)
        tried += 1
        part = max(parts_of(problem), key=lambda part: len(part.free))
        begun = time.process_time()
        found = Search.of(part, SolveOptions()).run("auto", None)
        if len(part.free) <= SolveOptions().max_dense_frames or is_by_orthogonality(found):
            continue
        seconds.append(time.process_time() - begun)
        causes[found.cause] += 1
        of_kind[kind, found.is_closed] += 1
    proven = sum(count for (_, is_closed), count in of_kind.items() if is_closed)
    return [
        Row("problems that R'R = I does not prove: proven now", f"{proven} of {problems} ({tried} were drawn)"),
        *(
            Row(f"    {kind}", f"{of_kind[kind, True]} of {of_kind[kind, True] + of_kind[kind, False]}")
            for kind in kinds
        ),
        *(Row(f"    {cause}", f"{count}") for cause, count in sorted(causes.items())),
        Row(
            "CPU seconds of a search: median, 90 %, longest",
            ", ".join(f"{value:.1f}" for value in np.quantile(seconds, (0.5, 0.9, 1.0))),
        ),
    ]


if __name__ == "__main__":
    run_script("Large duals", rows, problems=100, most=400, kinds=KINDS, seed=1)
