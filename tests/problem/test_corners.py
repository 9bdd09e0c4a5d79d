"""Corners in a problem: every form that users have gives the same measurements; what is wrong is refused in words."""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.misreadings import misreadings
from gtsam_rwhec.errors import (
    CameraError,
    CountError,
    FrameError,
    MeasurementsNotKeptError,
    NoiseError,
    PoseError,
    RwhecError,
    TargetError,
    UnitsWarning,
    WeightsWarning,
)
from gtsam_rwhec.problem.selection import nearer_poses, selected
from gtsam_rwhec.solver.solution import contradicted_by

Array = NDArray[np.float64]
CAMERA = rw.Camera.of(1280, 960, "radtan", [[900, 0, 640], [0, 900, 480], [0, 0, 1]], [-0.1, 0.02, 0, 0], "test")
BOARD = rw.cameras.Checkerboard("board", 6, 4, 0.03).corners()
X = se3.expmap(np.array([[0.1, 0.2, -0.3, 0.05, 0.02, 0.1]]))[0]
Y = se3.expmap(np.array([[-0.4, 0.1, 0.2, 0.3, -0.1, 0.2]]))[0]


def images(count: int = 16, seed: int = 0, noise_px: float = 0.05, depth_m: float = 0.5) -> tuple[Array, Array, Array]:
    """A, B and pixels of a board before a camera."""
    rng = np.random.default_rng(seed)
    turn = rng.normal(scale=0.35, size=(count, 3)) + np.array([np.pi, 0.0, 0.0])
    at = rng.normal(scale=[0.04, 0.03, 0.05], size=(count, 3)) + np.array([0.0, 0.0, depth_m])
    B = se3.pose(se3.expmap(np.c_[turn, np.zeros((count, 3))])[:, :3, :3], at)
    pixels = CAMERA.project(BOARD @ B[:, :3, :3].transpose(0, 2, 1) + B[:, None, :3, 3])
    assert np.isfinite(pixels).all()
    return Y @ B @ se3.inverse(X), B, pixels + rng.normal(scale=noise_px, size=pixels.shape)


def problem_of(A: Array, pixels: Any, board: Any = BOARD, **more: Any) -> rw.Problem:
    problem = rw.Problem()
    problem.add_corners("board", "cam", A, pixels, board, CAMERA, **more)
    return problem


def test_each_image_is_a_measurement_of_its_pose_with_its_covariance() -> None:
    A, B, pixels = images()
    problem = problem_of(A, pixels, corner_px=0.05)
    raw = problem.measurements("board", "cam")
    np.testing.assert_array_equal(raw.A, A)
    assert raw.pixels is not None
    assert raw.covariances is not None
    np.testing.assert_array_equal(raw.pixels, pixels)
    xi = se3.logmap(se3.inverse(raw.B) @ B)
    squared = np.einsum("ni,nij,nj->n", xi, np.linalg.inv(raw.covariances), xi)
    assert 3.0 < squared.mean() < 10.0  # six degrees of freedom
    assert not problem.is_relative
    assert problem.has_covariances
    solution = rw.solve(problem)
    assert solution.certificate.is_certified
    np.testing.assert_allclose(solution.X["board"].matrix(), X, atol=2e-3)


def test_all_forms_of_corners_are_the_same_measurements() -> None:
    A, _, pixels = images()
    pixels[::3, :7] = np.nan
    expected = problem_of(A, pixels).measurements("board", "cam")
    seen = [np.flatnonzero(np.isfinite(view[:, 0])) for view in pixels]
    shuffled = [np.random.default_rng(1).permutation(ids) for ids in seen]
    lists = [view[ids] for view, ids in zip(pixels, shuffled, strict=True)]
    forms = [
        problem_of(A, list(pixels)),
        problem_of(A, lists, corner_ids=shuffled),
        problem_of(A, [view[:, None] for view in lists], corner_ids=[ids[:, None] for ids in shuffled]),
    ]
    for problem in forms:
        found = problem.measurements("board", "cam")
        np.testing.assert_array_equal(found.pixels, expected.pixels)
        np.testing.assert_array_equal(found.B, expected.B)
    # OpenCV's object points, in single precision: the board's order is that of the first image that has each corner
    points = [BOARD[ids].astype(np.float32) for ids in shuffled]
    by_points = problem_of(A, [view.astype(np.float32) for view in lists], points)
    assert len(by_points.boards["board"]) == len(BOARD)
    np.testing.assert_allclose(by_points.measurements("board", "cam").B, expected.B, atol=1e-4)
    known = rw.Problem()
    known.add_corners("board", "cam", A, pixels, BOARD, CAMERA)
    known.add_corners("board", "cam", A, lists, points)
    np.testing.assert_array_equal(known.boards["board"], BOARD)
    np.testing.assert_array_equal(known.measurements("board", "cam").pixels, np.concatenate([pixels, pixels]))


def longer(T: Array) -> Array:
    """Poses in half the unit."""
    return T * np.r_["-1,2,0", np.ones((4, 3)), [2.0, 2.0, 2.0, 1.0]]


def test_lengths_in_another_unit_are_measurements_in_that_unit() -> None:
    A, _, pixels = images(12)
    once, twice = problem_of(A, pixels), problem_of(longer(A), pixels, 2.0 * BOARD)
    metres, halves = (problem.measurements("board", "cam") for problem in (once, twice))
    np.testing.assert_allclose(halves.B, longer(metres.B), atol=1e-7)
    unit = np.repeat([1.0, 2.0], 3)
    assert metres.covariances is not None
    np.testing.assert_allclose(halves.covariances, metres.covariances * np.outer(unit, unit), rtol=1e-4, atol=1e-12)


def test_batches_selections_and_sums_keep_corners_beside_their_measurements() -> None:
    A, _, pixels = images(20)
    problem = problem_of(A[:12], pixels[:12])
    problem.add_corners("board", "cam", A[12:], pixels[12:])
    keep = np.arange(20) % 3 > 0
    kept = selected(problem, {("board", "cam"): keep})
    np.testing.assert_array_equal(kept.measurements("board", "cam").pixels, pixels[keep])
    assert kept.cameras == problem.cameras
    assert kept.corner_px == problem.corner_px
    both = problem_of(A[:12], pixels[:12]) + problem_of(A[12:], pixels[12:])
    np.testing.assert_array_equal(both.measurements("board", "cam").pixels, pixels)
    problem.add("board", "cam", A[:1], problem.measurements("board", "cam").B[:1], 1e-3, 1e4)
    joined = problem.measurements("board", "cam").pixels
    assert joined is not None
    assert np.isnan(joined[20]).all()
    assert np.isfinite(joined[:20]).all()
    problem.add("other", "cam", A, A, 1e-3, 1e4)
    without = problem.with_measurements({pair: problem.measurements(*pair) for pair in [rw.Pair("other", "cam")]})
    assert not without.boards
    assert set(without.cameras) == {"cam"}


def test_a_far_board_takes_the_poses_that_agree_with_the_carriers() -> None:
    A, B, pixels = images(24, seed=2, noise_px=0.4, depth_m=4.0)
    problem = problem_of(A, pixels, corner_px=0.4)
    off = se3.logmap(se3.inverse(problem.measurements("board", "cam").B) @ B)[:, :3]
    alone = rw.Observations.of({"cam": CAMERA}, {"board": BOARD}, {("board", "cam"): (A, pixels)}, 0.4).poses()
    off_alone = se3.logmap(se3.inverse(alone.measurements("board", "cam").B) @ B)[:, :3]
    assert (np.linalg.norm(off_alone, axis=1) > 0.25).any()
    assert not (np.linalg.norm(off, axis=1) > 0.25).any()
    # an answer corrects what single images chose
    one_by_one = rw.Problem()
    for pose, view in zip(A, pixels, strict=True):
        one_by_one.add_corners("board", "cam", pose[None], view[None], BOARD, CAMERA, corner_px=0.4)
    solution = rw.solve(problem)
    corrected, number = nearer_poses(one_by_one, solution.X, solution.Y)
    assert number > 3
    found, expected = (one.measurements("board", "cam") for one in (corrected, problem))
    np.testing.assert_allclose(found.B, expected.B, atol=1e-6)
    np.testing.assert_allclose(found.kappa, expected.kappa, rtol=1e-4)
    again, none = nearer_poses(problem, solution.X, solution.Y)
    assert none == 0
    assert again is problem


def test_a_target_need_not_be_flat() -> None:
    A, B, _ = images(12)
    box = BOARD + np.r_["-1,2,0", np.zeros((24, 2)), np.where(BOARD[:, :1] > 0.0, 0.05, 0.0)]
    pixels = CAMERA.project(box @ B[:, :3, :3].transpose(0, 2, 1) + B[:, None, :3, 3])
    np.testing.assert_allclose(problem_of(A, pixels, box).measurements("board", "cam").B, B, atol=1e-6)


def test_poses_by_other_intrinsics_take_the_place_of_all() -> None:
    A, B, pixels = images(8)
    stated = rw.Camera.of(1280, 960, "radtan", [[880, 0, 655], [0, 880, 470], [0, 0, 1]], CAMERA.D, "stated")
    problem = rw.Problem()
    problem.add_corners("board", "cam", A, pixels, BOARD, stated)
    off = np.linalg.norm(se3.logmap(se3.inverse(problem.measurements("board", "cam").B) @ B), axis=1)
    poses = ({"board": gtsam.Pose3(X)}, {"cam": gtsam.Pose3(Y)})
    better, _ = nearer_poses(problem, *poses, {"cam": CAMERA})
    np.testing.assert_array_less(
        np.linalg.norm(se3.logmap(se3.inverse(better.measurements("board", "cam").B) @ B), axis=1), 0.5 * off
    )
    assert better.cameras["cam"] is stated


def test_corners_in_millimetres_warn_as_poses_do() -> None:
    A, _, pixels = images()
    with pytest.warns(UnitsWarning, match=r"of B .* board_points: give these in metres, divided by 1000\. "):
        problem = problem_of(A, pixels, 1e3 * BOARD)
    (unit,) = misreadings(problem, None)
    assert "board_points are in millimetres" in unit.likely
    assert unit.cure == "give board_points in metres: divide them by 1000"


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.NotUniqueWarning")
def test_a_solution_from_corners_warns_of_images_only_where_no_arm_is_so_far_off() -> None:
    A, _, pixels = images(20)
    rng = np.random.default_rng(2)
    off = A @ se3.expmap(rng.normal(scale=np.repeat([2e-3, 1e-3], 3), size=(20, 6)))
    # an arm's errors: many times what corner_px explains
    with warnings.catch_warnings(action="error", category=WeightsWarning):
        solution = rw.solve(problem_of(off, pixels))
    ratio = contradicted_by(solution.cost, 6 * 20 - 12)
    assert ratio is not None
    assert ratio > 10.0
    with pytest.warns(WeightsWarning, match=r"corners of board-cam are off by .* A is inverted") as said:
        rw.solve(problem_of(se3.inverse(A), pixels))
    assert not any("sigma" in str(each.message) for each in said)


A16, _, P16 = images()
OTHER_SIZE = dataclasses.replace(CAMERA, width=640, height=480)
OTHER_K = rw.Camera.of(1280, 960, "pinhole", [[950, 0, 640], [0, 950, 480], [0, 0, 1]], [], "test")
LINE = np.c_[np.arange(24.0), np.zeros((24, 2))]
FEW = np.where(np.arange(24)[:, None] < 3, P16, np.nan)
WRONG: dict[str, tuple[type[RwhecError], str, dict[str, Any]]] = {
    "no board": (TargetError, "without a model of the board", {"board_points": None}),
    "board of 3": (TargetError, "has 3 corners", {"board_points": BOARD[:3]}),
    "board in a line": (TargetError, "on one line", {"board_points": LINE}),
    "corner twice on the board": (TargetError, "are one point", {"board_points": BOARD[[0, *range(23)]]}),
    "nan in the board": (TargetError, "finite: False", {"board_points": BOARD * np.nan}),
    "board as text": (CountError, "cannot be read as numbers", {"board_points": "board"}),
    "no camera": (CameraError, "camera is None; give cam intrinsics", {"camera": None}),
    "a matrix as camera": (CameraError, "camera is array", {"camera": CAMERA.K}),
    "images of another size": (CameraError, r"outside images of 640 x 480 .* another size", {"camera": OTHER_SIZE}),
    "rows and columns exchanged": (CameraError, "rows and columns", {"image_points": P16[..., ::-1] + [0, 400]}),
    "corners in another order": (TargetError, "do not belong", {"image_points": np.roll(P16, 5, axis=1)}),
    "three corners": (CountError, "image 0 has 3 corners", {"image_points": FEW}),
    "too few pixels": (CountError, "image 0 has 20 pixels for 24 corners", {"image_points": P16[:, :20]}),
    "infinite": (CountError, r"at \[inf", {"image_points": P16 * np.inf}),
    "flat pixels": (CountError, "image_points has shape", {"image_points": P16[0]}),
    "one number": (CountError, "is a float", {"image_points": 3.0}),
    "no images": (CountError, "no images", {"image_points": [], "A": A16[:0]}),
    "A too few": (CountError, "15 poses in A and 16 images", {"A": A16[:15]}),
    "ids too few": (CountError, "corner_ids has 2 images", {"corner_ids": [[0], [1]]}),
    "an id beyond": (CountError, "from 0 to 23", {"corner_ids": [np.arange(1, 25)] * 16}),
    "an id twice": (CountError, "corner 0 twice", {"corner_ids": [np.r_[0, np.arange(23)]] * 16}),
    "ids and points": (CountError, "give one", {"board_points": [BOARD] * 16, "corner_ids": [np.arange(24)] * 16}),
    "no pose": (PoseError, "A of board-cam", {"A": np.where(np.arange(16)[:, None, None] == 3, np.nan, A16)}),
    "noise of zero": (NoiseError, "corner_px is 0", {"corner_px": 0}),
    "one name": (FrameError, "names are unique", {"target": "cam"}),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_refused_and_nothing_is_added(name: str) -> None:
    error, words, changed = WRONG[name]
    given: dict[str, Any] = {
        "target": "board", "sensor": "cam", "A": A16, "image_points": P16, "board_points": BOARD, "camera": CAMERA,
    }  # fmt: skip
    problem = rw.Problem()
    with pytest.raises(error, match=words):
        problem.add_corners(**(given | changed))
    assert problem.pairs == ()
    assert not problem.boards
    assert not problem.cameras


def test_a_sensor_has_one_camera_and_a_target_one_board() -> None:
    problem = problem_of(A16, P16)
    with pytest.raises(CameraError, match="640 x 480 pixels, and cam had images of 1280 x 960"):
        problem.add_corners("board", "cam", A16, 0.5 * P16, camera=OTHER_SIZE)
    with pytest.raises(CameraError, match="had other intrinsics before"):
        problem.add_corners("board", "cam", A16, P16, camera=OTHER_K)
    with pytest.raises(TargetError, match="not those that the target had before"):
        problem.add_corners("board", "cam", A16, P16, 1.1 * BOARD)
    with pytest.raises(TargetError, match="is not on the board"):
        problem.add_corners("board", "cam", A16, list(P16), [BOARD + 0.001] * 16)
    with pytest.raises(NoiseError, match=r"it was 0\.1 before"):
        problem.add_corners("board", "cam", A16, P16, corner_px=0.2)
    with pytest.raises(TargetError, match="other board_points"):
        problem + problem_of(A16, P16, 1.1 * BOARD)
    assert problem.number_of_measurements == 16
    with pytest.raises(MeasurementsNotKeptError, match="keep_measurements=True"):
        rw.Problem(keep_measurements=False).add_corners("board", "cam", A16, P16, BOARD, CAMERA)


def test_a_corner_where_the_lens_folds_back_is_named() -> None:
    folded = rw.Camera.of(1280, 960, "radtan", CAMERA.K, [-0.6, 0, 0, 0], "test")
    pixels = P16.copy()
    pixels[4, 7] = [1279.0, 959.0]
    problem = rw.Problem()
    with pytest.raises(CameraError, match=r"no ray for corner 7 of image 4 at \(1279\.0, 959\.0\)"):
        problem.add_corners("board", "cam", A16, pixels, BOARD, folded)
