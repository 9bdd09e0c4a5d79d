"""Tags of a board against the rig file: right boards are not accused, wrong places, turns, sizes and gaps are named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rendered import pose, projected

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.shape_evidence import BoardView, ShapeEvidence, evidence_of_shape, never_seen
from gtsam_rwhec.cameras.targets import AprilGrid, Bundle, BundleTag, Charuco, TagGrid, Target
from gtsam_rwhec.runs.doubted_statements import hypotheses_of

CAMERA = Camera.of(640, 480, "", [[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]], (), "test")
BUNDLE = Bundle(
    "bundle",
    "tag36h11",
    (
        BundleTag(1, 0.05, (-0.05, -0.04, 0.0)),
        BundleTag(2, 0.05, (0.05, -0.04, 0.0)),
        BundleTag(3, 0.05, (0.0, 0.05, 0.0)),
    ),
)
GRID, GAPS = AprilGrid("grid", "tag36h11", 5, 4, 0.03, 0.3), TagGrid("gaps", "aruco_4x4_50", 4, 3, 0.03, 0.008)


def views(board: Target, n: int, seed: int, bent_m: float = 0.0) -> list[BoardView]:
    """Views of a board, turned by up to 30 degrees; tags outside the image are not seen."""
    random = np.random.default_rng(seed)
    corners = board.corners()
    bent = corners.copy()
    bent[:, 2] += bent_m * (1.0 - (corners[:, 0] / np.abs(corners[:, 0]).max()) ** 2)
    made: list[BoardView] = []
    while len(made) < n:
        d = random.uniform(0.4, 0.8)
        a, b = random.uniform(-30.0, 30.0, 2)
        T = pose((a, b, random.uniform(-180.0, 180.0)), (0.0, 0.0, d))
        T[:2, 3] = d * random.uniform([-0.3, -0.2], [0.3, 0.2])
        pixels = projected(CAMERA, bent, T) + 0.1 * random.normal(size=(len(corners), 2))
        seen = np.flatnonzero(np.repeat(CAMERA.inside(pixels).reshape(-1, 4).all(axis=1), 4))
        if len(seen) >= 8:
            made.append(BoardView(seen, pixels[seen], T))
    return made


def found(seen: Target, stated: Target, n: int = 9, seed: int = 0, bent_m: float = 0.0) -> ShapeEvidence:
    evidence = evidence_of_shape(CAMERA, stated.corners(), hypotheses_of(stated), views(seen, n, seed, bent_m))
    assert evidence is not None
    return evidence


def with_third(**changes: object) -> Bundle:
    return replace(BUNDLE, tags=(*BUNDLE.tags[:2], replace(BUNDLE.tags[2], **changes)))


@pytest.mark.parametrize("board", [BUNDLE, GRID, GAPS], ids=lambda board: board.name)
@pytest.mark.parametrize("bent_m", [0.0, 0.001])
def test_right_boards_are_not_accused_nor_slightly_bent_ones_said_to_be_useless(board: Target, bent_m: float) -> None:
    for seed in range(8):
        evidence = found(board, board, 6 + 2 * seed, seed, bent_m)
        assert not (evidence.contradicts and (bent_m == 0.0 or evidence.is_far_off)), seed
        assert 0.08 < evidence.fitted_px < (0.17 if bent_m == 0.0 else 0.5)


@pytest.mark.parametrize("off_m", [(0.003, 0.0, 0.0), (0.0, 0.0, 0.004)], ids=["x", "z"])
def test_a_tag_at_another_place_is_named_with_how_far(off_m: tuple[float, float, float]) -> None:
    evidence = found(BUNDLE, with_third(t_m=tuple(np.add(BUNDLE.tags[2].t_m, off_m))))
    assert evidence.key == ("place", 2)
    assert evidence.contradicts
    assert evidence.is_far_off
    np.testing.assert_allclose(evidence.theta, -np.array(off_m), atol=5e-4)
    assert (np.abs(evidence.theta + off_m) < 5.0 * evidence.sigma).all()


def test_a_tag_that_is_turned_or_of_another_size_is_named() -> None:
    turned = found(with_third(wxyz=(np.cos(0.05), 0.0, 0.0, np.sin(0.05))), BUNDLE)
    assert turned.key == ("turn", 2)
    assert turned.contradicts
    assert turned.theta[0] == pytest.approx(0.1, abs=0.005)
    larger = found(with_third(size_m=0.053), BUNDLE)
    assert larger.key == ("size", 2)
    assert larger.contradicts
    assert larger.theta[0] == pytest.approx(0.06, abs=0.004)


def test_another_gap_is_told() -> None:
    evidence = found(GRID, replace(GRID, spacing=0.31))
    assert evidence.contradicts
    assert not evidence.is_far_off
    assert 0.31 + evidence.theta[0] / 0.03 == pytest.approx(0.30, abs=0.0005)
    assert found(GRID, replace(GRID, spacing=0.25)).is_far_off
    of_gaps = found(GAPS, replace(GAPS, gap_m=0.009))
    assert of_gaps.contradicts
    assert 0.009 + of_gaps.theta[0] == pytest.approx(0.008, abs=2e-5)


def test_few_views_a_camera_at_rest_and_one_tag_say_nothing() -> None:
    wrong = replace(GRID, spacing=0.31)
    some = views(GRID, 9, 0)
    moves = hypotheses_of(wrong)
    assert evidence_of_shape(CAMERA, wrong.corners(), moves, some[:5]) is None
    assert evidence_of_shape(CAMERA, wrong.corners(), moves, some[:1] * 50) is None
    alone = [BoardView(v.indices[:4], v.corners_px[:4], v.T) for v in some]
    assert evidence_of_shape(CAMERA, wrong.corners(), moves, alone) is None


BOARD = Charuco("board", "aruco_5x5_100", 7, 7, 0.03, 0.022)
TAGS = TagGrid("tags", "aruco_4x4_50", 3, 2, 0.03, 0.008)


def views_of(board: Target, seen: np.ndarray, away_m: float = 0.6, n: int = 6) -> list[BoardView]:
    corners = board.corners()
    poses = [pose((5.0 * i - 10.0, 8.0, 20.0 * i), (0.0, 0.0, away_m)) for i in range(n)]
    return [BoardView(seen, projected(CAMERA, corners[seen], T), T) for T in poses]


def test_rows_of_a_charuco_board_that_are_never_seen() -> None:
    assert never_seen(BOARD, CAMERA, views_of(BOARD, np.arange(36))) == ""
    words = "the lowest 2 rows of corners (if they are not there, write squares: [7, 5])"
    assert never_seen(BOARD, CAMERA, views_of(BOARD, np.arange(24))) == words
    left = np.arange(36)[np.arange(36) % 6 > 0]
    words = "the left 1 column of corners (if they are not there, write squares: [6, 7])"
    assert never_seen(BOARD, CAMERA, views_of(BOARD, left)) == words


def test_tags_that_are_never_seen() -> None:
    assert never_seen(TAGS, CAMERA, views_of(TAGS, np.arange(24))) == ""
    assert never_seen(TAGS, CAMERA, views_of(TAGS, np.arange(20))) == "tag 5"


def test_outside_the_images_or_in_few_of_them_nothing_is_missing() -> None:
    assert never_seen(BOARD, CAMERA, views_of(BOARD, np.arange(24), n=4)) == ""
    assert never_seen(BOARD, CAMERA, views_of(BOARD, np.arange(24), away_m=0.18)) == ""
    assert never_seen(TAGS, CAMERA, views_of(TAGS, np.arange(20), away_m=0.1)) == ""
