"""Refinement from corners: is its error as small as it can be, and smaller than that of a refinement from poses?

    python benchmarks/corner_efficiency.py [--runs 2000] [--workers 1] [--only WORDS]

Simulated cells (`tests/fitting/simulated_cells.py`) of several geometries: the board near or far, few or many
images, small or large tilts, A exact or noisy (1 mrad, 0.5 mm), intrinsics exact or drawn from a calibration's or the
nominal prior. Errors e of each unknown are squared with the inverse of its block of the Cramer-Rao bound: e' C^-1 e / d
is 1 in the mean where the estimate is efficient. C^-1 is the information at the truth under the true noise, with the
prior where intrinsics were drawn from it (van Trees's bound), and with the carriers' errors eliminated.

Refinement from poses takes the same images' poses with their covariances, whose scale it estimates where it can. It is
told A's noise, which refinement from corners estimates, and which of a flat board's two poses an image has. Its errors
are squared with the same bound. Ours is not worse where the mean difference of the squares, run by run, is not above
zero outside of its 99 % interval.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import bars
import numpy as np
import simulated_cells
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.errors import NoiseError, RwhecWarning
from gtsam_rwhec.fitting.corner_noise import Noise, Reduced
from gtsam_rwhec.fitting.fit_options import Stated

#: Of the bound.
MOST = 1.05
CORNER_PX = 0.1
NOISY = (1e-3, 5e-4)
#: A letter (x, y, k) and a frame's name.
Slot = tuple[str, str]


@dataclass(frozen=True)
class Kind:
    """How cells are made, and what is told of their intrinsics."""

    told: Stated = "calibration"
    carrier: tuple[float, float] = (0.0, 0.0)
    geometry: dict[str, Any] = field(default_factory=dict)


GEOMETRIES: dict[str, dict[str, Any]] = {
    "30 images at 1.5 m": {"images": 30},
    "near, 1 m": {"images": 30, "distance": 1.0},
    "far, 4 m": {"images": 30, "distance": 4.0},
    "12 images": {"images": 12},
    "100 images": {"images": 100},
    "small tilts": {"images": 30, "tilt": 0.08},
    "large tilts": {"images": 30, "tilt": 0.6},
}
KINDS = {
    f"{name}, A {words}": Kind("calibration", carrier, geometry)
    for name, geometry in GEOMETRIES.items()
    for words, carrier in (("exact", (0.0, 0.0)), ("noisy", NOISY))
} | {
    "intrinsics exact, A exact": Kind("exact", (0.0, 0.0), GEOMETRIES["30 images at 1.5 m"]),
    "intrinsics exact, A noisy": Kind("exact", NOISY, GEOMETRIES["30 images at 1.5 m"]),
    "intrinsics nominal, A exact": Kind("nominal", (0.0, 0.0), GEOMETRIES["30 images at 1.5 m"]),
    "intrinsics nominal, A noisy": Kind("nominal", NOISY, GEOMETRIES["30 images at 1.5 m"]),
}


def off(truth: np.ndarray, T: np.ndarray) -> np.ndarray:
    """The perturbation [omega, v] of an estimated pose about the true one."""
    return se3.logmap((se3.inverse(truth) @ T)[None])[0]


def one(name: str, seed: int) -> dict[str, tuple[float, ...]]:
    """Squared errors over the bound and over their number: of the corners, and of the poses (nan for intrinsics)."""
    kind = KINDS[name]
    stated = None if kind.told == "exact" else kind.told
    given = simulated_cells.cell(seed, stated=stated, carrier=kind.carrier, corner_px=CORNER_PX, **kind.geometry)
    exact = kind.carrier == (0.0, 0.0)
    options = rw.CornerOptions(stated=kind.told, carrier_noise="exact" if exact else "estimate")
    with warnings.catch_warnings(action="ignore", category=RwhecWarning):
        poses = refined_from_poses(given, kind.carrier)
    corners = rw.refine_corners(given.observations, poses.X, poses.Y, options)
    bound = bound_at_the_truth(given, corners, Noise(CORNER_PX, *kind.carrier))
    sensors, slots = corners.graph.model.sensors, corners.slots
    frames = {("x", "board"): given.X["board"]} | {("y", name): given.Y[name] for name in sensors}
    errors = [
        {
            slot: off(truth, (answer.X if slot[0] == "x" else answer.Y)[slot[1]].matrix())
            for slot, truth in frames.items()
        }
        for answer in (corners, poses)
    ]
    intrinsics = {
        ("k", name): corners.intrinsics[name].camera.parameters - given.cameras[name].parameters
        for name in (sensors if kind.told != "exact" else ())
    }
    groups = {"target": [("x", "board")], "sensors": [("y", name) for name in sensors], "all frames": list(frames)}
    found = {}
    for what, names in groups.items():
        found[what] = tuple(squared(each, names, bound, slots) for each in errors)
    if intrinsics:
        found["intrinsics"] = squared(intrinsics, list(intrinsics), bound, slots), np.nan
        every = errors[0] | intrinsics
        found["everything"] = squared(every, list(every), bound, slots), np.nan
    return found


def refined_from_poses(given: simulated_cells.Cell, carrier: tuple[float, float]) -> rw.Refined:
    """From the images' poses, with A's noise as it is; of a flat target's two poses the one near the truth."""
    near = {
        (target, sensor): se3.inverse(given.Y[sensor]) @ view.A @ given.X[target]
        for (target, sensor), view in given.observations.views.items()
    }
    problem = given.observations.poses(near)
    start = rw.solve(problem)
    noise = rw.CarrierNoise(*carrier) if any(carrier) else None
    try:
        return rw.refine(problem, start, rw.RefineOptions(noise="estimate", carrier_noise=noise))
    except NoiseError:  # what is told of A explains all residuals
        return rw.refine(problem, start, rw.RefineOptions(noise="given", carrier_noise=noise))


def bound_at_the_truth(given: simulated_cells.Cell, corners: rw.CornersRefined, noise: Noise) -> np.ndarray:
    """The inverse of the information (d, d) at the truth, of all that was estimated, under a noise."""
    model = corners.graph.model
    every = tuple(stack.known.astype(float) for stack in model.stacks)
    truth = replace(
        corners.point,
        X=given.X,
        Y={name: given.Y[name] for name in model.sensors},
        A=model.A,
        cameras={name: given.cameras[name].parameters for name in model.camera_priors},
        shapes={name: np.zeros(3) for name in model.targets},
    )
    information = Reduced.of(replace(model, weights=every), truth).information(noise)
    return np.linalg.inv(information)


def squared(
    errors: Mapping[Slot, np.ndarray], names: list[Slot], bound: np.ndarray, slots: Mapping[Slot, slice]
) -> float:
    """e' C^-1 e / d of the errors of some unknowns together."""
    error = np.concatenate([errors[name] for name in names])
    rows = np.concatenate([np.arange(slots[name].start, slots[name].stop) for name in names])
    return float(error @ np.linalg.solve(bound[np.ix_(rows, rows)], error)) / len(error)


def rows_of(what: str, squares: np.ndarray) -> list[bars.Row]:
    """Whether 5 % over the bound is outside of the mean's 99 % interval; and the gain over the poses."""
    corners, poses = squares.T
    mean, half = corners.mean(), interval(corners)
    rows = [bars.Row(what, f"{mean:.3f} +- {half:.3f}", f"<= {MOST:g}", bool(mean - half <= MOST))]
    if np.isfinite(poses).all():
        figure = f"{poses.mean():.3g} ({poses.mean() / mean:.3g} times ours)"
        worse = corners - poses
        rows.append(bars.Row("  of a refinement from poses", figure, ">= 1", bool(worse.mean() <= interval(worse))))
    return rows


def interval(values: np.ndarray) -> float:
    """Half of the mean's 99 % interval."""
    return float(2.58 * values.std() / np.sqrt(len(values)))


def rows(runs: int, workers: int, seed: int, only: str) -> list[bars.Row]:
    """The errors of all kinds."""
    return [
        row
        for name, found in bars.runs_of_kinds(one, KINDS, runs, workers, seed, only)
        for what in found[0]
        for row in rows_of(f"{name}: {what}", np.array([each[what] for each in found]))
    ]


if __name__ == "__main__":
    bars.run_script("mean squared errors over the Cramer-Rao bound", rows, runs=2000, workers=1, seed=0, only="")
