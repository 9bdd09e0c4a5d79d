"""Residuals and lengths that no sensor and no rig have are found, and measurements that look wrong; noise is none."""

from __future__ import annotations

import numpy as np
import pytest
from misread_problems import KINDS_OF_GRAPHS, Kind, in_millimetres, misread
from refinement_problems import copied, rig
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.misreadings import misreadings
from gtsam_rwhec.calibration.other_readings import Mistake
from gtsam_rwhec.calibration.outliers import gross_errors
from gtsam_rwhec.calibration.sizes import doubted_lengths, undetectable
from gtsam_rwhec.calibration.trial_fits import Unlikely, implausible
from gtsam_rwhec.problem.measurements import Measurements, Pair
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


BOTH = Kind("both in millimetres", Mistake.UNIT, "", in_millimetres, in_millimetres)


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.UnitsWarning", "ignore::gtsam_rwhec.errors.WeightsWarning")
def test_millimetres_in_both_are_seen_in_the_lengths_alone() -> None:
    good = general(2, 1, seed=0, noise=NOISE).problem
    assert not doubted_lengths(good, rw.solve(good))
    wrong = misread(good, BOTH)
    solution = rw.solve(wrong)
    assert misreadings(wrong, solution) == ()
    found = doubted_lengths(wrong, solution)
    assert found.startswith("targets are seen from ")
    assert " m and targets and sensors are " in found
    assert "divide both by 1000" in found


def test_a_distant_origin_is_no_doubt() -> None:
    good = general(2, 1, seed=0, noise=NOISE).problem
    far = rw.Problem()
    T = se3.pose(np.eye(3), [2e5, -1e6, 3e5])
    for pair in good.pairs:
        raw = good.measurements(*pair)
        far.add(*pair, raw.A @ T, raw.B, raw.sigma, raw.kappa)
    assert not doubted_lengths(far, rw.solve(far))


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.WeightsWarning")
def test_one_pair_cannot_tell_whether_both_are_inverted_and_two_can() -> None:
    one = general(1, 1, seed=0, noise=NOISE).problem
    assert any("both inverted" in each for each in undetectable(one))
    inverted = misread(one, KINDS_OF_GRAPHS[0])
    assert misreadings(inverted, rw.solve(inverted)) == ()
    two = general(1, 2, seed=0, noise=NOISE).problem
    assert not any("both inverted" in each for each in undetectable(two))
    assert all("data cannot tell" in each for each in undetectable(two))


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
