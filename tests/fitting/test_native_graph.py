"""GTSAM's own factors and ours: the same cost, the same optimum, the same deviations."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from native_graph import NativeGraph
from rwhec_factors import se3
from simulated_cells import CAMERA, Cell, cell, model_and_point

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.fitting.corner_graph import CornerGraph
from gtsam_rwhec.fitting.corner_model import Model, Point
from gtsam_rwhec.fitting.corner_noise import Reduced

SIZE = (CAMERA.width, CAMERA.height)
LENSES = {
    "pinhole": Camera.of(*SIZE, "", CAMERA.K, (), "cell"),
    "radtan": CAMERA,
    "equidistant": Camera.of(*SIZE, "equidistant", CAMERA.K, (-0.02, 6e-3, -4e-3, 8e-4), "cell"),
}


def optimum(graph: CornerGraph | NativeGraph, start: Point) -> gtsam.Values:
    """By Levenberg-Marquardt, and then by whole steps until rounding is all that moves."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    values = gtsam.LevenbergMarquardtOptimizer(graph.graph, graph.values(start), parameters).optimize()
    for _ in range(4):
        values = values.retract(graph.graph.linearize(values).optimize())
    return values


def flat(model: Model, point: Point) -> tuple[Model, Point]:
    """The same with a board of the stated shape."""
    return replace(model, shape_priors={}), replace(point, shapes={"board": np.zeros(4)})


@pytest.fixture(params=LENSES, scope="module")
def small(request: pytest.FixtureRequest) -> Cell:
    return cell(3, images=8, camera=LENSES[request.param], carrier=(1e-3, 5e-4), stated="calibration")


@pytest.mark.parametrize("about", ["targetcarrier", "sensorcarrier"])
def test_gtsams_own_factors_have_the_same_optimum_and_deviations(small: Cell, about: str) -> None:
    model, start = flat(*model_and_point(small, about=about))
    ours, native = CornerGraph(model, start), NativeGraph(model, start)
    at, theirs = optimum(ours, start), optimum(native, start)
    a, b = ours.point(at), native.point(theirs)
    before = ours.graph.error(ours.values(start))
    assert native.graph.error(native.values(start)) == pytest.approx(before, rel=1e-9)
    assert native.graph.error(native.values(a)) == pytest.approx(ours.graph.error(at), rel=1e-9)
    joint, last_step = ours.covariance(at, Reduced.of(model, a).slots)
    deviations = np.sqrt(np.diagonal(joint))
    off = [se3.logmap((se3.inverse(T) @ (b.X | b.Y)[name])[None])[0] for name, T in (a.X | a.Y).items()]
    assert np.abs(off).max() < 1e-9
    off += [b.cameras[name] - parameters for name, parameters in a.cameras.items()]
    assert np.abs(np.concatenate(off) / deviations).max() < 1e-9
    assert last_step < 1e-6
    assert np.sqrt(np.diagonal(native.covariance(theirs))) == pytest.approx(deviations, rel=1e-6)
