"""The GTSAM graph: its cost and its rows."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from rwhec_factors import se3
from simulated_cells import A_NOISE, CORNER_PX, Cell, cell, model_and_point

from gtsam_rwhec.fitting.corner_graph import CornerGraph, key_of
from gtsam_rwhec.fitting.corner_model import Point
from gtsam_rwhec.fitting.corner_noise import Reduced


@pytest.fixture(scope="module")
def small() -> Cell:
    return cell(3, images=6)


@pytest.mark.parametrize("about", ["targetcarrier", "sensorcarrier"])
def test_the_cost_is_half_the_sum_of_squares(small: Cell, about: str) -> None:
    model, point = model_and_point(small, about=about)
    graph = CornerGraph(model, point)
    xi = se3.logmap(se3.inverse(model.A) @ point.A)
    if about == "sensorcarrier":
        xi = se3.logmap(point.A @ se3.inverse(model.A))
    expected = 0.5 * sum((error**2).sum() for error in model.errors(point)) + 0.5 * ((xi / A_NOISE) ** 2).sum()
    expected += 0.5 * 4 * 0.5**2
    for name, prior in model.camera_priors.items():
        off = point.cameras[name] - prior.mean
        expected += 0.5 * float(off @ prior.precision @ off)
    assert graph.graph.error(graph.values(point)) == pytest.approx(
        expected, rel=1e-5 if about == "sensorcarrier" else 1e-9
    )


def test_linear_rows_have_the_cost_and_the_gradient_of_the_residuals(small: Cell) -> None:
    model, point = model_and_point(small)
    graph = CornerGraph(model, point)
    values = graph.values(point)
    linear = graph.graph.linearize(values)
    error = graph.graph.error(values)
    for key in (graph.keys["x", "board"], graph.keys["y", "cam_0"], key_of("a", 0)):
        for step in 1e-7 * np.eye(6):
            moved = [gtsam.Values(values), gtsam.Values(values)]
            for at, sign in zip(moved, (1.0, -1.0), strict=True):
                at.update(key, values.atPose3(key).retract(sign * step))
            numeric = (graph.graph.error(moved[0]) - graph.graph.error(moved[1])) / (2e-7)
            gradient = linear.gradientAtZero().at(key) @ (step / 1e-7)
            assert gradient == pytest.approx(numeric, rel=1e-4, abs=1e-4 * error)


@pytest.mark.parametrize("about", ["targetcarrier", "sensorcarrier"])
def test_the_sums_by_instant_have_the_graphs_information(small: Cell, about: str) -> None:
    model, point = model_and_point(small, about=about)
    point = Point(point.X, point.Y, model.A, point.cameras, point.shapes)
    graph = CornerGraph(model, point)
    reduced = Reduced.of(model, point)
    joint, last_step = graph.covariance(graph.values(point), reduced.slots)
    s2 = CORNER_PX**2
    H = reduced.G / s2 + reduced.prior
    for C, M in zip(reduced.C, reduced.M, strict=True):
        H -= C.T @ np.linalg.solve(np.diag(A_NOISE**-2.0) + M / s2, C) / s2**2
    size = np.sqrt(np.diagonal(joint))
    assert joint / np.outer(size, size) == pytest.approx(np.linalg.inv(H) / np.outer(size, size), abs=1e-6)
    assert last_step > 1.0  # it is not an optimum
