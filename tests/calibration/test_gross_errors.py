"""Measurements that look wrong where every measurement counts."""

from __future__ import annotations

import numpy as np
import pytest
from refinement_problems import copied, rig
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.outliers import gross_errors
from gtsam_rwhec.problem.measurements import Measurements, Pair


@pytest.mark.parametrize("share", [0.05, 0.3])
def test_they_are_counted(share: float) -> None:
    """Least squares hides a third of outliers: all of its residuals are large then."""
    chance = np.random.default_rng(0)

    def spoilt(pair: Pair, raw: Measurements) -> np.ndarray:
        bad = chance.permutation(len(raw.B))[: round(share * len(raw.B))]
        B = raw.B.copy()
        B[bad] = B[bad] @ se3.expmap(np.hstack([np.zeros((len(bad), 3)), chance.uniform(0.5, 2.0, (len(bad), 3))]))
        return B

    problem = copied(rig(number_of_measurements=40).problem, B=spoilt)
    assert gross_errors(problem).startswith(f"{round(share * 160)} of 160 measurements look wrong (")
    assert "not looked at" not in gross_errors(problem)


def test_the_measurements_that_were_not_looked_at_are_said() -> None:
    problem = rig(number_of_measurements=40).problem
    raw = problem.measurements("target0", "sensor0")
    B = raw.B[:3].copy()
    B[:, :3, 3] += 2.0
    problem.add("target0", "sensor0", raw.A[:3], B, raw.sigma[:3], raw.kappa[:3])
    problem.add("lonely", "sensor0", raw.A[:3], raw.B[:3], raw.sigma[:3], raw.kappa[:3])  # a pair with few measurements
    assert gross_errors(problem).startswith("3 of 163 measurements look wrong (")
    assert "; 3 more were not looked at)" in gross_errors(problem)


@pytest.mark.parametrize("seed", range(5))
def test_there_are_none_among_good_ones(seed: int) -> None:
    assert not gross_errors(rig(seed=seed).problem)


def test_a_pair_with_more_noise_than_others_is_not_wrong() -> None:
    noisy = Pair("target0", "sensor0")

    def spoilt(pair: Pair, raw: Measurements) -> np.ndarray:
        extra = 0.05 * np.random.default_rng(1).normal(size=(len(raw.B), 6))
        return np.asarray(raw.B @ se3.expmap(extra)) if pair == noisy else raw.B

    assert not gross_errors(copied(rig().problem, B=spoilt))


def test_measurements_that_were_said_to_be_noisy_are_not_wrong() -> None:
    """Of a tag that is seen from far away, say."""
    chance = np.random.default_rng(2)

    def often(pair: Pair, raw: Measurements) -> np.ndarray:
        return np.where(np.arange(len(raw.B)) % 5 == 0, 20.0, 1.0)

    def spoilt(pair: Pair, raw: Measurements) -> np.ndarray:
        return np.asarray(raw.B @ se3.expmap(often(pair, raw)[:, None] * 0.005 * chance.normal(size=(len(raw.B), 6))))

    noisy = copied(rig().problem, B=spoilt)
    assert gross_errors(noisy)
    chance = np.random.default_rng(2)
    said = copied(
        rig().problem,
        B=spoilt,
        sigma=lambda pair, raw: 0.005 * often(pair, raw),
        kappa=lambda pair, raw: 2e4 / often(pair, raw) ** 2,
    )
    assert not gross_errors(said)


def test_without_measurements_none_can_be_told() -> None:
    raw = rig(1, 1).problem.measurements("target0", "sensor0")
    kept = rw.Problem(keep_measurements=False)
    kept.add("target0", "sensor0", raw.A, raw.B)
    assert not gross_errors(kept)
    few = rw.Problem()
    few.add("target0", "sensor0", raw.A[:5], raw.B[:5])
    assert not gross_errors(few)
