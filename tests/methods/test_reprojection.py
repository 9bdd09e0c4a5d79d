"""Methods on corners by name and in one table: one measure for all, starts, what is refused."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from corner_problems import CAMERAS, GRID, SQUARE, seen
from problems_of_corners import problem_of
from rwhec_factors import se3

from gtsam_rwhec.errors import CameraError, CountError, FrameError, NoiseError, OptionError, TargetError
from gtsam_rwhec.fitting.fit_options import CarrierNoise
from gtsam_rwhec.fitting.observations import Observations
from gtsam_rwhec.methods import MethodOptions, compare, run
from gtsam_rwhec.methods import reprojection as methods
from gtsam_rwhec.simulate.simulation import frame_distance


def test_all_methods_are_in_one_table_and_ours_is_the_least_of_the_shared_cost() -> None:
    observations, _, _ = seen(0.3, 4)
    table = methods.compare(observations)
    by_name = {row.method: row.answer for row in table.rows}
    assert set(by_name) == {"tabb2017_rp1", "evangelista2023", "refine_corners"}
    ours, rp1 = by_name["refine_corners"], by_name["tabb2017_rp1"]
    assert ours is not None
    assert rp1 is not None
    # with as many images of each camera, rp1 has the same optimum
    assert ours.reprojection_cost == pytest.approx(rp1.reprojection_cost, rel=1e-7)
    costs = [row.answer.reprojection_cost for row in table.rows if row.answer is not None]
    assert costs == sorted(costs)
    for row in table.rows:
        assert row.answer is not None
        assert "certified solution" in row.answer.starts_from
        assert f"{row.answer.rms_px:.4f}" in str(table)


def test_with_a_noise_of_a_ours_has_the_minimum_of_the_graph() -> None:
    observations, _, _ = seen(0.3, 7)
    carrier = CarrierNoise(rotation_rad=1e-3, translation_m=5e-4)
    table = methods.compare(observations, carrier=carrier, methods=("evangelista2023", "refine_corners"))
    costs = [row.answer.cost for row in table.rows if row.answer is not None]
    assert costs[0] == pytest.approx(costs[1], rel=1e-4)


def test_corners_that_a_problem_holds_are_solved_beside_methods_on_poses() -> None:
    observations, _, Y = seen(0.3, 4)
    problem = problem_of(dataclasses.replace(observations, corner_px=0.3))
    found = compare(problem, methods=("tabb2017_rp1", "evangelista2023", "certified"))
    answers = {row.method.name: row.estimate for row in found.rows}
    by_itself = methods.run("tabb2017_rp1", observations)
    for name, pose in by_itself.Y.items():
        estimate = answers["tabb2017_rp1"]
        assert estimate is not None
        assert frame_distance(estimate.Y[name].matrix(), pose.matrix()).translation_m < 1e-6
        assert "px rms by the measured A" in estimate.notes[0]
    errors = {
        name: frame_distance(estimate.Y["left"].matrix(), Y["left"]).translation_m
        for name, estimate in answers.items()
        if estimate is not None
    }
    assert set(errors) == {"tabb2017_rp1", "evangelista2023", "certified"}
    assert max(errors.values()) < 0.01
    problem.add("board", "left", np.eye(4)[None], np.eye(4)[None])
    with pytest.raises(CountError, match="measurements without corners"):
        run("tabb2017_rp1", problem)


def test_corners_know_more_than_the_poses_that_they_give() -> None:
    """Small, nearly frontal tags have poor poses, with two candidates; their corners weigh what they should."""
    by_corners, by_poses = [], []
    for seed in range(4):
        observations, _, Y = seen(0.5, 10 + seed)
        answer = methods.run("tabb2017_rp1", observations)
        poses = run("wang2022", _one_target(observations).poses())
        by_corners.append(frame_distance(answer.Y["left"].matrix(), Y["left"]).translation_m)
        by_poses.append(frame_distance(poses.Y["left"].matrix(), Y["left"]).translation_m)
    assert np.mean(by_corners) < np.mean(by_poses)


def _one_target(observations: Observations) -> Observations:
    views = {pair: view for pair, view in observations.views.items() if pair[0] == "board"}
    return dataclasses.replace(observations, views=views)


def test_a_tilted_board_frame_changes_nothing() -> None:
    """Corners need not have z = 0, only lie in a plane."""
    observations, X, _ = seen(0.0, 5)
    tilt = se3.expmap(np.array([[0.3, -0.4, 0.2, 0.1, 0.2, 0.3]]))[0]
    corners = {**observations.corners, "board": GRID @ tilt[:3, :3].T + tilt[:3, 3]}
    answer = methods.run("tabb2017_rp1", dataclasses.replace(observations, corners=corners))
    np.testing.assert_allclose(answer.X["board"].matrix() @ tilt, X["board"], atol=1e-7)


def test_what_cannot_be_observed_is_refused_in_words() -> None:
    A = np.tile(np.eye(4), (3, 1, 1))
    pixels = np.zeros((3, 4, 2))
    square = {"tag": SQUARE}
    with pytest.raises(NoiseError, match="corner_px"):
        Observations.of(CAMERAS, square, {("tag", "left"): (A, pixels)}, 0.0)
    with pytest.raises(FrameError, match="there is no camera middle; give"):
        Observations.of(CAMERAS, square, {("tag", "middle"): (A, pixels)})
    with pytest.raises(FrameError, match="there are no corners of board; give its board in corners"):
        Observations.of(CAMERAS, square, {("board", "left"): (A, pixels)})
    with pytest.raises(CountError, match=r"\(3, 4, 2\)"):
        Observations.of(CAMERAS, square, {("tag", "left"): (A, pixels[:2])})
    with pytest.raises(CountError, match="no views"):
        Observations.of(CAMERAS, square, {})
    larger = pixels + np.array([2.0 * CAMERAS["left"].width, 10.0])
    with pytest.raises(CameraError, match=r"corner 0 of image 0 is at .* outside images of .* of another size than"):
        Observations.of(CAMERAS, square, {("tag", "left"): (A, larger)})
    hidden = pixels.copy()
    hidden[1, 0] = np.nan
    with pytest.raises(CountError, match="3 corners"):
        Observations.of(CAMERAS, square, {("tag", "left"): (A, hidden)})
    with pytest.raises(TargetError, match="tag"):
        Observations.of(CAMERAS, {"tag": SQUARE[:3]}, {("tag", "left"): (A, pixels)})
    observations, _, _ = seen(0.0, 6, images=5)
    bent = {**observations.corners, "board": GRID + [[0.0, 0.0, 0.01 * (k % 2)] for k in range(30)]}
    with pytest.raises(TargetError, match="do not lie in one plane"):
        methods.run("tabb2017_rp1", dataclasses.replace(observations, corners=bent))


def test_starts_and_names_that_cannot_be_are_refused_in_words() -> None:
    observations, X, Y = seen(0.0, 6, images=5)
    turned = {name: T @ np.diag([1.0, -1.0, -1.0, 1.0]) for name, T in Y.items()}
    behind = MethodOptions(start=(X, turned, 1.0))
    with pytest.raises(CameraError, match="behind"):
        methods.run("tabb2017_rp1", observations, behind)
    rows = methods.compare(observations, behind).rows
    assert all(row.answer is None and "behind" in str(row.error) for row in rows)
    with pytest.raises(FrameError, match="right"):
        methods.run("tabb2017_rp1", observations, MethodOptions(start=(X, {"left": Y["left"]}, 1.0)))
    for call in (methods.run, lambda name, given: methods.compare(given, methods=[name])):
        with pytest.raises(OptionError, match="'levmar' is not one of evangelista2023"):
            call("levmar", observations)  # type: ignore[no-untyped-call]
    with pytest.raises(OptionError, match="Observations"):
        methods.run("tabb2017_rp1", None)  # type: ignore[arg-type]
