"""Corners of images that were left out."""

from __future__ import annotations

import numpy as np
import pytest
from simulated_cells import cell

import gtsam_rwhec as rw
from gtsam_rwhec.errors import CountError, OptionError
from gtsam_rwhec.fitting.held_out import held_out_errors


def test_errors_are_those_of_the_corners_and_of_the_carriers() -> None:
    exact, noisy = (cell(3, images=30, carrier=carrier) for carrier in ((0.0, 0.0), (1e-3, 5e-4)))
    rms = []
    for given in (exact, noisy):
        X, Y = given.near(np.random.default_rng(0))
        refined = rw.refine_corners(given.observations, X, Y)
        errors = held_out_errors(refined)
        assert set(errors) == {"cam_0", "cam_1"}
        assert sum(each.corners for each in errors.values()) >= 35 * 30 - 3
        rms.append(errors["cam_0"])
    # both axes of 0.1 pixels, and more by what the poses do not know
    assert rms[0].rms_px == pytest.approx(0.1 * np.sqrt(2.0), rel=0.15)
    # the images themselves fit to 0.1 pixels with the carriers' poses free; others are predicted by A as measured
    assert rms[1].rms_px > 3.0 * rms[0].rms_px
    assert rms[0].rms_mm == pytest.approx(1e3 * rms[0].rms_px * 1.5 / 1400.0, rel=0.4)
    assert np.nanmax(rms[0].regions_px) < 0.3


def test_stated_intrinsics_that_are_off_show() -> None:
    given = cell(4, images=30, stated_off=np.array([0.0, 0.0, 40.0, 30.0, 0.1, 0.0, 0.0, 0.0]))
    X, Y = given.near(np.random.default_rng(0))
    free = rw.CornerOptions(carrier_noise="exact")
    refined = rw.refine_corners(given.observations, X, Y, free)
    errors = held_out_errors(refined)
    assert errors["cam_0"].rms_px < 0.25


def test_what_cannot_be_left_out_is_refused() -> None:
    given = cell(0, images=5)
    X, Y = given.near(np.random.default_rng(0))
    refined = rw.refine_corners(given.observations, X, Y)
    with pytest.raises(OptionError, match="whole number from 2"):
        held_out_errors(refined, folds=1)
    with pytest.raises(CountError, match="5 instants cannot be left out in 6 blocks"):
        held_out_errors(refined, folds=6)
