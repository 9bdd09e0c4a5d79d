"""The GTSAM graph: its cost and its rows."""

from __future__ import annotations

import pytest
from rwhec_factors import se3
from simulated_cells import A_NOISE, Cell, cell, check_inverse, information_by_instant, model_and_point, slopes

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
        gradient = linear.gradientAtZero().at(key)
        assert gradient == pytest.approx(slopes(graph.graph, values, key), rel=1e-4, abs=1e-4 * error)


@pytest.mark.parametrize("about", ["targetcarrier", "sensorcarrier"])
def test_the_sums_by_instant_have_the_graphs_information(small: Cell, about: str) -> None:
    model, point = model_and_point(small, about=about)
    point = Point(point.X, point.Y, model.A, point.cameras, point.shapes)
    graph = CornerGraph(model, point)
    reduced = Reduced.of(model, point)
    joint, last_step = graph.covariance(graph.values(point), reduced.slots)
    check_inverse(joint, information_by_instant(reduced))
    assert last_step > 1.0  # it is not an optimum
