"""A bias of all corners moves the answer as the covariance of it says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rwhec_factors import se3
from simulated_cells import cell

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.corner_noise import Reduced
from gtsam_rwhec.fitting.corner_patterns import PATTERNS
from gtsam_rwhec.fitting.detector_bias import covariance_of_bias, gradients_of_bias
from gtsam_rwhec.fitting.observations import Views

#: Pixels; large beside what rounds, small beside what bends.
BIAS = 0.02
EXACT = rw.CornerOptions(carrier_noise="exact", outliers=False, bias_px={"board": BIAS})


@pytest.mark.parametrize("which", [0, 2])
def test_a_bias_moves_the_answer_as_said(which: int) -> None:
    given = cell(1, images=20, cameras=1)
    refined = rw.refine_corners(given.observations, given.X, given.Y, EXACT)
    ((pair, view),) = given.observations.views.items()
    pattern = list(PATTERNS.values())[which]
    none = np.zeros_like(view.pixels)
    biased = Views(view.A, view.pixels + BIAS * pattern(view.pixels, none, none, none))
    other = rw.refine_corners(replace(given.observations, views={pair: biased}), given.X, given.Y, EXACT)
    reduced = Reduced.of(refined.graph.model, refined.point)
    moved = refined.joint @ gradients_of_bias(refined.graph.model, reduced, refined.noise)[which]
    xi = se3.logmap((se3.inverse(refined.Y["cam_0"].matrix()) @ other.Y["cam_0"].matrix())[None])[0]
    assert xi == pytest.approx(moved[refined.slots["y", "cam_0"]], rel=0.1, abs=0.05 * np.abs(xi).max())


def test_more_of_the_same_images_shrink_the_noise_and_not_the_bias() -> None:
    given = cell(1, images=20, cameras=1)
    ((pair, view),) = given.observations.views.items()
    fourfold = Views(np.tile(view.A, (4, 1, 1)), np.tile(view.pixels, (4, 1, 1)))
    few, many = (
        rw.refine_corners(replace(given.observations, views={pair: each}), given.X, given.Y, EXACT)
        for each in (view, fourfold)
    )
    pose = few.slots["y", "cam_0"]
    noise = [np.sqrt(np.diagonal(each.joint)[pose]) / each.noise.corner_px for each in (few, many)]
    bias = [np.sqrt(np.diagonal(covariance_of_bias(each))[pose]) for each in (few, many)]
    assert noise[1] == pytest.approx(0.5 * noise[0], rel=0.1)
    assert bias[1] == pytest.approx(bias[0], rel=0.1)
    assert np.linalg.eigvalsh(covariance_of_bias(many)).min() > -1e-12 * covariance_of_bias(many).max()
