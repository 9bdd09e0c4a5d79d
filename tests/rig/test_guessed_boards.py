"""Boards guessed from images: sizes of lattices, columns and rows of tags; nothing where there is no such board."""

from __future__ import annotations

import numpy as np
import pytest
from rendered import pose, printed, render

from gtsam_rwhec.cameras import AprilGrid, Camera, Charuco
from gtsam_rwhec.cameras.targets import Checkerboard, CircleGrid, TagGrid, Target
from gtsam_rwhec.detect.circle_lattices import NONE, Ellipses
from gtsam_rwhec.detect.tags import SeenTag
from gtsam_rwhec.rig.guessed_boards import BoardSeen, boards_seen, lattice_size, rectangle, shifted_rows
from gtsam_rwhec.rig.guessed_targets import Kind, boards_guessed, layout_of
from gtsam_rwhec.rig.log_contents import ImageTopic


def seen(points: np.ndarray, tilt: float = 0.0) -> np.ndarray:
    depth = 1.0 + tilt * (points[:, :1] + 0.5 * points[:, 1:]) / np.ptp(points[:, 0])
    return 100.0 + 40.0 * points @ np.array([[0.9, 0.4], [-0.4, 0.9]]) / depth


def circles(points: np.ndarray, tilt: float = 0.0, radius: float = 0.25) -> Ellipses:
    """Circles of a plane in perspective."""
    corners = [(seen(points + step, tilt) - seen(points - step, tilt)) / 2e-3 for step in 1e-3 * np.eye(2)]
    J = radius * np.stack(corners, axis=2)
    return Ellipses(seen(points, tilt), J @ J.transpose(0, 2, 1))


def lattice(columns: int, rows: int) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(columns, dtype=float), np.arange(rows)), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize(("columns", "rows", "tilt"), [(10, 10, 0.0), (10, 10, 0.8), (7, 4, 1.0), (3, 9, 0.3)])
def test_rows_and_columns(columns: int, rows: int, tilt: float) -> None:
    of_board = circles(lattice(columns, rows), tilt)
    of_board.shapes[0] *= 1.6**2
    far = np.random.default_rng(1).uniform(900, 1200, size=(6, 2))
    others = Ellipses(far, np.tile(25.0 * np.eye(2), (6, 1, 1)))
    found = lattice_size(of_board.with_more(others), rectangle)
    assert found is not None
    assert sorted(found) == sorted((columns, rows))


def test_no_whole_lattice() -> None:
    assert lattice_size(NONE, rectangle) is None
    points = np.random.default_rng(2).uniform(0, 10, size=(40, 2))
    found = lattice_size(circles(points), rectangle)
    assert found is None or min(found) < 3
    assert lattice_size(circles(np.delete(lattice(6, 5), 7, axis=0)), rectangle) is None  # one is missing


@pytest.mark.parametrize(("columns", "rows", "tilt"), [(4, 11, 0.0), (4, 11, 0.5), (5, 7, 0.3)])
def test_rows_that_are_shifted_in_turn(columns: int, rows: int, tilt: float) -> None:
    points = np.array([(2 * x + y % 2, y) for y in range(rows) for x in range(columns)], dtype=float)
    assert lattice_size(circles(points, tilt), shifted_rows) == (columns, rows)
    assert lattice_size(circles(points, tilt), rectangle) is None
    assert lattice_size(circles(lattice(6, 5)), shifted_rows) is None


CAMERA = Camera.of(480, 360, "pinhole", [[500.0, 0, 240], [0, 500.0, 180], [0, 0, 1]], (), "a test")
POSES = [((10.0, -20.0, 8.0), (0.01, 0.0, 0.36)), ((-25.0, 15.0, -20.0), (0.0, 0.01, 0.4))]


def images(target: Target) -> list[np.ndarray]:
    return [render(CAMERA, [(printed(target), pose(*at))], seed=i) for i, at in enumerate(POSES)]


@pytest.mark.parametrize(
    ("target", "counts"),
    [
        (Checkerboard("board", 6, 8, 0.022), (8, 6)),
        (CircleGrid("grid", 7, 5, 0.03), (7, 5)),
        (CircleGrid("grid", 4, 9, 0.02, asymmetric=True), (4, 9)),
        (Charuco("board", "aruco_5x5_100", 7, 5, 0.04, 0.03), None),
    ],
    ids=["checkerboard", "circles", "asymmetric", "charuco"],
)
def test_the_board_and_nothing_else(target: Target, counts: tuple[int, int] | None) -> None:
    found = boards_seen(images(target))
    assert [seen.counts for seen in found] == ([] if counts is None else [counts])
    for seen in found:
        assert type(seen.board) is type(target)
        assert getattr(seen.board, "asymmetric", False) == getattr(target, "asymmetric", False)
        assert seen.images == (0, 1)


KINDS: tuple[Kind, ...] = ("charuco", "tag_grid")
SQUARE = 0.5 * np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])


def charuco(columns: int, rows: int, share: float) -> np.ndarray:
    """Corners (n, 4, 2) of the markers, y up."""
    squares = [(x, -y) for y in range(rows) for x in range(columns) if (x + y) % 2 == 1]
    return np.array(squares, dtype=float)[:, None] + share * SQUARE


def views(
    corners: np.ndarray, first: int = 0, number: int = 4, lost: int = 0, noise: float = 0.2
) -> list[list[SeenTag]]:
    """What images from several sides see of tags with these corners (n, 4, 2)."""
    rng = np.random.default_rng(1)
    middle, size = corners.reshape(-1, 2).mean(axis=0), np.ptp(corners.reshape(-1, 2), axis=0).max()
    found = []
    for k in range(number):
        turn = 0.4 * k
        plane = (corners - middle) / size @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        depth = 1.0 + 0.3 * plane[..., :1] * (-1) ** k + 0.2 * plane[..., 1:]
        px = 320.0 + 300.0 * plane * [1.0, -1.0] / depth + noise * rng.normal(size=plane.shape)  # y down in images
        kept = np.sort(rng.permutation(len(px))[lost:])
        found.append([
            SeenTag("f", first + int(i), False, px[i].mean(axis=0), float(np.linalg.norm(px[i, 0] - px[i, 1])), px[i])
            for i in kept
        ])  # fmt: skip
    return found


@pytest.mark.parametrize(("columns", "rows"), [(7, 5), (5, 7), (6, 6), (8, 11), (4, 9)])
def test_a_charuco_board(columns: int, rows: int) -> None:
    corners = charuco(columns, rows, 0.75)
    ids = range(20, 20 + len(corners))
    found = layout_of(KINDS, ids, views(corners, first=20, lost=3))
    assert found is not None
    assert (found.kind, found.columns, found.rows) == ("charuco", columns, rows)
    assert found.share == pytest.approx(0.75, rel=0.02)


@pytest.mark.parametrize(("columns", "rows"), [(6, 6), (4, 3), (5, 7)])
def test_grids_count_from_the_top_or_from_the_bottom(columns: int, rows: int) -> None:
    april = AprilGrid("grid", "tag36h11", columns, rows, 0.088, 0.3).corners()[:, :2].reshape(-1, 4, 2)
    grid = TagGrid("grid", "tag36h11", columns, rows, 0.04, 0.01).corners()[:, :2].reshape(-1, 4, 2)
    ids = range(columns * rows)
    for corners, kind, share in ((april, "aprilgrid", 1 / 1.3), (grid, "tag_grid", 0.8)):
        found = layout_of(("aprilgrid", "tag_grid"), ids, views(corners))
        assert found is not None
        assert (found.kind, found.columns, found.rows) == (kind, columns, rows)
        assert found.share == pytest.approx(share, rel=0.02)


def test_tags_in_the_room_are_no_board() -> None:
    rng = np.random.default_rng(3)
    corners = 10.0 * rng.uniform(size=(12, 1, 2)) + SQUARE
    assert layout_of(KINDS, range(12), views(corners)) is None
    assert layout_of(KINDS, range(35 // 2), views(charuco(7, 5, 0.75), number=1)) is None  # one image
    assert layout_of(KINDS, range(35 // 2), views(charuco(7, 5, 0.75), lost=12)) is None  # too few tags in each


def test_a_charuco_board_is_no_checkerboard_too() -> None:
    """Its inner corners are a checkerboard's, with markers between them."""
    board = Checkerboard("board", 6, 4, 1.0)
    lattice = 100.0 + 50.0 * np.stack(np.meshgrid(np.arange(6.0), np.arange(4.0)), axis=-1).reshape(-1, 2)
    corners = [lattice + 10.0 * k for k in range(4)]
    images = BoardSeen(board, tuple(range(4)), tuple(corners), (np.arange(24),) * 4)

    def tags(beside_px: float) -> list[list[SeenTag]]:
        middles = [np.array([125.0 + 100.0 * i + beside_px, 125.0 + 10.0 * k]) for k in range(4) for i in range(2)]
        every = [SeenTag("aruco_5x5_1000", i, False, at, 30.0, at + 30.0 * SQUARE) for i, at in enumerate(middles)]
        return [every[2 * k : 2 * k + 2] for k in range(4)]

    topic = ImageTopic("/image", "sensor_msgs/msg/Image", 4, looked_at=4, seen=tags(0.0))
    topic.boards = [images]
    assert boards_guessed([topic]) == []
    topic.seen = tags(1000.0)  # tags beside a checkerboard
    (guess,) = boards_guessed([topic])
    assert guess.section.type == "checkerboard"
