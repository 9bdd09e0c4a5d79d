"""A stream on the RWHEC paper's real dataset: times of an update, the final answer beside the batch's, and memory.

    python benchmarks/stream_times.py [--measurements 3230] [--seed 0] [--calibrate]

The 3,230 measurements of 24 frames come in an order at random, so nearly all frames are there from the start. The
processor's time is beside that of the clock, as other programs may run; the peer of an update is ``rw.solve`` of the
same moments. Nothing is lazy in an update but ``refined``, the joint covariance, whose time is a row of its own. With
``--calibrate`` the final answers are those of ``rw.calibrate``, which takes a minute for each; else of ``rw.solve``.
"""

from __future__ import annotations

import gc
import time
import tracemalloc
import warnings

import numpy as np
from bars import Row, at_most, run_script
from capture.streamed import One, add, farthest, ones_of
from real_dataset import real_problem

import gtsam_rwhec as rw

MEDIAN_MS, MOST_MS = 20.0, 60.0
EQUAL = 1e-9


def rows(measurements: int, seed: int, calibrate: bool) -> list[Row]:
    """The table."""
    problem = real_problem("known")
    every = ones_of(problem)
    order = np.random.default_rng(seed).permutation(len(every))
    # One stamp for each, as the files have none: the order of the batch.
    stamped = [One(one.target, one.sensor, one.A, one.B, i, one.sigma, one.kappa) for i, one in enumerate(every)]
    came = [stamped[i] for i in order[:measurements]]
    warnings.simplefilter("ignore")
    stream = rw.Stream()
    clock, processor, covariances, peers = [], [], [], []
    for number, one in enumerate(came):
        begin = time.process_time()
        clock.append(add(stream, one).seconds)
        processor.append(time.process_time() - begin)
        if number % 50 == 49:
            begin = time.process_time()
            _ = stream.last.refined
            covariances.append(time.process_time() - begin)
            moments = stream._store.moments(stream.last.noise_factors)
            begin = time.process_time()
            rw.solve(moments)
            peers.append(time.process_time() - begin)
    table = []
    for what, values, has_bar in (("clock", clock, True), ("processor", processor, False)):
        median, most, longest = 1e3 * np.quantile(values, (0.5, 0.99, 1.0))
        table.append(at_most(f"an update, {what}: median", median, MEDIAN_MS if has_bar else None, " ms"))
        table.append(at_most("    99 %", most, MOST_MS if has_bar else None, " ms", more=f", longest {longest:.0f} ms"))
    ratio = np.median(processor[len(processor) // 2 :]) / np.median(peers)
    table.append(Row("    over rw.solve of the same moments (processor, medians)", f"{ratio:.2f}"))
    table.append(
        Row("    joint covariance, when asked for: median (processor)", f"{1e3 * np.median(covariances):.2f} ms")
    )
    table += [of_answer(stream, came, calibrate=calibrate), of_memory(came)]
    last = stream.last
    table.append(Row("at the end", f"{last}; {len(last.outliers)} outliers"))
    return table


def of_answer(stream: rw.Stream, came: list[One], *, calibrate: bool) -> Row:
    """The final answer beside that of a problem that a batch states, by pair."""
    batch = rw.Problem()
    by_pair: dict[tuple[str, str], list[One]] = {}
    for one in sorted(came, key=lambda one: one.stamp_ns):
        by_pair.setdefault((one.target, one.sensor), []).append(one)
    for pair, ones in by_pair.items():
        A, B = (np.array([getattr(one, name) for one in ones]) for name in ("A", "B"))
        batch.add(*pair, A, B, 1.0, 1.0, stamps_ns=[one.stamp_ns for one in ones])
    how = rw.calibrate if calibrate else rw.solve
    return at_most(f"final answer, rw.{how.__name__}: entry off by", farthest(how(stream.problem), how(batch)), EQUAL)


def of_memory(came: list[One]) -> Row:
    """What a stream of moments holds after all measurements, and after as many again."""
    stream = rw.Stream(options=rw.StreamOptions(keep="moments", window=64, robust=False))
    held = []
    tracemalloc.start()
    for _ in range(2):
        for one in came[:256]:
            add(stream, one)
        gc.collect()  # what nobody holds any more
        held.append(tracemalloc.get_traced_memory()[0] / 1e6)
    tracemalloc.stop()
    words = f"{held[0]:.2f} and {held[1]:.2f} MB"
    return Row('keep="moments": memory after 256 and 512', words, "the same to 2 %", held[1] <= 1.02 * held[0])


if __name__ == "__main__":
    run_script("A stream of the real dataset", rows, measurements=3230, seed=0, calibrate=False)
