"""Motion about one axis leaves the sign of an unknown scale open: a half turn about the axis mirrors the answer."""

from __future__ import annotations

import numpy as np
import pytest
from small_problems import part_of, reduced, searched, simulated, true_rotations

from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.solver.answers import answer_of
from gtsam_rwhec.solver.descent import cost_of, mirrored
from gtsam_rwhec.solver.rotations import random_rotations


@pytest.mark.parametrize(("sides", "odometry"), [((2, 2), 0), ((1, 3), 0), ((0, 1), 6), ((2, 1), 6)])
def test_the_image_costs_the_same_with_the_scales_sign_changed(sides: tuple[int, int], odometry: int) -> None:
    """At any rotations, not only the best: planar A is what counts, whatever B is."""
    problem = simulated(*sides, 1, motion="planar", odometry=odometry, scale="shared").problem
    part, form = part_of(problem), reduced(problem)
    R = random_rotations(len(part.free), np.random.default_rng(0))
    image = mirrored(part, R)
    np.testing.assert_allclose(np.linalg.det(image), 1.0)
    assert cost_of(form, image) == pytest.approx(cost_of(form, R), rel=1e-8)
    assert answer_of(part, form, image).scale == pytest.approx(-answer_of(part, form, R).scale, rel=1e-6)
    np.testing.assert_allclose(mirrored(part, image), R, atol=1e-12)


@pytest.mark.parametrize("scale", ["shared", "per_target"])
@pytest.mark.parametrize("motion", ["planar", "single_axis"])
def test_the_search_returns_the_image_with_positive_scales(motion: str, scale: ScaleMode) -> None:
    """Whichever of the two planar motion's descent ended at; by seed it is the one or the other."""
    mirrored_ones = 0
    for seed in range(12):
        search = searched(simulated(2, 1, seed, motion=motion, scale=scale).problem)
        found = search.with_positive_scale(search.run("auto", None))
        answer = answer_of(search.part, search.form, found.R)
        own = answer.own_scale[np.isfinite(answer.own_scale)]
        assert answer.scale > 0.0
        assert (own > 0.0).all()
        assert found.is_closed
        mirrored_ones += found.path.is_mirrored
    assert (mirrored_ones > 0) == (motion == "planar")


def test_an_answer_with_positive_scales_is_left_alone() -> None:
    simulation = simulated(2, 1, 0, scale="shared")
    search = searched(simulation.problem)
    found = search.run("auto", None)
    assert search.with_positive_scale(found) is found
    np.testing.assert_allclose(found.R, true_rotations(simulation), atol=0.1)
