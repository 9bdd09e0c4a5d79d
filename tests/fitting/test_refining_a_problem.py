"""``rw.refine`` from the corners of a problem: what ``refine_corners`` finds, in the form of every refinement."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from problems_of_corners import problem_of
from rwhec_factors import se3
from simulated_cells import Cell, cell, moving

import gtsam_rwhec as rw
from gtsam_rwhec.errors import CountError, MeasurementsNotKeptError, OptionError
from gtsam_rwhec.fitting.corner_residuals import stacks_of
from gtsam_rwhec.geometry.trajectory import Trajectory

#: Covariances of poses are those of corners alone: the noise of A is more.
pytestmark = pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.WeightsWarning")

CORNERS = rw.RefineOptions(observations="corners")
CALIBRATION = rw.CornerOptions(stated="calibration")


@cache
def made() -> tuple[Cell, rw.Problem, rw.Solution, rw.Refined]:
    """A cell, its problem and certified solution, and the refinement from corners."""
    given = cell(5, images=20, stated="calibration", carrier=(5e-4, 2e-4))
    problem = problem_of(given.observations)
    solution = rw.solve(problem)
    return given, problem, solution, rw.refine(problem, solution, CORNERS, corners=CALIBRATION)


def test_the_answer_is_that_of_refine_corners_on_the_same_images() -> None:
    given, problem, solution, refined = made()
    base = rw.refine(problem, solution)
    observations = rw.fitting.observations_of(problem)
    for pair, view in given.observations.views.items():
        np.testing.assert_array_equal(observations.views[pair].pixels, view.pixels)
    expected = rw.refine_corners(given.observations, base.X, base.Y, CALIBRATION)
    for found, wanted in ((refined.X, expected.X), (refined.Y, expected.Y)):
        assert found.keys() == wanted.keys()
        for name, pose in found.items():
            np.testing.assert_allclose(pose.matrix(), wanted[name].matrix(), atol=1e-10)
    names = ("board", "cam_1", "intrinsics:cam_0")
    np.testing.assert_allclose(refined.covariance(*names), expected.covariance(*names), rtol=1e-6, atol=1e-20)
    assert refined.reprojection is not None
    assert refined.reprojection.corner_px == pytest.approx(expected.noise.corner_px)
    assert refined.reprojection.sensors["cam_0"].images == len(given.observations.views["board", "cam_0"].A)
    assert refined.intrinsics["cam_0"].stated_as == "calibration"
    assert refined.options == CORNERS
    for name, truth in (given.X | given.Y).items():
        assert refined.contains(name, truth, 0.999)


def test_the_order_of_samples_does_not_matter() -> None:
    given, _, _, refined = made()
    rng = np.random.default_rng(0)
    orders = {pair: rng.permutation(len(view.A)) for pair, view in given.observations.views.items()}
    shuffled = rw.Observations(
        given.observations.cameras,
        given.observations.corners,
        {pair: view.selected(orders[pair]) for pair, view in reversed(given.observations.views.items())},
    )
    problem = problem_of(shuffled)
    again = rw.refine(problem, rw.solve(problem), CORNERS, corners=CALIBRATION)
    for name in ("cam_0", "cam_1"):
        between = refined.Y[name].between(again.Y[name])
        assert np.abs(np.r_[between.rotation().matrix() - np.eye(3), [between.translation()]]).max() < 1e-7


def test_images_that_contradict_the_others_are_left_out_first() -> None:
    given, problem, _, _ = made()
    pair = rw.Pair("board", "cam_0")
    raw = problem.measurements(*pair)
    assert raw.pixels is not None
    wrong = rw.Problem()
    for (target, sensor), view in given.observations.views.items():
        A = view.A.copy()
        if sensor == "cam_0":
            A[2:4] = A[[8, 9]]  # of other instants
        board, camera = given.observations.corners[target], given.observations.cameras[sensor]
        wrong.add_corners(target, sensor, A, view.pixels, board, camera)
    options = rw.RefineOptions(observations="corners", noise="estimate", robust="gnc")
    refined = rw.refine(wrong, None, options, corners=CALIBRATION)
    np.testing.assert_array_equal(np.flatnonzero(~refined.inliers[pair]), [2, 3])
    assert refined.reprojection is not None
    assert refined.reprojection.sensors["cam_0"].images == len(raw.A) - 2
    for name, truth in (given.X | given.Y).items():
        assert refined.contains(name, truth, 0.999)


def test_a_target_of_unknown_size_is_found_by_its_corners_too() -> None:
    given, _, _, _ = made()
    problem = rw.Problem("per_target")
    for (target, sensor), view in given.observations.views.items():
        board, camera = 1.6 * given.observations.corners[target], given.observations.cameras[sensor]
        problem.add_corners(target, sensor, view.A, view.pixels, board, camera)
    refined = rw.refine(problem, rw.solve(problem), CORNERS, corners=CALIBRATION)
    assert isinstance(refined.scale, dict)
    sigma = float(np.sqrt(refined.covariance("scale:board")[0, 0]))
    assert abs(refined.scale["board"] - 1.6) < 4.0 * sigma < 0.02
    assert refined.reprojection is not None
    board = refined.reprojection.boards["board"]
    assert board.values[0] == pytest.approx(1.0 / refined.scale["board"] - 1.0)
    assert board.standard_deviations[0] == pytest.approx(sigma / refined.scale["board"] ** 2)
    problem.fix_scale("board", 1.6)
    known = rw.refine(problem, rw.solve(problem), CORNERS, corners=CALIBRATION)
    assert known.scale == {"board": 1.6}
    assert known.reprojection is not None
    assert known.reprojection.boards == {}
    for answer in (refined, known):
        for name, truth in (given.X | given.Y).items():
            assert answer.contains(name, truth, 0.999)


def test_what_cannot_be_refined_from_corners_is_said() -> None:
    given, problem, solution, _ = made()
    view = given.observations.views["board", "cam_0"]
    poses = given.observations.poses()
    with pytest.raises(CountError, match=r"no corners; add images with problem\.add_corners"):
        rw.refine(poses, rw.solve(poses), CORNERS)
    some = problem + rw.Problem()
    some.add("board", "cam_0", view.A[:2], poses.measurements("board", "cam_0").B[:2], 1e-3, 1e5)
    number = len(view.A) + 2
    with pytest.raises(CountError, match=rf"without corners: board-cam_0 \(2 of {number}\)"):
        rw.refine(some, solution, CORNERS)
    fixed = problem + rw.Problem()
    fixed.fix("cam_0", given.Y["cam_0"])
    with pytest.raises(OptionError, match="does not hold the fixed pose of cam_0"):
        rw.refine(fixed, rw.solve(fixed), CORNERS)
    with pytest.raises(OptionError, match="corners= has no use"):
        rw.refine(problem, solution, corners=CALIBRATION)
    with pytest.raises(OptionError, match="are not CornerOptions"):
        rw.refine(problem, solution, CORNERS, corners="calibration")  # type: ignore[arg-type]
    with pytest.raises(OptionError, match=r"observations='pixels' is not one of 'poses', 'corners'"):
        rw.RefineOptions(observations="pixels")  # type: ignore[arg-type]
    moments = problem + rw.Problem(keep_measurements=False)
    moments.add("board", "cam_0", view.A[:2], poses.measurements("board", "cam_0").B[:2], 1e-3, 1e5)
    with pytest.raises(MeasurementsNotKeptError, match="corners"):
        rw.refine(moments, solution, CORNERS)


def test_clocks_are_unknowns_of_the_corners_too() -> None:
    given, late_s = cell(8, images=16, stated="calibration"), {"cam_0": 0.03, "cam_1": -0.012}
    moved = moving(given, 1, late_s)
    stacks, A = stacks_of(given.observations)
    at_ns = 10_000_000_000 * (1 + np.arange(len(A)))
    twist, near_s = np.zeros((len(A), 6)), 0.05 * np.arange(-6, 7)
    problem = rw.Problem()
    for stack in stacks:
        view, sensor = moved.observations.views[stack.targets[0], stack.sensor], stack.sensor
        assert view.twist is not None
        twist[stack.instant] = view.twist
        stamps = at_ns[stack.instant] - round(1e9 * late_s[sensor])
        camera = given.observations.cameras[sensor]
        problem.add_corners(stack.targets[0], sensor, view.A, view.pixels, stack.points[0], camera, stamps_ns=stamps)
    steps = np.einsum("k,ni->nki", near_s, twist).reshape(-1, 6)
    poses = np.repeat(A, len(near_s), axis=0) @ se3.expmap(steps)
    path = Trajectory.of((at_ns[:, None] + np.round(1e9 * near_s).astype(int)).ravel(), poses, "the arm")
    options = rw.RefineOptions(observations="corners", time_offsets=True, carrier_path=path)
    refined = rw.refine(problem, rw.solve(problem), options, corners=CALIBRATION)
    for sensor, offset_s in late_s.items():
        sigma = float(np.sqrt(refined.covariance(f"time_offset:{sensor}")[0, 0]))
        assert abs(refined.time_offsets_s[sensor] - offset_s) < 4.0 * sigma < 4e-3
        assert refined.contains(sensor, given.Y[sensor], 0.999)
