"""The RWHEC paper's real dataset (16 tags, 8 cameras, 3230 measurements): cost, gap, scale, and time against SCS.

    python benchmarks/real_dataset.py [--no-scs] [--repetitions 15]

SCS solves the same relaxation, once (it takes a minute or so); "auto" and "sdp" are timed before and after it. "auto"
is timed from the problem with its moments to the certificate, that is until ``solve`` calls its progress display with
"identifiability"; the whole of ``solve``, reading of the files apart, is a row of its own.
"""

from __future__ import annotations

import time

import numpy as np
from bars import Row, benchmark_parser, print_rows
from dataset import utias_folder
from interleaved import in_words
from scs_relaxation import ScsResult, solve_by_scs

import gtsam_rwhec as rw
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.parts import parts_of
from gtsam_rwhec.solver.solve_options import Method

COST = 8.2812454
SCALE = 1.0254


def real_problem(scale: rw.ScaleMode) -> rw.Problem:
    """All 73 pairs with sigma = kappa = 1."""
    return rw.read_csv(utias_folder(), scale=scale, sigma=1.0, kappa=1.0)


def timed(problem: rw.Problem, method: Method) -> tuple[float, float, rw.Solution]:
    """Seconds until the certificate, seconds of all of ``solve``, and its solution."""
    certified_at = [0.0]

    def progress(stage: str) -> None:
        if stage == "identifiability":
            certified_at[0] = time.perf_counter()

    start = time.perf_counter()
    solution = rw.solve(problem, method=method, progress=progress)
    return certified_at[0] - start, time.perf_counter() - start, solution


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
    """Times of "auto" and "sdp" against SCS on the same relaxation."""
    problem = real_problem("known")
    (part,) = parts_of(problem)
    Q = PartForm.of(part).reduced.Q
    few = max(1, repetitions // 5)
    timed(problem, "auto")  # warms up
    auto = [timed(problem, "auto") for _ in range(repetitions)]
    sdp = [timed(problem, "sdp") for _ in range(few)]
    scs = solve_by_scs(Q)
    auto += [timed(problem, "auto") for _ in range(repetitions)]
    sdp += [timed(problem, "sdp") for _ in range(few)]
    return [_scs_row(scs), *_against("auto", auto, scs, 300.0, 1000.0), *_against("sdp", sdp, scs, 5.0, 30.0)]


def _scs_row(scs: ScsResult) -> Row:
    figure = f"{scs.seconds:.1f} s, {scs.iterations} iterations, {scs.status}, optimum {scs.gamma:.8f}"
    return Row(f"SCS, eps 1e-8 (set-up of {in_words(scs.setup_seconds)} apart)", figure)


def _against(
    method: str, runs: list[tuple[float, float, rw.Solution]], scs: ScsResult, bar: float, stretch: float
) -> list[Row]:
    to_certificate = float(np.median([run[0] for run in runs]))
    whole = float(np.median([run[1] for run in runs]))
    ratio = scs.seconds / to_certificate
    difference = abs(scs.gamma / runs[0][2].cost - 1.0)
    return [
        Row(
            f"{method}: SCS's time over ours, moments to certificate",
            f"{ratio:.0f}x ({in_words(to_certificate)})",
            f">= {bar:g}x",
            ratio >= bar,
        ),
        Row("    stretch", f"{ratio:.0f}x", f">= {stretch:g}x", ratio >= stretch),
        Row("    all of solve, identifiability too", f"{scs.seconds / whole:.0f}x ({in_words(whole)})"),
        Row("    optimum against SCS's, relative", f"{difference:.1e}", "<= 1e-7", difference <= 1e-7),
    ]


def main() -> int:
    """Print the table."""
    parser = benchmark_parser(__doc__)
    parser.add_argument("--no-scs", action="store_true", help="leave out the rows that need SCS")
    parser.add_argument("--repetitions", type=int, default=15, help="of auto, before SCS and again after it")
    arguments = parser.parse_args()
    rows = answers() + ([] if arguments.no_scs else speed(arguments.repetitions))
    return print_rows("The RWHEC paper's real dataset, sigma = kappa = 1", rows, store=arguments.store)


if __name__ == "__main__":
    raise SystemExit(main())
