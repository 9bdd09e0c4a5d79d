"""Boards whose corners are off their places: each corner is an unknown with a prior."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from problems_of_corners import problem_of
from scipy.stats import chi2
from simulated_cells import (
    A_NOISE,
    BOARD,
    CAMERA,
    CORNER_PX,
    Cell,
    cell,
    check_inverse,
    misprinted,
    model_and_point,
    slopes,
)

import gtsam_rwhec as rw
from gtsam_rwhec.errors import FileFormatError, OptionError
from gtsam_rwhec.fitting.corner_graph import CornerGraph
from gtsam_rwhec.fitting.corner_model import Model, Point
from gtsam_rwhec.fitting.corner_noise import Reduced
from gtsam_rwhec.fitting.corner_residuals import linearised, pixel_errors, stacks_of
from gtsam_rwhec.fitting.held_out import held_out_errors

MISPRINT_M = 2e-4
#: Covariances of poses are those of corners alone: the noise of A is more.
pytestmark = pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.WeightsWarning")

OPTIONS = rw.CornerOptions(stated="calibration", corners_m=MISPRINT_M)


@pytest.fixture(scope="module")
def small() -> Cell:
    return cell(3, images=6)


def model_with_corners(small: Cell) -> tuple[Model, Point]:
    model, point = model_and_point(small)
    off = np.random.default_rng(2).normal(scale=1e-4, size=(35, 3))
    return replace(model, corner_priors={"board": 1e-3}), replace(point, corners={"board": off})


def test_derivatives_by_a_corners_place(small: Cell) -> None:
    (stack, *_), A = stacks_of(small.observations)
    at = small.X["board"], small.Y["cam_0"], A, CAMERA.parameters, np.full(4, 1e-3), 0.0
    off = np.random.default_rng(2).normal(scale=1e-3, size=(35, 3))
    by_corners = linearised(stack, *at, off).by_corners
    for i, step in enumerate(1e-7 * np.eye(3)):
        above, below = (pixel_errors(stack, *at, off + sign * step) for sign in (1.0, -1.0))
        numeric = ((above - below) / 2e-7).reshape(by_corners.shape[:3])
        assert by_corners[..., i] == pytest.approx(numeric, rel=1e-5, abs=1e-3)


def test_linear_rows_have_the_gradient_of_the_cost(small: Cell) -> None:
    model, point = model_with_corners(small)
    graph = CornerGraph(model, point)
    values = graph.values(point)
    assert graph.point(values).corners["board"] == pytest.approx(point.corners["board"], abs=0.0)
    key = graph.keys["p", "board"]
    gradient = graph.graph.linearize(values).gradientAtZero().at(key)
    assert gradient == pytest.approx(slopes(graph.graph, values, key, 105), rel=1e-4, abs=1e-5 * np.abs(gradient).max())


def test_the_sums_by_instant_have_the_graphs_information(small: Cell) -> None:
    model, point = model_with_corners(small)
    point = replace(point, A=model.A)
    graph, reduced = CornerGraph(model, point), Reduced.of(model, point)
    H = reduced.information(rw.fitting.Noise(CORNER_PX, float(A_NOISE[0]), float(A_NOISE[3])))
    check_inverse(graph.covariance(graph.values(point), reduced.slots)[0], H)


def test_a_misprinted_board_is_found_with_everything_else() -> None:
    given, off = misprinted(3, MISPRINT_M, images=40, cameras=3, stated="calibration", carrier=(1e-3, 5e-4))
    refined = given.refined(OPTIONS, seed=0)
    assert refined.noise.corner_px == pytest.approx(0.1, rel=0.05)
    error = (BOARD.corners() + off - refined.corners["board"]).ravel()
    covariance = refined.covariance("corners:board")
    assert np.sqrt((error**2).mean()) < 0.5 * MISPRINT_M
    assert chi2.ppf(1e-3, 105) < error @ np.linalg.solve(covariance, error) < chi2.ppf(0.999, 105)
    assert all(given.squared_error(refined, name) < chi2.ppf(0.999, 6) for name in ("board", "cam_0", "cam_1", "cam_2"))
    assert not any("corners of board" in words for words in refined.findings)


def test_images_that_were_left_out_are_predicted_better() -> None:
    given, _ = misprinted(4, MISPRINT_M, images=30)
    X, Y = given.near(np.random.default_rng(0))
    rms = []
    for corners_m in (0.0, MISPRINT_M):
        options = replace(OPTIONS, corners_m=corners_m, carrier_noise="exact")
        refined = rw.refine_corners(given.observations, X, Y, options)
        error = held_out_errors(refined, folds=3)["cam_0"]
        rms.append(error.rms_px)
    assert rms[1] < 0.7 * rms[0]
    # the target's pose and its corners' places are off together
    assert error.expected_px == pytest.approx(error.rms_px, rel=0.07)


def test_corners_far_from_their_places_are_named() -> None:
    given, _ = misprinted(5, 3e-4, images=30)
    refined = given.refined(replace(OPTIONS, corners_m=1e-4), seed=0)
    said = [words for words in refined.findings if "corners of board are farther" in words]
    assert len(said) == 1
    assert "than corners_m=0.0001 explains (corner " in said[0]


def test_results_and_their_files_have_the_corners(tmp_path: Path) -> None:
    given, off = misprinted(6, MISPRINT_M, images=10, stated="calibration", carrier=(5e-4, 2e-4))
    problem = problem_of(given.observations)
    refined = rw.refine(problem, rw.solve(problem), rw.RefineOptions(observations="corners"), corners=OPTIONS)
    assert refined.reprojection is not None
    board = refined.reprojection.boards["board"]
    assert np.abs(np.array(board.corners_off_m) - off).max() < 5.0 * np.array(board.corners_deviations_m).max()
    assert str(board).startswith("its corners are 0.3")
    rw.write_refined(refined, tmp_path / "refined.json")
    back = rw.read_refined(tmp_path / "refined.json").reprojection
    assert back == refined.reprojection
    short = replace(board, corners_deviations_m=board.corners_deviations_m[1:])
    wrong = replace(refined, reprojection=replace(refined.reprojection, boards={"board": short}))
    with pytest.raises(
        FileFormatError, match=r"boards\.board: corners_off_m and corners_deviations_m must have x, y, z"
    ):
        rw.write_refined(wrong, tmp_path / "wrong.json")


def test_a_board_as_stated_has_its_corners_where_they_are_stated(small: Cell) -> None:
    refined = small.refined(rw.CornerOptions(carrier_noise="exact"), seed=0)
    assert refined.corners["board"] == pytest.approx(BOARD.corners(), abs=0.0)
    assert "corners:board" not in refined.names
    with pytest.raises(OptionError, match=r"corners_m=-1\.0; give a standard deviation, or 0"):
        rw.CornerOptions(corners_m=-1.0)
