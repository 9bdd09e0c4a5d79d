"""Problems that the tests of several methods share."""

from __future__ import annotations

import dataclasses

import numpy as np

import gtsam_rwhec as rw
from gtsam_rwhec.methods import Estimate
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.simulate import Noise, Simulation, cameras, general, sphere

NOISE = Noise(sigma_m=0.01, kappa=125.0, model="released")
STATED_NOISE = Noise(sigma_m=0.01, kappa=1250.0)


def one_pair(noise: Noise | None = NOISE, seed: int = 0, *, monocular: bool = False) -> Simulation:
    """Section 8.1 of the RWHEC paper: the camera's distance to the target is constant, and Y a half turn."""
    return sphere(noise, seed, monocular=monocular)


def general_pair(noise: Noise | None = STATED_NOISE, seed: int = 0, *, scale: ScaleMode = "known") -> Simulation:
    """One X and one Y, neither a half turn, and motions about and along all axes."""
    return general(
        1,
        1,
        seed=seed,
        number_of_measurements=60,
        noise=noise,
        scale=scale,
        true_scale=0.5 if scale == "shared" else None,
    )


def four_targets(noise: Noise | None = NOISE, seed: int = 0, *, monocular: bool = False) -> Simulation:
    """Section 8.2: four Xs, one Y."""
    return cameras(noise, seed, monocular=monocular)


def exchanged(simulation: Simulation) -> Simulation:
    """The same with targets as sensors and sensors as targets: A^-1 Y = X B^-1. Of known scale."""
    problem = rw.Problem()
    for target, sensor in simulation.problem.pairs:
        raw = simulation.problem.measurements(target, sensor)
        problem.add(sensor, target, np.linalg.inv(raw.A), np.linalg.inv(raw.B), raw.sigma, raw.kappa)
    return dataclasses.replace(simulation, problem=problem, X=dict(simulation.Y), Y=dict(simulation.X))


def moved_translations(problem: rw.Problem, generator: np.random.Generator, size_m: float = 0.05) -> rw.Problem:
    """The same rotations measured, other translations."""
    moved = rw.Problem(problem.scale)
    for pair in problem.pairs:
        raw = problem.measurements(*pair)
        B = raw.B.copy()
        B[:, :3, 3] += generator.normal(0.0, size_m, (len(B), 3))
        moved.add(*pair, raw.A, B, raw.sigma, raw.kappa)
    return moved


def largest_errors(simulation: Simulation, estimate: Estimate) -> tuple[float, float]:
    """Over all frames, in metres and rad."""
    errors = simulation.errors(estimate)
    distances = [*errors.X.values(), *errors.Y.values()]
    return max(d.translation_m for d in distances), max(d.rotation_rad for d in distances)


def rotations(estimate: Estimate) -> np.ndarray:
    """All of them, (n, 3, 3)."""
    return np.array([pose.rotation().matrix() for pose in [*estimate.X.values(), *estimate.Y.values()]])
