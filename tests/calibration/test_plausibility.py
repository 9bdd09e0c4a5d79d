"""Residuals that no sensor has are found, with weights or without; noise and outliers are none."""

from __future__ import annotations

import numpy as np
import pytest

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.trial_fits import Unlikely, implausible
from gtsam_rwhec.simulate import Noise, general

NOISE = Noise(0.003, 0.5 / np.radians(0.3) ** 2)


def shuffled(problem: rw.Problem, *, weights: bool) -> rw.Problem:
    """The problem with the rows of B in another order."""
    result = rw.Problem()
    for pair in problem.pairs:
        raw = problem.measurements(*pair)
        B = raw.B[np.random.default_rng(0).permutation(len(raw.B))]
        result.add(*pair, raw.A, B, *((raw.sigma, raw.kappa) if weights else ()))
    return result


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
@pytest.mark.parametrize("weights", [True, False])
def test_rows_that_do_not_belong_together_are_no_noise(weights: bool) -> None:
    problem = shuffled(general(2, 1, seed=0, noise=NOISE, number_of_measurements=20).problem, weights=weights)
    found = implausible(problem, rw.solve(problem))
    assert found is not None
    assert found.why is Unlikely.ROTATION
    assert found.rotation_deg > 25.0
    assert f"{found.rotation_deg:.3g} deg" in str(found)


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
def test_without_measurements_the_solution_tells_it() -> None:
    kept = shuffled(general(1, 1, seed=0, noise=NOISE).problem, weights=True)
    problem = rw.Problem(keep_measurements=False)
    raw = kept.measurements("target0", "sensor0")
    problem.add("target0", "sensor0", raw.A, raw.B, raw.sigma, raw.kappa)
    found = implausible(problem, rw.solve(problem))
    assert found is not None
    assert found.why is Unlikely.ROTATION


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")
def test_noise_of_ten_degrees_and_forty_percent_outliers_are_plausible() -> None:
    generator = np.random.default_rng(3)
    noisy = general(1, 2, seed=3, noise=Noise(0.05, 0.5 / np.radians(6.0) ** 2), number_of_measurements=40).problem
    problem = rw.Problem()
    for pair in noisy.pairs:
        raw = noisy.measurements(*pair)
        B = raw.B.copy()
        B[:16] = B[generator.permutation(16)] @ raw.A[:16]
        problem.add(*pair, raw.A, B, raw.sigma, raw.kappa)
    assert implausible(problem, rw.solve(problem)) is None
