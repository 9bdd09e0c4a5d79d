"""The RWHEC paper's real dataset (16 tags, 8 cameras, 3230 measurements): cost, gap, scale, and time.

    python benchmarks/real_dataset.py [--repetitions 15]

Timed is all of ``rw.solve`` from a problem that is read already: certificate and identifiability too.
"""

from __future__ import annotations

from functools import partial

from bars import Row, in_words, interleaved, run_script, utias_folder

import gtsam_rwhec as rw
from gtsam_rwhec.solver.solve_options import Method

#: Seconds, on a quiet machine.
BAR_S = 0.025
COST = 8.2812454
SCALE = 1.0254


def real_problem(scale: rw.ScaleMode) -> rw.Problem:
    """All 73 pairs with sigma = kappa = 1."""
    return rw.read_csv(utias_folder(), scale=scale, sigma=1.0, kappa=1.0)


def rows(repetitions: int) -> list[Row]:
    """Answers and times."""
    return answers() + speed(repetitions)


def answers() -> list[Row]:
    """Cost, certificate and scale of both scale modes, by "auto" and by "sdp"."""
    rows = []
    for scale in ("known", "shared"):
        problem = real_problem(scale)
        for method in ("auto", "sdp"):
            solution = rw.solve(problem, method=method)
            c = solution.certificate
            name = f"real dataset, {scale} scale, {method}"
            if scale == "known":
                rows.append(Row(f"{name}: cost", f"{c.cost:.7f}", f"{COST}", abs(c.cost - COST) <= 5.1e-8))
            else:
                off = abs(solution.scale - SCALE)
                rows.append(Row(f"{name}: scale", f"{solution.scale:.5f}", f"{SCALE} +- 1e-3", off <= 1e-3))
            rows += [
                Row(f"{name}: status", c.status, "certified (so unique)", c.is_certified),
                Row(f"{name}: relative gap, rigorous", f"{c.relative_gap:.1e}", "<= 1e-7", c.relative_gap <= 1e-7),
                Row("    stretch", f"{c.relative_gap:.1e}", "<= 1e-10", c.relative_gap <= 1e-10),
                Row("    without the rounding allowance", f"{c.float_gap:.1e}", "<= 1e-12", c.float_gap <= 1e-12),
            ]
    return rows


def speed(repetitions: int) -> list[Row]:
    """Times of "auto" and of "sdp", in turns."""
    problem = real_problem("known")
    methods: tuple[Method, ...] = ("auto", "sdp")
    times = interleaved(repetitions, {method: partial(rw.solve, problem, method=method) for method in methods})
    auto = times.median("auto")
    return [
        Row("rw.solve, auto", in_words(auto), f"<= {in_words(BAR_S)}", auto <= BAR_S),
        Row("rw.solve, sdp", in_words(times.median("sdp"))),
    ]


if __name__ == "__main__":
    run_script("The RWHEC paper's real dataset, sigma = kappa = 1", rows, repetitions=15)
