"""Boards that look the same turned: the motion tells which way up they are, between images and between sensors."""

from __future__ import annotations

import numpy as np
import pytest
from rendered import PINHOLE, pose, printed, projected, render
from rwhec_factors import se3

from gtsam_rwhec.cameras.board_turns import Turns, choose_turns, turn_between, turns_about_z
from gtsam_rwhec.cameras.target_poses import plane_poses
from gtsam_rwhec.cameras.targets import Checkerboard
from gtsam_rwhec.detect.detections import turned_detection
from gtsam_rwhec.detect.detector import Detector

HALF, QUARTERS = Checkerboard("half", 5, 3, 0.03), Checkerboard("quarters", 4, 4, 0.03)
SIGMA_PX = 0.1
X = se3.expmap(np.random.default_rng(42).normal(size=(1, 6)))[0]


def turned(seed: int, board: Checkerboard, *, n: int = 30, axes: int = 3) -> tuple[Turns, np.ndarray]:
    """The turns that are chosen for a track of boards that were read in any of their ways, and the ways (n,)."""
    generator = np.random.default_rng(seed)
    twist = np.zeros((n, 6))
    twist[:, 3 - axes : 3] = generator.uniform(-0.6, 0.6, (n, axes))
    twist[:, 3:] = generator.uniform(-0.05, 0.05, (n, 3))
    B = pose((0, 0, 0), (0, 0, 0.4)) @ se3.expmap(twist) if axes else np.tile(pose((30, 0, 0), (0, 0, 0.4)), (n, 1, 1))
    Y = se3.expmap(generator.normal(size=(1, 6)))[0]
    A = Y @ B @ np.linalg.inv(X) @ se3.expmap(generator.normal(scale=0.005, size=(n, 6)))
    ways = generator.integers(0, board.ways, n)
    R = np.tile(np.eye(4), (n, 1, 1))
    R[:, :3, :3] = turns_about_z(board.ways)[ways]
    pixels = [
        projected(PINHOLE, board.corners(), T) + generator.normal(scale=SIGMA_PX, size=(len(board.corners()), 2))
        for T in B @ R
    ]
    seen = plane_poses(PINHOLE, [board.corners()] * n, pixels, corner_px=SIGMA_PX)
    return choose_turns(seen.T, seen.covariance, seen.squared_px, SIGMA_PX, A, board.ways), ways


@pytest.mark.parametrize("board", [HALF, QUARTERS], ids=lambda board: board.name)
@pytest.mark.parametrize("seed", range(4))
def test_the_motion_tells_the_turns(board: Checkerboard, seed: int) -> None:
    turns, ways = turned(seed, board)
    # As read they are `ways` off; chosen, all are as the first.
    assert ((turns.which + ways - ways[0]) % board.ways == 0).all()
    assert turns.margin.min() > 3.0


@pytest.mark.parametrize("board", [HALF, QUARTERS], ids=lambda board: board.name)
def test_two_sensors_get_one_frame_of_the_board(board: Checkerboard) -> None:
    for seed in range(4):
        (first, of_first), (second, of_second) = turned(seed, board), turned(seed + 10, board)
        more, margin = turn_between(first, second, board.ways)
        assert (of_second[0] + more - of_first[0]) % board.ways == 0
        assert margin > 3.0


def test_what_the_motion_does_not_tell_is_not_sure() -> None:
    # Turns about the board's own normal leave the other sensor's frame free; few images leave all free.
    first, second = (turned(seed, HALF, axes=1)[0] for seed in (0, 1))
    assert first.margin.min() > 3.0
    assert turn_between(first, second, HALF.ways)[1] < 3.0
    few, _ = turned(0, HALF, n=4)
    assert few.margin.tolist() == [0.0] * 4
    assert turn_between(first, few, HALF.ways) == (0, 0.0)


def test_images_without_the_carriers_pose_are_not_sure() -> None:
    B = np.tile(pose((10, 0, 0), (0, 0, 0.4)), (6, 2, 1, 1))
    turns = choose_turns(B, np.tile(np.eye(6), (6, 2, 1, 1)), np.ones((6, 2)), 1.0, np.full((6, 4, 4), np.nan), 2)
    assert turns.margin.tolist() == [0.0] * 6


@pytest.mark.parametrize(
    ("board", "turn"), [(HALF, 1), (QUARTERS, 1), (QUARTERS, 2), (QUARTERS, 3)], ids=lambda value: str(value)[:20]
)
def test_a_turned_detection_has_the_pose_of_its_corners(board: Checkerboard, turn: int) -> None:
    (frame,) = Detector(PINHOLE, [board])([render(PINHOLE, [(printed(board), pose((20, 10, 5), (0, 0, 0.35)))])])
    (seen,) = frame.detections
    assert seen.rejection is None
    again = turned_detection(seen, board, turn)
    assert again.indices.tolist() == list(range(len(board.corners())))
    poses = plane_poses(PINHOLE, [board.corners()[again.indices]], [again.corners_px], corner_px=0.1)
    np.testing.assert_allclose(again.T[0], poses.T[0, 0], atol=1e-6)
    np.testing.assert_allclose(again.covariance[0], poses.covariance[0, 0], rtol=1e-3, atol=1e-12)
    assert turned_detection(seen, board, 0) is seen


@pytest.mark.parametrize(("columns", "rows", "ways"), [(5, 4, 1), (5, 3, 2), (6, 4, 2), (3, 3, 2), (4, 4, 4)])
def test_a_board_looks_the_same_in_as_many_ways_as_its_corners_say(columns: int, rows: int, ways: int) -> None:
    board = Checkerboard("board", columns, rows, 0.03)
    squares = np.indices((rows + 1, columns + 1)).sum(axis=0) % 2
    same = sum(np.array_equal(squares, np.rot90(squares, k)) for k in range(4))
    assert board.ways == ways == same
