"""The places of targets' corners: one frame for all targets, and OpenCV's boards after a change of frame."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gtsam_rwhec.cameras.targets import (
    FAMILIES,
    AprilGrid,
    Bundle,
    BundleTag,
    Charuco,
    Checkerboard,
    CircleGrid,
    Tag,
    TagGrid,
    Target,
    family_named,
    is_same_print,
)
from gtsam_rwhec.detect.tags import dictionary, modules
from gtsam_rwhec.errors import TargetError

TAG = Tag("tag", "tag36h11", 3, 0.12)
BOARD = Charuco("board", "aruco_5x5_100", 7, 5, 0.04, 0.03)
GRID = AprilGrid("grid", "tag36h11", 6, 4, 0.088, 0.3, first_id=5)
CHESS = Checkerboard("chess", 8, 5, 0.03)


def from_opencvs(points: np.ndarray, width_m: float, height_m: float) -> np.ndarray:
    """T from the frame of OpenCV's boards: origin at the top left outer corner, y down, z into the paper."""
    return points * [1.0, -1.0, -1.0] + [-0.5 * width_m, 0.5 * height_m, 0.0]


@pytest.mark.parametrize("target", [TAG, BOARD, GRID, CHESS], ids=lambda target: target.name)
def test_the_origin_is_in_the_middle_of_the_plane(target: Target) -> None:
    corners = target.corners()
    assert corners.shape[1] == 3
    np.testing.assert_allclose(corners.mean(axis=0), 0.0, atol=1e-15)
    np.testing.assert_allclose(corners.min(axis=0), -corners.max(axis=0), atol=1e-15)
    assert not corners[:, 2].any()


def test_a_tags_corners_are_opencvs_for_ippe_square() -> None:
    # x to the right, y up, from the top left clockwise: SOLVEPNP_IPPE_SQUARE's order.
    np.testing.assert_allclose(TAG.corners()[:, :2], 0.06 * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]))
    assert TAG.ids == (3,)
    assert TAG.length_m == 0.12


def test_a_charuco_boards_corners_are_opencvs() -> None:
    made = cv2.aruco.CharucoBoard((7, 5), 0.04, 0.03, dictionary("aruco_5x5_100"))
    expected = from_opencvs(np.array(made.getChessboardCorners()), 7 * 0.04, 5 * 0.04)
    np.testing.assert_allclose(BOARD.corners(), expected, atol=1e-8)
    assert BOARD.ids == tuple(np.ravel(made.getIds()))
    assert BOARD.corners()[0, 0] < 0.0 < BOARD.corners()[0, 1]  # top left first
    assert BOARD.length_m == 0.04


def test_a_tag_grid_is_opencvs() -> None:
    made = cv2.aruco.GridBoard((4, 3), 0.03, 0.008, dictionary("aruco_4x4_50"))
    expected = from_opencvs(
        np.array(made.getObjPoints(), dtype=float).reshape(-1, 3), 4 * 0.038 - 0.008, 3 * 0.038 - 0.008
    )
    grid = TagGrid("grid", "aruco_4x4_50", 4, 3, 0.03, 0.008)
    np.testing.assert_allclose(grid.corners(), expected, atol=1e-8)
    assert grid.ids == tuple(np.ravel(made.getIds()))
    assert TagGrid("grid", "aruco_4x4_50", 2, 1, 0.03, 0.008, ids=(7, 3)).ids == (7, 3)


def test_a_bundles_tags_are_turned_and_moved() -> None:
    half = np.sqrt(0.5)
    tags = (BundleTag(5, 0.1), BundleTag(2, 0.2, (1.0, 2.0, 3.0), (half, 0.0, half, 0.0)))
    bundle = Bundle("bundle", "tag36h11", tags)
    assert (bundle.ids, bundle.length_m) == ((5, 2), 0.1)
    np.testing.assert_allclose(bundle.corners()[:4], Tag("tag", "tag36h11", 5, 0.1).corners())
    # A quarter of a turn about y takes x to -z: the left corners come forward.
    places = [[1.0, 2.1, 3.1], [1.0, 2.1, 2.9], [1.0, 1.9, 2.9], [1.0, 1.9, 3.1]]
    np.testing.assert_allclose(bundle.corners()[4:], places, atol=1e-12)


def test_aprilgrid_is_kalibrs() -> None:
    # Kalibr counts from the bottom left, to the right, then up; its spacing is the gap over the tag's side.
    corners = GRID.corners().reshape(4, 6, 4, 3)
    pitch = 0.088 * 1.3
    middles = corners.mean(axis=2)
    np.testing.assert_allclose(np.diff(middles, axis=1), np.broadcast_to([pitch, 0.0, 0.0], (4, 5, 3)), atol=1e-12)
    np.testing.assert_allclose(np.diff(middles, axis=0), np.broadcast_to([0.0, pitch, 0.0], (3, 6, 3)), atol=1e-12)
    np.testing.assert_allclose(
        corners - middles[:, :, None],
        np.broadcast_to(Tag("t", "tag36h11", 0, 0.088).corners(), (4, 6, 4, 3)),
        atol=1e-12,
    )
    assert (GRID.ids[0], GRID.ids[-1]) == (5, 28)
    assert GRID.length_m == 0.088


def test_the_tags_of_an_aprilgrid_are_opencvs_grid_board() -> None:
    # Its rows count from the top.
    made = cv2.aruco.GridBoard((6, 4), 0.088, 0.3 * 0.088, dictionary("tag36h11"))
    width, height = (n * 0.088 + (n - 1) * 0.3 * 0.088 for n in (6, 4))
    theirs = from_opencvs(np.array(made.getObjPoints()).reshape(-1, 3), width, height)
    ours = GRID.corners().reshape(4, 6, 4, 3)[::-1].reshape(-1, 3)
    np.testing.assert_allclose(ours, theirs, atol=1e-7)


def test_a_checkerboards_corners_go_left_to_right_from_the_top() -> None:
    corners = CHESS.corners().reshape(5, 8, 3)
    np.testing.assert_allclose(np.diff(corners, axis=1), np.broadcast_to([0.03, 0.0, 0.0], (5, 7, 3)), atol=1e-12)
    np.testing.assert_allclose(np.diff(corners, axis=0), np.broadcast_to([0.0, -0.03, 0.0], (4, 8, 3)), atol=1e-12)
    assert (CHESS.ids, CHESS.family, CHESS.length_m) == ((), "checkerboard", 0.03)


def test_asymmetric_circles_are_opencvs_and_kalibrs() -> None:
    # Both have ((2 j + i % 2) s, i s) for row i from the first one, circle j; their y goes down where ours goes up.
    grid = CircleGrid("dots", 4, 11, 0.02, asymmetric=True)
    theirs = [((2 * j + i % 2) * 0.02, i * 0.02, 0.0) for i in range(11) for j in range(4)]
    np.testing.assert_allclose(grid.corners(), from_opencvs(np.array(theirs), 7 * 0.02, 10 * 0.02), atol=1e-15)
    assert grid.length_m == 0.02
    with pytest.raises(TargetError, match="has no larger dot"):
        CircleGrid("dots", 4, 11, 0.02, True, asymmetric=True)


@pytest.mark.parametrize("columns", [3, 4, 5, 6])
@pytest.mark.parametrize("rows", [3, 4, 6, 8, 10, 11, 12])
@pytest.mark.parametrize("asymmetric", [False, True])
def test_a_grid_of_circles_looks_the_same_in_as_many_ways_as_it_says(columns: int, rows: int, asymmetric: bool) -> None:
    grid = CircleGrid("dots", columns, rows, 1.0, asymmetric=asymmetric)
    about_mean = grid.corners()[:, :2] - grid.corners()[:, :2].mean(axis=0)  # every turn to itself keeps the mean
    turns = [np.array([[1, 0], [0, 1]]), np.array([[0, -1], [1, 0]])]
    turns += [-turn for turn in turns]
    same = [np.abs((about_mean @ turn)[:, None] - about_mean).max(axis=2).min(axis=1).max() < 1e-9 for turn in turns]
    assert grid.ways == sum(same)
    if grid.ways > 1:  # and then about the origin
        np.testing.assert_allclose(grid.corners().mean(axis=0), 0.0, atol=1e-12)


@pytest.mark.parametrize("family", FAMILIES)
def test_opencv_has_every_family_with_as_many_tags(family: str) -> None:
    tags = dictionary(family)
    assert len(tags.bytesList) == FAMILIES[family]
    assert modules(family, 2) == modules(family) + 2 == tags.markerSize + 4


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Tag("t", "tag36h12", 0, 0.1), "no family 'tag36h12'; there are tag16h5"),
        (lambda: Tag("t", "tag36h11", 587, 0.1), "ids 587 to 587 are not in tag36h11: 0 to 586"),
        (lambda: Tag("t", "tag36h11", -1, 0.1), "ids -1"),
        (lambda: Tag("t", "tag36h11", 0, 0.0), "size_m = 0.0"),
        (lambda: Tag("t", "tag36h11", 0, -0.1), "size_m = -0.1"),
        (lambda: Tag("t", "tag36h11", 0, 120.0), "size_m = 120.0; give metres"),
        (lambda: Tag("t", "tag36h11", 0, np.nan), "size_m = nan"),
        (lambda: Charuco("t", "aruco_4x4_50", 7, 5, 0.03, 0.03), "marker_m = 0.03 must be less than square_m"),
        (lambda: Charuco("t", "aruco_4x4_50", 7, 5, 0.03, -0.02), "marker_m = -0.02"),
        (lambda: Charuco("t", "aruco_4x4_50", 20, 6, 0.03, 0.02), "ids 0 to 59 are not in aruco_4x4_50: 0 to 49"),
        (lambda: Charuco("t", "aruco_4x4_50", 7, 5, 0.03, 0.02, first_id=40), "ids 40 to 56"),
        (lambda: Charuco("t", "aruco_4x4_50", 1, 5, 0.03, 0.02), "1 columns and 5 rows"),
        (lambda: AprilGrid("t", "tag36h11", 6, 6, 0.088, 0.0), "spacing = 0.0"),
        (lambda: AprilGrid("t", "tag36h11", 6, 6, 0.088, np.nan), "spacing = nan"),
        (lambda: AprilGrid("t", "tag36h11", 6, 101, 0.088, 0.3), "101 rows"),
        (lambda: AprilGrid("t", "tag36h11", 6, 6, 88.0, 0.3), "tag_m = 88.0; give metres"),
        (lambda: Checkerboard("t", 2, 5, 0.03), "2 columns"),
        (lambda: Checkerboard("t", 8, 5, 30.0), "square_m = 30.0"),
        (lambda: TagGrid("t", "aruco_4x4_50", 3, 2, 0.03, 0.008, ids=(1, 2)), "3 x 2 tags need 6 ids, and ids has 2"),
        (lambda: TagGrid("t", "aruco_4x4_50", 2, 1, 0.03, 0.008, ids=(1, 1)), "id 1 is there 2 times"),
        (lambda: TagGrid("t", "aruco_4x4_50", 2, 1, 0.03, 0.008, first_id=3, ids=(3, 4)), "both first_id and ids"),
        (lambda: TagGrid("t", "aruco_4x4_50", 2, 1, 0.03, 0.0), "gap_m = 0.0"),
        (lambda: Bundle("t", "tag36h11", ()), "without tags"),
        (lambda: Bundle("t", "tag36h11", (BundleTag(1, 0.1), BundleTag(1, 0.1))), "id 1 is there 2 times"),
        (lambda: Bundle("t", "tag36h11", (BundleTag(1, 50.0),)), "size of tag 1 = 50.0; give metres"),
        (lambda: Bundle("t", "tag36h11", (BundleTag(1, 0.1, (0.0, 250.0, 0.0)),)), "tag 1 is at .* give metres"),
        (lambda: Bundle("t", "tag36h11", (BundleTag(1, 0.1, wxyz=(1.0, 1.0, 0.0, 0.0)),)), "norm 1.414; give qw, qx"),
    ],
)  # fmt: skip
def test_wrong_targets_are_refused(make: object, words: str) -> None:
    with pytest.raises(TargetError, match=rf"^target t: .*{words}"):
        make()  # type: ignore[operator]


@pytest.mark.parametrize(
    ("word", "family"),
    [
        ("tag36h11", "tag36h11"), ("36h11", "tag36h11"), ("tagStandard36h11", "tag36h11"), ("Tag16h5", "tag16h5"),
        ("DICT_5X5_100", "aruco_5x5_100"), ("DICT_APRILTAG_36h10", "tag36h10"), ("aruco_mip_36h12", "aruco_mip_36h12"),
        ("", None), ("tagCircle21h7", None),
    ],
)  # fmt: skip
def test_drivers_words_for_families(word: str, family: str | None) -> None:
    assert family_named(word) == family


@pytest.mark.parametrize(
    ("first", "second", "is_same"),
    [
        ("tag36h11", "DICT_APRILTAG_36h11", True), ("aruco_5x5_50", "aruco_5x5_1000", True),
        ("DICT_5X5_100", "aruco_5x5_250", True), ("aruco_5x5_50", "aruco_6x6_50", False), ("36h11", "36h10", False),
        ("aruco_original", "aruco_5x5_1000", False),
    ],
)  # fmt: skip
def test_families_whose_tags_look_the_same(first: str, second: str, is_same: bool) -> None:
    assert is_same_print(first, second) is is_same
    assert is_same_print(second, first) is is_same


@pytest.mark.parametrize("side", [4, 5, 6, 7])
def test_smaller_aruco_dictionaries_begin_the_larger_ones(side: int) -> None:
    small, large = (dictionary(f"aruco_{side}x{side}_{count}") for count in (50, 1000))
    np.testing.assert_array_equal(small.bytesList, large.bytesList[:50])
