"""Refinement from corners: do 95 % ellipsoids hold the truth, and how efficient is it?

    python benchmarks/corner_coverage.py [--runs 2000] [--workers 2] [--only WORDS] [--seed 0]

Simulated cells (`tests/fitting/simulated_cells.py`): two fixed cameras, a board of 7 x 5 corners on the hand, 30
instants, corners with 0.1 pixels of noise. Intrinsics are known; or drawn from the prior of a calibration, or of
nominal intrinsics; or unknown, and started by homographies. A is exact, or noisy by 1 mrad and 0.5 mm, which is
estimated; or the board is warped too. Each run has its own cell. Shares have their 99 % intervals. The ratio is the
mean of the squared deviations over their number: 1 where covariances are right.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import bars
import numpy as np
import simulated_cells

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.fit_options import Stated
from gtsam_rwhec.fitting.observations import first_intrinsics

LEVEL, LEAST, MOST = 0.95, 0.935, 0.965


@dataclass(frozen=True)
class Kind:
    """How cells are made, and what is told of them."""

    drawn: Stated | None
    told: Stated
    carrier: tuple[float, float] = (0.0, 0.0)
    warp_m: float = 0.0


KINDS = {
    "known intrinsics, A exact": Kind(None, "exact"),
    "known intrinsics, A noisy": Kind(None, "exact", (1e-3, 5e-4)),
    "drawn from a calibration's prior, A exact": Kind("calibration", "calibration"),
    "drawn from the nominal prior, A exact": Kind("nominal", "nominal"),
    "drawn from a calibration's prior, A noisy": Kind("calibration", "calibration", (1e-3, 5e-4)),
    "drawn from the nominal prior, A noisy": Kind("nominal", "nominal", (1e-3, 5e-4)),
    "unknown intrinsics, A exact": Kind(None, "unknown"),
    "unknown intrinsics, A noisy": Kind(None, "unknown", (1e-3, 5e-4)),
    "drawn from the nominal prior, A noisy, a warped board": Kind("nominal", "nominal", (1e-3, 5e-4), 1e-3),
}


def one(name: str, seed: int) -> dict[str, tuple[float, float]]:
    """Squared deviations of the errors, over the ellipsoid's and over their number, by what is estimated."""
    kind = KINDS[name]
    seed += 100_000 * list(KINDS).index(name)
    given = simulated_cells.cell(seed, stated=kind.drawn, carrier=kind.carrier, shape=(0.0, kind.warp_m, kind.warp_m))
    exact = kind.carrier == (0.0, 0.0)
    options = rw.CornerOptions(stated=kind.told, carrier_noise="exact" if exact else "estimate", warp_m=kind.warp_m)
    X, Y = given.near(np.random.default_rng(seed))
    observations = given.observations
    if kind.told == "unknown":
        cameras = {sensor: first_intrinsics(observations, sensor) for sensor in observations.sensors}
        observations = replace(observations, cameras=cameras)
    result = rw.refine_corners(observations, X, Y, options)
    errors = {"target": ("board", given.error(result, "board")), "sensor": ("cam_0", given.error(result, "cam_0"))}
    if kind.told != "exact":
        found = result.intrinsics["cam_0"].camera.parameters
        truth = given.cameras["cam_0"].parameters
        errors["intrinsics"] = ("intrinsics:cam_0", np.pad(truth, (0, len(found) - len(truth))) - found)
    if kind.warp_m:
        errors["board's warp"] = ("shape:board", (given.shape - result.shapes["board"])[1:])
    squares = {}
    for what, (unknown, error) in errors.items():
        covariance = result.covariance(unknown)
        squared = float(error @ np.linalg.solve(covariance, error))
        squares[what] = (squared / result.squared_radius(unknown, LEVEL), squared / len(error))
    return squares


def rows(runs: int, workers: int, seed: int, only: str) -> list[bars.Row]:
    """The shares of all kinds."""
    table = []
    for name, found in bars.runs_of_kinds(one, KINDS, runs, workers, seed, only):
        for what in found[0]:
            radii, ratios = np.array([each[what] for each in found]).T
            share = bars.Share.of((radii < 1.0).tolist())
            figure = f"{share}, ratio {ratios.mean():.2f}"
            table.append(bars.Row(f"{name}: {what}", figure, "95 +- 1.5 %", share.meets(LEAST, MOST)))
    return table


if __name__ == "__main__":
    bars.run_script("95 % ellipsoids of a refinement from corners", rows, runs=2000, workers=2, seed=0, only="")
