"""A million measurements on one edge, arrays to certificate with all validation, against copying the arrays.

    python benchmarks/million_measurements.py [--count 1000000] [--repetitions 9]

The measurements are not kept (``keep_measurements=False``), so memory beyond the input must not grow with their
number: its peak is traced at a tenth of the measurements and at all of them, in runs of their own.
"""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable

import numpy as np
from bars import Row, at_most, in_words, interleaved, run_script
from numpy.typing import NDArray

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import Noise, general

NOISE = Noise(sigma_m=0.01, kappa=125.0)
#: What "does not grow" allows at ten times the measurements: a few Python objects.
GROWTH_BYTES = 100_000


def arrays(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A and B (count, 4, 4) of one simulated pair."""
    measured = general(1, 1, seed=1, number_of_measurements=count, noise=NOISE).problem.measurements(
        "target0", "sensor0"
    )
    return measured.A, measured.B


def to_certificate(
    A: NDArray[np.float64],
    B: NDArray[np.float64],
    sigma: float | NDArray[np.float64],
    kappa: float | NDArray[np.float64],
) -> rw.Solution:
    """What is timed: everything from arrays to the solution."""
    problem = rw.Problem(scale="known", keep_measurements=False)
    problem.add("target0", "sensor0", A, B, sigma, kappa)
    return rw.solve(problem)


def peak_bytes(call: Callable[[], object]) -> int:
    """The largest memory beyond what there was before the call."""
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    tracemalloc.reset_peak()
    call()
    peak = tracemalloc.get_traced_memory()[1] - before
    tracemalloc.stop()
    return peak


def rows(count: int, repetitions: int) -> list[Row]:
    """Time and memory."""
    A, B = arrays(count)
    sigmas, kappas = np.full(count, NOISE.sigma_m), np.full(count, NOISE.kappa)

    def copies() -> None:
        A.copy()
        B.copy()

    times = interleaved(
        repetitions,
        {
            "copies": copies,
            "ours": lambda: to_certificate(A, B, NOISE.sigma_m, NOISE.kappa),
            "own weights": lambda: to_certificate(A, B, sigmas, kappas),
        },
    )
    c = to_certificate(A, B, NOISE.sigma_m, NOISE.kappa).certificate
    tenth = count // 10
    few = peak_bytes(lambda: to_certificate(A[:tenth], B[:tenth], NOISE.sigma_m, NOISE.kappa))
    many = peak_bytes(lambda: to_certificate(A, B, NOISE.sigma_m, NOISE.kappa))
    ratio = times.ratio("ours", "copies")
    return [
        at_most(
            f"{count:,} measurements, arrays to certificate, over A.copy(); B.copy()", ratio, 10.0, "x", ".2f",
            f" ({in_words(times.median('ours'))}; copies {in_words(times.median('copies'))})",
        ),
        Row("    with a sigma and a kappa for each measurement", f"{times.ratio('own weights', 'copies'):.2f}x"),
        Row("    status, relative gap", f"{c.status}, {c.relative_gap:.1e}", "certified", c.is_certified),
        Row(
            f"    peak memory beyond the input, {tenth:,} and {count:,}",
            f"{few / 1e6:.2f} MB, {many / 1e6:.2f} MB (input {(A.nbytes + B.nbytes) / 1e6:.0f} MB)",
            "O(1)",
            many - few <= GROWTH_BYTES,
        ),
    ]  # fmt: skip


if __name__ == "__main__":
    run_script("Many measurements", rows, count=1_000_000, repetitions=9)
