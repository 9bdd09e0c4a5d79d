"""The noise of greatest restricted likelihood."""

from __future__ import annotations

import numpy as np
import pytest
from simulated_cells import cell
from simulated_models import model_and_point

from gtsam_rwhec.fitting.corner_model import Point
from gtsam_rwhec.fitting.corner_noise import Noise, Reduced


@pytest.fixture(scope="module")
def reduced() -> Reduced:
    model, point = model_and_point(cell(4, images=6, carrier=(1e-3, 5e-4)))
    return Reduced.of(model, Point(point.X, point.Y, model.A, point.cameras, point.shapes))


def test_its_derivatives(reduced: Reduced) -> None:
    at = np.log([0.12, 2e-3, 1e-3])
    _, gradient = reduced.minus_two_log_likelihood(Noise(*np.exp(at)))
    for i, step in enumerate(1e-5 * np.eye(3)):
        above, below = (reduced.minus_two_log_likelihood(Noise(*np.exp(at + sign * step)))[0] for sign in (1, -1))
        assert gradient[i] == pytest.approx((above - below) / 2e-5, rel=1e-4, abs=1e-3)


def test_its_maximum_is_where_the_derivatives_are_zero(reduced: Reduced) -> None:
    noise = reduced.likeliest(Noise(0.3, 1e-3, 1e-3))
    best, gradient = reduced.minus_two_log_likelihood(noise)
    assert np.abs(gradient).max() < 0.05
    for factor in (0.9, 1.1):
        assert (
            reduced.minus_two_log_likelihood(Noise(factor * noise.corner_px, noise.carrier_rad, noise.carrier_m))[0]
            > best
        )


def test_noise_that_is_given_stays(reduced: Reduced) -> None:
    noise = reduced.likeliest(Noise(0.3, 1e-3, 5e-4), carrier=False)
    assert (noise.carrier_rad, noise.carrier_m) == (1e-3, 5e-4)


def test_change_is_a_share() -> None:
    before = Noise(0.1, 1e-3, 1e-9)
    assert Noise(0.11, 1e-3, 5e-9).change(before) == pytest.approx(0.01 / 0.11)
