"""Covariances against the truth in a few runs; the benchmark benchmarks/coverage.py makes thousands."""

from __future__ import annotations

import numpy as np
import pytest
from refinement_problems import KAPPA, SIGMA_M, refined

import gtsam_rwhec as rw
from gtsam_rwhec.geometry.pose_covariances import error_of
from gtsam_rwhec.simulate import Noise, Simulation, general, perturb

RUNS = 60
CARRIER = rw.CarrierNoise(rotation_rad=np.radians(0.3), translation_m=0.002)


def simulated(seed: int, scale: str, noisy_A: bool) -> tuple[Simulation, rw.Problem]:
    """A rig of its own for each seed, with noise on B, and on A the same for both sensors."""
    simulation = general(1, 2, seed=seed, number_of_measurements=15, scale=scale)
    generator = np.random.default_rng(seed)
    noise_of_A = Noise(CARRIER.translation_m, 0.5 / CARRIER.rotation_rad**2)
    carriers: dict[int, np.ndarray] = {}
    problem = rw.Problem(scale=scale)
    for pair in simulation.problem.pairs:
        raw = simulation.problem.measurements(*pair)
        for stamp, pose in zip(raw.stamps_ns, raw.A, strict=True):
            if int(stamp) not in carriers:
                carriers[int(stamp)] = perturb(pose[None], noise_of_A if noisy_A else None, generator)[0]
        A = np.array([carriers[int(stamp)] for stamp in raw.stamps_ns])
        B = perturb(raw.B, Noise(SIGMA_M, KAPPA), generator)
        problem.add(*pair, A, B, SIGMA_M, KAPPA, stamps_ns=raw.stamps_ns)
    return simulation, problem


def squares(noise: str, scale: str, noisy_A: bool) -> dict[str, list[float]]:
    """xi' covariance^-1 xi over its dimension: of the truth, frame by frame; 1 in the mean."""
    result: dict[str, list[float]] = {}
    for seed in range(RUNS):
        simulation, problem = simulated(seed, scale, noisy_A)
        r = refined(problem, noise=noise, carrier_noise=CARRIER if noisy_A else None)
        for name, T in (simulation.X | simulation.Y).items():
            xi = error_of((r.X | r.Y)[name], T)
            result.setdefault(name, []).append(float(xi @ np.linalg.solve(r.covariance(name), xi)) / 6.0)
        pose, covariance = r.relative("sensor0", "sensor1")
        xi = error_of(pose, np.linalg.inv(simulation.Y["sensor0"]) @ simulation.Y["sensor1"])
        result.setdefault("relative", []).append(float(xi @ np.linalg.solve(covariance, xi)) / 6.0)
        if scale == "shared":
            error = float(r.scale) - float(simulation.scale)
            result.setdefault("scale", []).append(error**2 / r.covariance("scale")[0, 0])
    return result


@pytest.mark.parametrize(
    ("noise", "scale", "noisy_A"), [("given", "shared", False), ("estimate", "known", False), ("given", "known", True)]
)
def test_mean_squared_errors_agree_with_the_covariances(noise: str, scale: str, noisy_A: bool) -> None:
    for name, values in squares(noise, scale, noisy_A).items():
        dimension = 1 if name == "scale" else 6
        spread = np.sqrt(2.0 / dimension / RUNS)  # of the mean of a chi-square over its dimension
        assert np.mean(values) == pytest.approx(1.0, abs=3.5 * spread + 0.05), name
