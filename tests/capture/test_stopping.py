"""The rule that stops: what its factors promise, and what it says of cells that are good, poor, or hopeless."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import fdtri
from streamed import add, ones_of, streamed

import gtsam_rwhec as rw
from gtsam_rwhec.capture.stopping import FEWEST_FREEDOM, Why, lowest_share, widening
from gtsam_rwhec.errors import FrameError, OptionError
from gtsam_rwhec.simulate import Noise, general

WANTED = rw.Accuracy(0.0005, distance_m=0.8)


def stopped_means(factor: float, sigma: float, paths: int = 20_000) -> float:
    """How often the mean of vectors (3,) is inside its ellipsoid when a rule stops: measured, not by its formula.

    The vectors are drawn; mean and variance come from them, after each one from the fifth on.
    """
    e = np.random.default_rng(7).standard_normal((paths, 60, 3))
    n = np.arange(1, 61)
    means = np.cumsum(e, axis=1) / n[:, None]
    square = np.cumsum((e**2).sum(axis=2), axis=1) - n * (means**2).sum(axis=2)
    nu = np.maximum(3.0 * (n - 1), 1.0)
    s2 = square / nu
    bound = 3.0 * fdtri(3, nu, 0.95)
    first = FEWEST_FREEDOM // 3
    stops = factor**2 * sigma**2 * s2 * bound / n <= bound[first] / n[first]
    stops[:, :first] = False
    at = np.where(stops.any(axis=1), stops.argmax(axis=1), 59)
    every = np.arange(paths)
    inside = (means[every, at] ** 2).sum(axis=1) * n[at] <= factor**2 * bound[at] * s2[every, at]
    return float(inside.mean())


def test_widened_ellipsoids_hold_the_truth_at_the_moment_of_stopping() -> None:
    factor = widening(FEWEST_FREEDOM, 0.95)
    assert 1.03 < factor < 1.08
    sigmas = (1.1, 1.3, 1.5, 2.0)
    naive, widened = ([stopped_means(f, sigma) for sigma in sigmas] for f in (1.0, factor))
    assert min(naive) < 0.94
    assert min(widened) > 0.945
    assert max(widened) < 0.97
    assert factor > widening(30, 0.95) > widening(300, 0.95)
    assert widening(5000, 0.95) == 1.0


def test_the_lower_bound_of_the_noise_is_true_at_all_takes_together() -> None:
    nu = 3 * np.arange(1, 101)
    squares = np.cumsum(np.random.default_rng(3).chisquare(3, (4000, 100)), axis=1)
    shares = np.array([lowest_share(float(each)) for each in nu])
    wrong = (squares / nu * shares > 1.0).any(axis=1).mean()
    assert wrong < 0.05
    assert 0.0 < shares[0] < shares[-1] < 1.0
    assert lowest_share(np.inf) == 1.0


def test_a_cell_goes_on_and_stops_when_it_is_reached() -> None:
    noise = Noise(sigma_m=0.0002, kappa=1.0 / (2.0 * 0.0005**2))
    every = ones_of(general(1, 1, seed=3, number_of_measurements=40, noise=noise).problem)
    stream, rule = rw.Stream(), rw.StoppingRule(WANTED)
    decisions = [rule.after(add(stream, one)) for one in every]
    assert decisions[0].why is Why.NO_ANSWER
    assert str(decisions[0]).startswith("Go on: 0.5 mm at 0.8 m with 95 %: no answer")
    first = next(i for i, decision in enumerate(decisions) if decision.stop)
    assert 5 <= first < 39
    at = decisions[first]
    assert at.why is Why.REACHED
    assert at.reached_m <= 0.0005 < decisions[first - 1].reached_m
    assert at.widening > 1.0
    assert at.points["sensor0"].radius_mm == pytest.approx(1e3 * at.reached_m)
    assert str(at).startswith("Stop: 0.4")
    before = decisions[first - 2]
    assert before.more_takes is not None
    assert before.more_takes <= 12
    assert "more takes" in str(before)


def test_a_calibration_is_asked_as_an_update_is() -> None:
    noise = Noise(sigma_m=0.0001, kappa=1.0 / (2.0 * 0.0002**2))
    problem = general(1, 1, seed=3, number_of_measurements=20, noise=noise).problem
    calibration = rw.calibrate(problem)
    rule = rw.StoppingRule(rw.Accuracy(0.001, 0.8, sensors=("sensor0",)))
    decision = rule.after(calibration, takes=20)
    assert decision.stop
    assert decision.takes == 20
    stated = calibration.uncertainty_at([0.0, 0.0, 0.8], "sensor0").radius_mm
    assert 1e3 * decision.reached_m == pytest.approx(stated * decision.widening)
    with pytest.raises(FrameError, match="'cam' is wanted"):
        rw.StoppingRule(rw.Accuracy(0.001, 0.8, sensors=("cam",))).after(calibration)


def test_a_calibration_that_is_not_to_be_relied_on_does_not_stop_it() -> None:
    noise = Noise(sigma_m=0.0001, kappa=1.0 / (2.0 * 0.0002**2))
    calibration = rw.calibrate(general(1, 1, seed=3, motion="planar", number_of_measurements=12, noise=noise).problem)
    decision = rw.StoppingRule(rw.Accuracy(1.0, 0.8), accepts_care=True).after(calibration)
    assert decision.why is Why.NO_ANSWER
    assert "Do not use" in decision.reason


def test_what_no_number_of_takes_reaches_is_said_within_three() -> None:
    noise = Noise(sigma_m=0.05, kappa=1.0 / (2.0 * 0.005**2))
    every = ones_of(general(1, 1, seed=5, number_of_measurements=3, noise=noise).problem)
    decision = rw.StoppingRule(WANTED).after(streamed(every).last, takes=3)
    assert decision.why is Why.NOISE
    assert decision.why.is_never
    assert not decision.stop
    assert str(decision).startswith("Never: ")


def test_motion_about_one_axis_is_told() -> None:
    noise = Noise(sigma_m=0.0002, kappa=1.0 / (2.0 * 0.0005**2))
    planar = general(1, 1, seed=3, motion="planar", number_of_measurements=12, noise=noise)
    decision = rw.StoppingRule(WANTED).after(streamed(ones_of(planar.problem)).last)
    assert decision.why is Why.FREE_DIRECTION
    assert decision.reached_m == np.inf


def test_bad_input_is_refused() -> None:
    for radius, distance, level in ((0.0, 0.8, 0.95), (0.001, np.nan, 0.95), (0.001, 0.8, 1.0)):
        with pytest.raises(OptionError):
            rw.Accuracy(radius, distance, level)
    with pytest.raises(OptionError, match="Accuracy"):
        rw.StoppingRule(0.001)  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="most_takes"):
        rw.StoppingRule(WANTED, most_takes=0)
    with pytest.raises(OptionError, match="StreamUpdate"):
        rw.StoppingRule(WANTED).after(None)  # type: ignore[arg-type]
