"""Noise in A: propagated, or with each A a variable that the measurements of one stamp share."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from refinement_problems import KAPPA, SIGMA_M, copied, distance, refined, rig
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.pair_data import PairData, carrier_covariances
from gtsam_rwhec.fitting.pose_graph import CarrierVariables
from gtsam_rwhec.simulate import Noise, general

CARRIER = rw.CarrierNoise(rotation_rad=np.radians(0.5), translation_m=0.003)


def test_alone_at_each_stamp_both_models_agree() -> None:
    problem = rig(1, 1, seed=3, number_of_measurements=30).problem
    results = {m: refined(problem, carrier_noise=CARRIER, carrier_model=m) for m in ("propagated", "variables", "auto")}
    assert distance(results["propagated"], results["variables"]) < 2e-4  # first order against exact
    np.testing.assert_allclose(
        results["propagated"].covariance("sensor0"), results["variables"].covariance("sensor0"), rtol=0.05, atol=1e-9
    )
    assert distance(results["auto"], results["propagated"]) == 0.0
    assert results["variables"].graph.size() == 60
    assert results["auto"].graph.size() == 1


def test_shared_carriers_become_variables_and_widen_the_covariance() -> None:
    """Three sensors that see a target at the same instants share A's error: it does not average out."""
    problem = rig(1, 3, seed=4, number_of_measurements=15).problem
    shared = refined(problem, carrier_noise=CARRIER)
    apart = refined(problem, carrier_noise=CARRIER, carrier_model="propagated")
    exact = refined(problem)
    assert shared.graph.size() == 15 + 45
    for name in ("target0",):
        deviations = [np.sqrt(np.trace(r.covariance(name)[3:, 3:])) for r in (exact, apart, shared)]
        assert deviations[0] < deviations[1] < deviations[2]
    # Sensor to sensor the shared error cancels.
    relative = [np.sqrt(np.trace(r.relative("sensor0", "sensor1")[1])) for r in (apart, shared)]
    assert relative[1] < relative[0]


def test_propagated_noise_of_shared_carriers_is_warned_of() -> None:
    problem = rig(1, 2, seed=4).problem
    solution = rw.solve(problem)
    options = rw.RefineOptions(carrier_noise=CARRIER, carrier_model="propagated")
    with pytest.warns(rw.errors.WeightsWarning, match="share a carrier pose.*carrier_model='variables'"):
        rw.refine(problem, solution, options)


def test_measurements_of_one_stamp_share_a_pose() -> None:
    simulation = rig(1, 2, seed=5, number_of_measurements=8, noise=None)
    options = rw.RefineOptions(carrier_noise=CARRIER)

    def variables(problem: rw.Problem) -> CarrierVariables:
        return CarrierVariables.of([PairData.of(problem, pair, options, None) for pair in problem.pairs])

    assert len(variables(simulation.problem).A) == 8
    apart = copied(simulation.problem, stamps_ns=lambda pair, raw: raw.stamps_ns + (7 if pair[1] == "sensor1" else 0))
    assert len(variables(apart).A) == 16
    assert not variables(apart).is_shared
    unstamped = rw.Problem()
    for pair in simulation.problem.pairs:
        raw = simulation.problem.measurements(*pair)
        unstamped.add(*pair, raw.A, raw.B)
    assert len(variables(unstamped).A) == 8  # the same pose is one pose


def test_noise_about_the_sensor_carrier_is_turned_into_the_targets() -> None:
    """Samples of Expmap(xi) A against the propagated covariance of A's right perturbation."""
    A = gtsam.Pose3.Expmap(np.array([0.3, -0.7, 0.5, 1.0, 2.0, -1.5]))
    sigma = np.r_[np.full(3, 2e-4), np.full(3, 3e-4)]
    noise = rw.CarrierNoise(rotation_rad=2e-4, translation_m=3e-4, about="sensorcarrier")
    xi = np.random.default_rng(0).normal(size=(20_000, 6)) * sigma
    samples = np.array([gtsam.Pose3.Logmap(A.inverse().compose(gtsam.Pose3.Expmap(x).compose(A))) for x in xi])
    expected = carrier_covariances(noise, ("t", "s"), A.matrix()[None])[0]
    unit = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(np.cov(samples.T) / unit, expected / unit, atol=0.04)


def test_covariances_of_each_measurement_are_the_same_as_one_for_all() -> None:
    problem = rig(2, 1, seed=3).problem
    one = np.diag(np.r_[np.full(3, CARRIER.rotation_rad**2), np.full(3, CARRIER.translation_m**2)])
    each = rw.CarrierNoise(covariances={pair: np.tile(one, (20, 1, 1)) for pair in problem.pairs})
    first, second = refined(problem, carrier_noise=CARRIER), refined(problem, carrier_noise=each)
    assert distance(first, second) == 0.0


def test_motions_take_propagated_noise() -> None:
    simulation = general(0, 1, seed=3, odometry=25, odometry_noise=Noise(SIGMA_M, KAPPA))
    noisy = refined(simulation.problem, carrier_noise=CARRIER)
    exact = refined(simulation.problem)
    assert np.trace(noisy.covariance("sensor0")) > np.trace(exact.covariance("sensor0"))
    with pytest.raises(rw.errors.OptionError, match="motions of sensor0 have a relative A"):
        refined(simulation.problem, carrier_noise=CARRIER, carrier_model="variables")


@pytest.mark.parametrize(
    ("noise", "error", "words"),
    [
        (lambda: rw.CarrierNoise(), rw.errors.NoiseError, "rotation_rad is 0.0"),
        (lambda: rw.CarrierNoise(0.01, np.nan), rw.errors.NoiseError, "translation_m is nan"),
        (lambda: rw.CarrierNoise(0.01, 0.01, about="world"), rw.errors.OptionError, "about='world'"),
        (lambda: rw.CarrierNoise(0.01, covariances={}), rw.errors.NoiseError, "standard deviations, not both"),
        (lambda: rw.CarrierNoise(covariances={}), rw.errors.NoiseError, "lacks"),
        (
            lambda: rw.CarrierNoise(covariances={("target0", "sensor0"): np.tile(np.eye(6), (3, 1, 1))}),
            rw.errors.CountError,
            r"shape \(3, 6, 6\)",
        ),
    ],
)
def test_bad_carrier_noise(noise: object, error: type[Exception], words: str) -> None:
    problem = rig(1, 1).problem
    with pytest.raises(error, match=words):
        refined(problem, carrier_noise=noise())


def test_noise_about_an_origin_a_thousand_kilometres_away_is_refused() -> None:
    far = se3.pose(np.eye(3), (1e6, -1e6, 1e6))
    problem = copied(rig(2, 2, seed=3).problem, A=lambda pair, raw: raw.A @ np.linalg.inv(far))
    with pytest.raises(rw.errors.NoiseError, match="about the other carrier"):
        refined(problem, carrier_noise=rw.CarrierNoise(rotation_rad=1e-3, translation_m=1e-3))


def test_one_carrier_pose_has_one_noise() -> None:
    problem = rig(1, 2, seed=3).problem
    first, second = problem.pairs
    noises = {first: np.tile(np.eye(6) * 1e-6, (20, 1, 1)), second: np.tile(np.eye(6) * 1e-4, (20, 1, 1))}
    with pytest.raises(rw.errors.NoiseError, match="target0-sensor0 and target0-sensor1 share a carrier pose"):
        refined(problem, carrier_noise=rw.CarrierNoise(covariances=noises))
