"""Tabb's rp1 and Evangelista's graph against ours on the same corners: where they end, from which starts, in what time.

    python benchmarks/corner_methods.py [--cells 20] [--large]

Cells of two fixed cameras with a board of 7 x 5 corners on the hand and about 30 images; with ``--large`` four cameras
with about 100 images each of 70 corners. Intrinsics are exact. For rp1 A is exact too; for the graph A is noisy by 1
mrad and 0.5 mm, which both are told, in units of the corners' noise that ours estimates. Each camera has as many
images, and each image its own A: so rp1's weights are 1, and the graph, with a pose of its own for each image, has our
cost. Starts are the truth turned by up to 30 degrees and moved by up to 0.5 m, and the answers of closed forms
for the images' poses. `corner_peers.py` has their solvers, with derivatives by differences and exact ones.

Ours needs no start: the images' poses, their certified solution, then `rw.refine_corners` with its covariance are timed
together. A start converges if it ends within a millionth of the least cost that anybody finds in that cell. Times are
the processor's.
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import simulated_cells
from bars import Row, benchmark_parser, print_rows
from corner_peers import Found, evangelista, rp1
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.cameras.targets import Checkerboard
from gtsam_rwhec.methods import corner_methods
from gtsam_rwhec.methods.corner_methods import Corners
from gtsam_rwhec.methods.reprojection import certified_start

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "reprojection"))


NOISY = (1e-3, 5e-4)
#: How far the starts are off, degrees and metres.
OFF = ((5.0, 0.05), (15.0, 0.2), (30.0, 0.5), (30.0, 0.5))
CLOSED_FORMS = ("wang2022", "tabb2017_c1", "horn2023")
#: Within this share of the least cost a descent has converged.
SAME = 1e-6
FASTER = 10.0


def cell(seed: int, carrier: tuple[float, float], *, large: bool) -> simulated_cells.Cell:
    """A cell with as many images of each camera, and an A of its own for each image."""
    size = {"cameras": 4, "images": 400, "board": Checkerboard("board", 10, 7, 0.03)} if large else {}
    given = simulated_cells.cell(seed, carrier=carrier, **size)
    views, taken = {}, set[bytes]()
    for pair, view in given.observations.views.items():
        own = np.array([T.tobytes() not in taken for T in view.A])
        views[pair] = view.selected(own)
        taken |= {T.tobytes() for T in view.A}
    fewest = min(len(view.A) for view in views.values())
    views = {pair: view.selected(np.arange(fewest)) for pair, view in views.items()}
    return replace(given, observations=replace(given.observations, views=views))


def starts(given: simulated_cells.Cell, seed: int) -> list[np.ndarray]:
    """X and Y (n, 4, 4) of each start."""
    rng = np.random.default_rng(1000 + seed)
    truth = np.array([*given.X.values(), *(given.Y[name] for name in given.observations.sensors)])
    found = []
    for degrees, metres in OFF:
        axes = rng.normal(size=(len(truth), 2, 3))
        axes /= np.linalg.norm(axes, axis=2, keepdims=True)
        sizes = rng.uniform(size=(len(truth), 2)) * [np.radians(degrees), metres]
        turned = truth @ se3.expmap(np.concatenate([axes[:, 0] * sizes[:, :1], np.zeros((len(truth), 3))], axis=1))
        turned[:, :3, 3] += axes[:, 1] * sizes[:, 1:]
        found.append(turned)
    for name in CLOSED_FORMS:
        answer = rw.methods.run(name, given.observations.poses())
        poses = [answer.X["board"], *(answer.Y[name] for name in given.observations.sensors)]
        found.append(np.array([pose.matrix() for pose in poses]))
    return found


def ours(observations: rw.Observations, carrier: tuple[float, float]) -> tuple[Found, tuple[float, float]]:
    """All of ours, from corners that no pose was estimated of before; and A's noise for the stated noise of corners."""
    fresh = replace(observations)
    noise = rw.CarrierNoise(*carrier) if any(carrier) else "exact"
    begun = time.process_time()
    X, Y = certified_start(fresh)
    refined = rw.refine_corners(fresh, X, Y, rw.CornerOptions(stated="exact", carrier_noise=noise, outliers=False))
    seconds = time.process_time() - begun
    frames = np.array([pose.matrix() for pose in (*refined.X.values(), *refined.Y.values())])
    corners = Corners.of(observations)
    if not any(carrier):
        return Found(corners.cost(frames), seconds), carrier
    scale = observations.corner_px / refined.graph.model.corner_px
    told = (scale * carrier[0], scale * carrier[1])
    return Found(corner_methods.cost_at(corners, frames, refined.point.A, told), seconds), told


def compared(words: str, carrier: tuple[float, float], cells: int, *, large: bool) -> list[Row]:
    """Rows of one cost, for derivatives by differences and exact ones."""
    results: dict[bool, list[tuple[Found, float, Found]]] = defaultdict(list)
    for seed in range(cells):
        given = cell(seed, carrier, large=large)
        corners = Corners.of(given.observations)
        mine, told = ours(given.observations, carrier)
        solve = partial(evangelista, deviations=told) if any(carrier) else rp1
        theirs = [
            (analytic, solve(corners, start, analytic=analytic))
            for start in starts(given, seed)
            for analytic in (False, True)
        ]
        least = min([mine.cost, *(found.cost for _, found in theirs)])
        for analytic, found in theirs:
            results[analytic].append((found, least, mine))
    rows = []
    for analytic, each in results.items():
        there = [(found, least, mine) for found, least, mine in each if found.cost <= least * (1.0 + SAME)]
        reached = sum(mine.cost <= found.cost * (1.0 + SAME) for found, _, mine in there)
        ratios = np.array([found.seconds / mine.seconds for found, _, mine in there])
        name = f"{words}, derivatives {'exact' if analytic else 'by differences'}"
        rows += [
            Row(f"{name}: starts that converge", f"{len(there)} of {len(each)}"),
            Row("  ours reaches their optimum or better", f"{reached} of {len(there)}", "all", reached == len(there)),
            Row(
                "  their time over ours, median (least)", f"{np.median(ratios):.2g} ({ratios.min():.2g})",
                f">= {FASTER:g}", bool(np.median(ratios) >= FASTER),
            ),
        ]  # fmt: skip
    seconds = [mine.seconds for _, _, mine in results[True]]
    rows.append(Row(f"{words}: ours, s of the processor", f"{np.median(seconds):.3f}"))
    return rows


def main() -> int:
    """Run, and print a table."""
    parser = benchmark_parser(__doc__)
    parser.add_argument("--cells", type=int, default=20)
    parser.add_argument("--large", action="store_true")
    given = parser.parse_args()
    cell(0, NOISY, large=False)
    ours(cell(0, (0.0, 0.0), large=False).observations, (0.0, 0.0))  # imports are not timed
    size = "four cameras, 70 corners" if given.large else "two cameras, 35 corners"
    rows = compared(f"rp1, {size}", (0.0, 0.0), given.cells, large=given.large)
    rows += compared(f"Evangelista's graph, {size}", NOISY, given.cells, large=given.large)
    return print_rows("methods on corners", rows, store=given.store)


if __name__ == "__main__":
    sys.exit(main())
