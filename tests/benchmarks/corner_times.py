"""Refinement from corners: time and memory of a large cell, and the answer against other ways to it.

    python tests/benchmarks/corner_times.py [--views 250] [--simulations 200] [--store]

Four cameras with 250 images each of a board of 70 corners; intrinsics, the board's size and warp, and the carriers'
poses are all free, the noise is estimated; the joint covariance is part of it. Then the same with every tenth corner
misread. Times are on the clock; the processor's own are in brackets.
Beside it ``cv2.calibrateCamera`` alone on the corners of one camera, in simulations whose nominal intrinsics are off:
the mean squared error of f and c.
"""

from __future__ import annotations

import resource
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from bars import Row, benchmark_parser, print_rows

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "reprojection"))
import simulated_cells

import gtsam_rwhec as rw
from gtsam_rwhec.reprojection.lens import parameters_of
from gtsam_rwhec.reprojection.observations import Views
from gtsam_rwhec.vision.targets import Checkerboard

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


def timed(given: simulated_cells.Cell) -> tuple[float, float, rw.CornersRefined]:
    """Seconds on the clock and of the processor, and the answer."""
    X, Y = given.near(np.random.default_rng(0))
    begun, own = time.perf_counter(), time.process_time()
    refined = rw.refine_corners(given.observations, X, Y, OPTIONS)
    return time.perf_counter() - begun, time.process_time() - own, refined


def intrinsics_errors(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors of fx, fy, cx, cy: ours with A known, ours with the noise of A estimated, OpenCV's."""
    errors = []
    truth = parameters_of(simulated_cells.CAMERA)[:4]
    given = simulated_cells.cell(seed, cameras=1, images=20, stated="nominal")
    for carrier in ("exact", "estimate"):
        X, Y = given.near(np.random.default_rng(seed))
        refined = rw.refine_corners(given.observations, X, Y, rw.CornerOptions(carrier_noise=carrier))
        errors.append(parameters_of(refined.intrinsics["cam_0"].camera)[:4] - truth)
    view = given.observations.views["board", "cam_0"]
    points = [given.observations.corners["board"].astype(np.float32)] * len(view.A)
    stated = given.observations.cameras["cam_0"]
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    _, K, _, _, _ = cv2.calibrateCamera(
        points, list(view.pixels.astype(np.float32)), (stated.width, stated.height), stated.K.copy(),
        np.pad(stated.D, (0, 1)), flags=flags,
    )  # fmt: skip
    errors.append(np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]) - truth)
    return errors[0], errors[1], errors[2]


def main() -> int:
    """Run, and print a table."""
    parser = benchmark_parser(__doc__)
    parser.add_argument("--views", type=int, default=250)
    parser.add_argument("--simulations", type=int, default=200)
    given = parser.parse_args()
    large = large_cell(given.views)
    clock, own, refined = timed(large)
    most = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    wrong_clock, wrong_own, wrong = timed(with_misread_corners(large, 0.1))
    left_out = sum(int(mask.sum()) for mask in wrong.left_out.values())
    rows = [
        Row("all variables free", f"{clock:.1f} s ({own:.1f} s)", f"<= {BAR_S:g} s", clock <= BAR_S),
        Row("  steps", f"{refined.iterations}; one more would be {refined.last_step:.0e} deviations"),
        Row("memory of the process", f"{most / 1e9:.2f} GB", "<= 1 GB", most <= BAR_BYTES),
        Row(
            "every tenth corner misread", f"{wrong_clock:.1f} s ({wrong_own:.1f} s)", f"<= {BAR_OUTLIERS_S:g} s",
            wrong_clock <= BAR_OUTLIERS_S,
        ),
        Row("  left out", f"{left_out} of {sum(view.known.sum() for view in large.observations.views.values())}"),
    ]  # fmt: skip
    exact, noisy, theirs = (np.array(e) for e in zip(*map(intrinsics_errors, range(given.simulations)), strict=True))
    for name, ours in (("A known", exact), ("the noise of A estimated", noisy)):
        ratio = np.sqrt((ours**2).sum() / (theirs**2).sum())
        rows.append(Row(f"error of f and c over OpenCV's, {name}", f"{ratio:.2f}", "<= 1", bool(ratio <= 1.0)))
    return print_rows("refinement from corners", rows, store=given.store)


if __name__ == "__main__":
    sys.exit(main())
