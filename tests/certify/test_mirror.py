"""Planar motion with an unknown scale: the mirror image costs the same, and only one of the two is real."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import gtsam_rwhec as rw
from gtsam_rwhec.certify.descent import cost_of
from gtsam_rwhec.certify.mirror import mirrored
from gtsam_rwhec.certify.parts import parts_of
from gtsam_rwhec.certify.search import Forms, Search
from gtsam_rwhec.certify.variables import answer_of
from gtsam_rwhec.simulate import Noise, general

NOISE = Noise(0.005, 1641.0)


@pytest.mark.parametrize("scale", ["shared", "per_target"])
@pytest.mark.parametrize("odometry", [0, 10])
def test_the_mirror_image_costs_the_same_with_the_other_sign(scale: str, odometry: int) -> None:
    simulated = general(2, 2, seed=3, motion="planar", scale=scale, noise=NOISE, odometry=odometry)
    (part,) = parts_of(simulated.problem)
    form = Forms.of(part).reduced
    R = Search(part, rw.SolveOptions()).run("auto", None).R
    image = mirrored(part, R)
    assert np.linalg.det(image) == pytest.approx(np.ones(len(R)))
    if odometry == 0:  # odometry's carrier motions turn about axes of their own
        assert cost_of(form, image) == pytest.approx(cost_of(form, R), rel=1e-7)
        here, there = answer_of(part, form, R), answer_of(part, form, image)
        if scale == "shared":
            assert there.scale == pytest.approx(-here.scale, rel=1e-6)
        else:
            np.testing.assert_allclose(there.own_scale, -here.own_scale, rtol=1e-6)


@pytest.mark.parametrize("seed", range(12))
def test_the_answer_has_a_positive_scale_and_is_not_called_unique(seed: int) -> None:
    simulated = general(2, 2, seed=seed, motion="planar", scale="shared", noise=NOISE)
    with pytest.warns(rw.errors.NotUniqueWarning):
        solution = rw.solve(simulated.problem)
    assert solution.certificate.status == "certified_not_unique"
    assert solution.scale == pytest.approx(0.5, rel=0.05)


def test_some_of_those_answers_were_mirrored() -> None:
    paths = []
    for seed in range(12):
        simulated = general(2, 2, seed=seed, motion="planar", scale="shared", noise=NOISE)
        with pytest.warns(rw.errors.NotUniqueWarning):
            paths.append(rw.solve(simulated.problem).certificate.path)
    assert 0 < sum("mirrored" in path for path in paths) < len(paths)


def test_an_inverted_convention_is_an_error_and_no_mirror_image() -> None:
    """Inverting A gives no answer that a half turn mends."""
    refused = 0
    for seed in range(10):
        simulated = general(1, 1, seed=seed, scale="shared", noise=NOISE)
        raw = simulated.problem.measurements("target0", "sensor0")
        wrong = rw.Problem("shared")
        wrong.add("target0", "sensor0", np.linalg.inv(raw.A), raw.B, 0.005, 1641.0)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            try:
                rw.solve(wrong)
            except rw.errors.ScaleError:
                refused += 1
            else:
                assert any(issubclass(w.category, rw.errors.WeightsWarning) for w in told)
    assert refused > 0
