"""The noise of greatest restricted likelihood."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from simulated_cells import cell
from simulated_models import model_and_point

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.common_errors import whitened, whitener
from gtsam_rwhec.fitting.corner_model import Point
from gtsam_rwhec.fitting.corner_noise import Noise, Reduced
from gtsam_rwhec.fitting.corner_patterns import OF_AN_IMAGE, patterns
from gtsam_rwhec.fitting.corners_as_refined import numbers_of
from gtsam_rwhec.fitting.observations import Views


@pytest.fixture(scope="module")
def reduced() -> Reduced:
    model, point = model_and_point(cell(4, images=6, carrier=(1e-3, 5e-4)))
    return Reduced.of(model, Point(point.X, point.Y, model.A, point.cameras, point.shapes))


def test_its_derivatives(reduced: Reduced) -> None:
    at = np.log([0.12, 2e-3, 1e-3, 0.05])
    _, gradient = reduced.minus_two_log_likelihood(Noise(*np.exp(at)))
    for i, step in enumerate(1e-5 * np.eye(4)):
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


def test_whitened_rows_have_the_inverse_of_the_variance() -> None:
    P, rows = np.random.default_rng(0).normal(size=(2, 1, 8, 3))
    W = whitened(np.eye(8)[None], whitener(P))[0]
    np.testing.assert_allclose(W @ W, np.linalg.inv(np.eye(8) + P[0] @ P[0].T), atol=1e-12)
    np.testing.assert_allclose(whitened(rows, whitener(P))[0], W @ rows[0], atol=1e-12)


def test_what_the_corners_of_an_image_share_is_found_and_widens_the_covariance() -> None:
    given = cell(3, images=60, carrier=(1e-4, 5e-5))
    without = rw.refine_corners(given.observations, given.X, given.Y)
    model, rng, views = without.graph.model, np.random.default_rng(0), dict(given.observations.views)
    for stack in model.stacks:
        P, view = patterns(model, stack, without.point, OF_AN_IMAGE), views[stack.targets[0], stack.sensor]
        shared = P @ rng.normal(0.0, 0.05, (len(P), P.shape[2], 1))
        views[stack.targets[0], stack.sensor] = Views(view.A, view.pixels + shared.reshape(view.pixels.shape))
    shared = replace(given.observations, views=views)
    found = rw.refine_corners(shared, given.X, given.Y)
    assert "all corners of an image are off together by 0.0" in str(numbers_of(shared, found, rw.CornerOptions()))
    assert without.noise.common_px < 0.02 < 0.04 < found.noise.common_px < 0.07
    assert found.noise.corner_px == pytest.approx(0.1, rel=0.05)
    size = [np.sqrt(np.diagonal(one.covariance("cam_0"))) for one in (without, found)]
    assert (size[1] > size[0]).all()
    # the graph's covariance is that of the likelihood
    information = Reduced.of(found.graph.model, found.point).information(found.noise)
    np.testing.assert_allclose(np.diagonal(np.linalg.inv(information)), np.diagonal(found.joint), rtol=1e-3)


def test_exact_poses_and_free_corners_leave_nothing_to_share(reduced: Reduced) -> None:
    assert reduced.free(Noise(0.1, 0.0, 0.0), carrier=False) == [0]
    assert reduced.free(Noise(0.1, 1e-3, 1e-3), carrier=True) == [0, 1, 2, 3]
    given = cell(1, images=10)
    free = rw.refine_corners(given.observations, given.X, given.Y, rw.CornerOptions(corners_m=1e-4))
    assert free.noise.common_px == 0.0
