"""Clocks' offsets as unknowns of the corner graph: derivatives, sums, recovery, and what tells none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given as for_any
from hypothesis import settings
from hypothesis import strategies as st
from rwhec_factors import se3
from scipy.stats import chi2
from simulated_cells import CAMERA, Cell, cell, check_inverse, information_by_instant, model_and_point, moving, slopes

import gtsam_rwhec as rw
from gtsam_rwhec.errors import CountError, FrameError, OptionError
from gtsam_rwhec.fitting.corner_graph import CornerGraph, key_of
from gtsam_rwhec.fitting.corner_model import Model, Point
from gtsam_rwhec.fitting.corner_noise import Reduced
from gtsam_rwhec.fitting.corner_residuals import linearised, pixel_errors, stacks_of
from gtsam_rwhec.fitting.held_out import held_out_errors

LATE = {"cam_0": 4e-3, "cam_1": -2e-3}
OPTIONS = rw.CornerOptions(stated="calibration", time_offsets=("cam_0", "cam_1"))


@pytest.fixture(scope="module")
def small() -> Cell:
    return moving(cell(3, images=6), 1, LATE)


@pytest.fixture(scope="module")
def late() -> Cell:
    return moving(cell(6, images=30, stated="calibration"), 2, LATE)


def model_with_clocks(small: Cell, about: str) -> tuple[Model, Point]:
    model, point = model_and_point(small, about=about)
    return replace(model, offset_priors={"cam_0": 1.0}), replace(point, offsets_s={"cam_0": 0.03})


@settings(max_examples=5, deadline=None)
@for_any(st.floats(-0.3, 0.3))
def test_derivatives_by_the_offset_and_by_the_pose_at_the_instant(offset_s: float) -> None:
    small = moving(cell(3, images=6), 1, LATE)
    (stack, *_), A = stacks_of(small.observations)
    p, shape = CAMERA.parameters, np.zeros(4)
    X, Y = small.X["board"], small.Y["cam_0"]
    rows = linearised(stack, X, Y, A, p, shape, offset_s)
    for by, analytic in (("time", rows.by_time), ("A", rows.by_A)):
        for i, step in enumerate(1e-6 * np.eye(analytic.shape[2])):
            above, below = (
                pixel_errors(stack, X, Y, A, p, shape, offset_s + sign * float(step[0]))
                if by == "time"
                else pixel_errors(stack, X, Y, A @ se3.expmap(sign * step[None])[0], p, shape, offset_s)
                for sign in (1.0, -1.0)
            )
            off = np.abs(analytic[..., i] - (above - below) / 2e-6).max()
            assert off < 1e-5 * np.abs(analytic[..., i]).max() + 1e-5


@pytest.mark.parametrize("about", ["targetcarrier", "sensorcarrier"])
def test_linear_rows_have_the_gradient_of_the_cost(small: Cell, about: str) -> None:
    model, point = model_with_clocks(small, about)
    graph = CornerGraph(model, point)
    values = graph.values(point)
    assert graph.point(values).offsets_s == point.offsets_s
    gradient = graph.graph.linearize(values).gradientAtZero()
    key = graph.keys["t", "cam_0"]
    assert gradient.at(key) == pytest.approx(slopes(graph.graph, values, key, 1, 1e-6), rel=1e-5)
    of_A = gradient.at(key_of("a", 2))
    assert of_A == pytest.approx(slopes(graph.graph, values, key_of("a", 2)), rel=1e-4, abs=1e-4 * np.abs(of_A).max())


@pytest.mark.parametrize("about", ["targetcarrier", "sensorcarrier"])
def test_the_sums_by_instant_have_the_graphs_information(small: Cell, about: str) -> None:
    model, point = model_with_clocks(small, about)
    point = replace(point, A=model.A)
    graph, reduced = CornerGraph(model, point), Reduced.of(model, point)
    assert ("t", "cam_0") in reduced.slots
    check_inverse(graph.covariance(graph.values(point), reduced.slots)[0], information_by_instant(reduced))


@pytest.mark.parametrize("noise", ["exact", "estimate"])
def test_offsets_are_found_with_everything_else(late: Cell, noise: rw.fitting.CarrierPoses) -> None:
    X, Y = late.near(np.random.default_rng(0))
    options = replace(OPTIONS, carrier_noise=noise)
    refined = rw.refine_corners(late.observations, X, Y, options)
    assert not any("time" in words for words in refined.findings)
    names = tuple(f"time_offset:{name}" for name in LATE)
    assert set(names) < set(refined.names)
    covariance = refined.covariance(*names)
    off = np.array([refined.time_offsets_s[name] - LATE[name] for name in LATE])
    assert np.sqrt(np.diagonal(covariance)).max() < 1e-4
    assert off @ np.linalg.solve(covariance, off) < 14.0
    assert all(late.squared_error(refined, name) < 22.5 for name in ("board", "cam_0", "cam_1"))
    # without the offsets the corners are off
    assert held_out_errors(refined, folds=2)["cam_0"].rms_px < 0.16
    kept = replace(options, time_offsets=())
    without = rw.refine_corners(late.observations, X, Y, kept)
    assert held_out_errors(without, folds=2)["cam_0"].rms_px > 0.5


def test_errors_of_offsets_are_as_large_as_their_deviations() -> None:
    """Over six cells whose A is noisy: the squares are chi-square's."""
    rng, squares = np.random.default_rng(4), 0.0
    for seed in range(6):
        truth = dict(zip(LATE, rng.normal(scale=5e-3, size=2).tolist(), strict=True))
        given = moving(cell(100 + seed, images=15, stated="calibration", carrier=(1e-3, 5e-4)), seed, truth)
        X, Y = given.near(rng)
        refined = rw.refine_corners(given.observations, X, Y, OPTIONS)
        off = np.array([refined.time_offsets_s[name] - truth[name] for name in LATE])
        squares += float(off @ np.linalg.solve(refined.covariance("time_offset:cam_0", "time_offset:cam_1"), off))
    assert chi2.ppf(1e-3, 12) < squares < chi2.ppf(0.999, 12)


def test_a_carrier_that_stands_still_tells_no_offset() -> None:
    still = moving(cell(6, images=20), 2, {}, np.zeros(6))
    refined = still.refined(OPTIONS, seed=0)
    assert refined.time_offsets_s == pytest.approx({"cam_0": 0.0, "cam_1": 0.0})
    assert refined.covariance("time_offset:cam_1")[0, 0] == pytest.approx(1.0)
    said = [words for words in refined.findings if "time offset" in words]
    assert len(said) == 2
    assert (
        "time offset of cam_0, since the carriers stand still in all of them: it is +0 s, with a deviation of 1 s"
        in said[0]
    )


def test_motion_that_is_alike_in_all_images_tells_no_offset() -> None:
    alike = moving(cell(6, images=12), 2, {}, np.repeat([0.04, 0.02], 3), alike=True)
    refined = alike.refined(OPTIONS, seed=0)
    assert any("since the carriers move alike in all of them" in words for words in refined.findings)
    # what an offset would do, the target's pose does too
    assert np.sqrt(refined.covariance("board")[0, 0]) > 1e-3


def test_a_long_offset_asks_for_another_refinement() -> None:
    long = moving(cell(6, images=20), 2, {"cam_0": 0.05})
    refined = long.refined(replace(OPTIONS, time_offsets=("cam_0",)), seed=0)
    assert any("images of cam_0 were taken +49.9 ms from the times of their A" in words for words in refined.findings)


def test_what_an_offset_needs_is_said(small: Cell) -> None:
    X, Y = small.near(np.random.default_rng(0))
    views = {pair: replace(view, twist=None) for pair, view in small.observations.views.items()}
    with pytest.raises(
        CountError, match=r"offset of cam_0 needs the carriers' velocity .* of board have none: give vi"
    ):
        rw.refine_corners(replace(small.observations, views=views), X, Y, OPTIONS)
    with pytest.raises(FrameError, match=r"time_offsets names 'cam_7'; the sensors are cam_0, cam_1"):
        rw.refine_corners(small.observations, X, Y, rw.CornerOptions(time_offsets=("cam_7",)))
    with pytest.raises(OptionError, match=r"time_offsets='cam_0'; give a tuple"):
        rw.CornerOptions(time_offsets="cam_0")  # type: ignore[arg-type]
    pair = ("board", "cam_0")
    view = small.observations.views[pair]
    with pytest.raises(CountError, match=r"velocities have shape \(1, 6\), finite: True; give \(\d+, 6\) finite"):
        rw.Observations.of(small.cameras, small.observations.corners, {pair: (view.A, view.pixels, np.zeros((1, 6)))})
    of = rw.Observations.of(small.cameras, small.observations.corners, {pair: (view.A, view.pixels, view.twist)})
    assert of.views[pair].twist == pytest.approx(view.twist)
