"""Refinement from corners: time and memory of a large cell.

    python benchmarks/corner_times.py [--views 250]

Four cameras with 250 images each of a board of 70 corners; intrinsics, the board's size and warp, and the carriers'
poses are all free, the noise is estimated; the joint covariance is part of it. Then the same with every tenth corner
misread; and with carriers that move, every camera's clock free, and every corner's place on the board. Times are on the
clock; the processor's own are in brackets.
"""

from __future__ import annotations

import resource
import time
from dataclasses import replace

import bars
import numpy as np
import simulated_cells

import gtsam_rwhec as rw
from gtsam_rwhec.cameras.targets import Checkerboard
from gtsam_rwhec.fitting.observations import Views

BOARD = Checkerboard("board", 10, 7, 0.03)
OPTIONS = rw.CornerOptions(stated="calibration", size_share=1e-3, warp_m=1e-3)
BAR_S, BAR_OUTLIERS_S, BAR_BYTES = 5.0, 10.0, 1e9


def large_cell(views: int) -> simulated_cells.Cell:
    """Four cameras with so many images each."""
    instants = views
    while True:
        given = simulated_cells.cell(
            0,
            cameras=4,
            images=instants,
            board=BOARD,
            stated="calibration",
            carrier=(1e-3, 5e-4),
            shape=(1e-3, 1e-3, 1e-3),
        )
        if min(len(view.A) for view in given.observations.views.values()) >= views:
            break
        instants = round(1.3 * instants)
    cut = {pair: Views(view.A[:views], view.pixels[:views]) for pair, view in given.observations.views.items()}
    return replace(given, observations=replace(given.observations, views=cut))


def with_misread_corners(given: simulated_cells.Cell, share: float) -> simulated_cells.Cell:
    """A share of all corners is off by 20 pixels, more or less."""
    rng = np.random.default_rng(1)
    views = {}
    for pair, view in given.observations.views.items():
        wrong = rng.random(view.pixels.shape[:2]) < share
        views[pair] = Views(view.A, view.pixels + wrong[..., None] * rng.normal(scale=20.0, size=view.pixels.shape))
    return replace(given, observations=replace(given.observations, views=views))


def timed(given: simulated_cells.Cell, options: rw.CornerOptions = OPTIONS) -> tuple[float, float, rw.CornersRefined]:
    """Seconds on the clock and of the processor, and the answer."""
    X, Y = given.near(np.random.default_rng(0))
    begun, own = time.perf_counter(), time.process_time()
    refined = rw.refine_corners(given.observations, X, Y, options)
    return time.perf_counter() - begun, time.process_time() - own, refined


def rows(views: int) -> list[bars.Row]:
    """Times and memory."""
    large = large_cell(views)
    clock, own, refined = timed(large)
    most = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    wrong_clock, wrong_own, wrong = timed(with_misread_corners(large, 0.1))
    moving = simulated_cells.moving(large, 1, dict.fromkeys(large.observations.sensors, 2e-3))
    clocks = replace(OPTIONS, time_offsets=large.observations.sensors)
    late_clock, late_own, late = timed(moving, clocks)
    board_clock, board_own, board = timed(moving, replace(clocks, corners_m=1e-4))
    board_most = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    left_out = sum(int(mask.sum()) for mask in wrong.left_out.values())
    return [
        bars.Row("all variables free", f"{clock:.1f} s ({own:.1f} s)", f"<= {BAR_S:g} s", clock <= BAR_S),
        bars.Row("  steps", f"{refined.iterations}; one more would be {refined.last_step:.0e} deviations"),
        bars.Row("memory of the process", f"{most / 1e9:.2f} GB", "<= 1 GB", most <= BAR_BYTES),
        bars.Row(f"every clock free too, {len(late.joint)} unknowns", f"{late_clock:.1f} s ({late_own:.1f} s)"),
        bars.Row(
            f"and every corner of the board, {len(board.joint)} unknowns",
            f"{board_clock:.1f} s ({board_own:.1f} s), {board_most / 1e9:.2f} GB",
        ),
        bars.Row(
            "every tenth corner misread", f"{wrong_clock:.1f} s ({wrong_own:.1f} s)", f"<= {BAR_OUTLIERS_S:g} s",
            wrong_clock <= BAR_OUTLIERS_S,
        ),
        bars.Row("  left out", f"{left_out} of {sum(view.known.sum() for view in large.observations.views.values())}"),
    ]  # fmt: skip


if __name__ == "__main__":
    bars.run_script("refinement from corners", rows, views=250)
