"""A bias of all corners moves the answer as the covariance of it says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rwhec_factors import se3
from simulated_cells import cell

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.detector_bias import BIAS_PX, PATTERNS, covariance_of_bias, gradients_of_bias
from gtsam_rwhec.fitting.observations import Views

EXACT = rw.CornerOptions(carrier_noise="exact", outliers=False)
#: Pixels; large beside what rounds, small beside what bends.
BIAS = 0.02


@pytest.mark.parametrize("which", [0, 4])
def test_a_bias_moves_the_answer_as_said(which: int) -> None:
    given = cell(1, images=20, cameras=1)
    refined = rw.refine_corners(given.observations, given.X, given.Y, EXACT)
    ((pair, view),) = given.observations.views.items()
    pattern = list(PATTERNS.values())[which]
    none = np.zeros_like(view.pixels)
    biased = Views(view.A, view.pixels + BIAS * pattern(view.pixels, none, none, none))
    other = rw.refine_corners(replace(given.observations, views={pair: biased}), given.X, given.Y, EXACT)
    model, point = refined.graph.model, refined.point
    moved = refined.joint @ gradients_of_bias(model, point, refined.noise)[which] * BIAS
    xi = se3.logmap((se3.inverse(refined.Y["cam_0"].matrix()) @ other.Y["cam_0"].matrix())[None])[0]
    assert xi == pytest.approx(moved[refined.slots["y", "cam_0"]], rel=0.1, abs=0.05 * np.abs(xi).max())


def test_the_covariance_does_not_shrink_with_more_images() -> None:
    """Of the principal point, whose shift by a bias no number of images makes vanish."""
    few, many = (
        rw.refine_corners(given.observations, given.X, given.Y, EXACT)
        for given in (cell(1, images=20, cameras=1), cell(1, images=80, cameras=1))
    )
    deviations = [np.sqrt(np.diagonal(covariance_of_bias(each))[each.slots["k", "cam_0"]][2:4]) for each in (few, many)]
    assert np.linalg.norm(deviations[1]) > 0.4 * np.linalg.norm(deviations[0])  # of independent errors a half, or less
    assert (deviations[0] > BIAS_PX / 10).all()
    covariance = covariance_of_bias(many)
    assert covariance == pytest.approx(covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > -1e-12 * np.abs(covariance).max()
