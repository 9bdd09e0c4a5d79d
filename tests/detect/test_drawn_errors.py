"""Pictures of corners and their errors: marks are where they belong, errors are magnified as it is said."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gtsam_rwhec.detect.pictures import LONGEST_PX, SIDE_PX, draw_errors, jpeg_of, magnification

GRAY = np.full((480, 640), 128, dtype=np.uint8)
SEEN = np.array([[300.0, 200.0], [380.0, 200.0], [300.0, 260.0], [380.0, 260.0]])


def is_coloured(picture: np.ndarray) -> np.ndarray:
    """Pixels (x, y) that are neither gray nor white."""
    spread = picture.astype(int).max(axis=2) - picture.astype(int).min(axis=2)
    return np.argwhere(spread > 60)[:, ::-1]


def test_only_the_target_is_shown_and_each_corner_has_a_mark() -> None:
    drawn = draw_errors(GRAY, SEEN, np.zeros((4, 2)))
    assert max(drawn.picture.shape) == SIDE_PX
    assert drawn.magnified == 1.0
    marks = is_coloured(drawn.picture)
    _, _, _, centres = cv2.connectedComponentsWithStats(
        cv2.dilate(
            np.bincount(marks[:, 1] * SIDE_PX + marks[:, 0], minlength=drawn.picture.shape[0] * SIDE_PX)
            .reshape(-1, SIDE_PX)
            .astype(np.uint8),
            np.ones((9, 9)),
        )
    )
    width, height = np.ptp(centres[1:], axis=0)
    assert len(centres) == 1 + len(SEEN)
    assert width / height == pytest.approx(80.0 / 60.0, rel=0.02)


def test_errors_are_as_long_as_is_said() -> None:
    errors = np.zeros((4, 2))
    errors[0] = [-0.11, 0.0]  # the answer has it to the right
    drawn, none = draw_errors(GRAY, SEEN, errors), draw_errors(GRAY, SEEN, np.zeros((4, 2)))
    changed = np.argwhere((drawn.picture != none.picture).any(axis=2))[:, ::-1]
    scale = SIDE_PX / 144.0  # the window's width: 80 + 2 (0.25 80 + 4), or of its height, 60 + 2 (0.25 80 + 4), 4 / 3
    assert drawn.magnified in (20.0, 50.0, 100.0)
    assert np.ptp(changed[:, 0]) == pytest.approx(scale * drawn.magnified * 0.11, abs=14.0)


@pytest.mark.parametrize(("longest", "times"), [(0.0, 1.0), (0.1, 500.0), (1.0, 50.0), (0.011, 1000.0), (400.0, 1.0)])
def test_errors_are_magnified_by_round_numbers(longest: float, times: float) -> None:
    assert magnification(np.array([[longest, 0.0]]), 1.0) == times
    assert longest * times <= max(LONGEST_PX, longest)


def test_corners_at_the_edge_and_errors_that_are_not_known() -> None:
    errors = np.array([[np.nan, np.nan], [900.0, 0.0]])
    drawn = draw_errors(GRAY, np.array([[-2.0, -1.0], [639.0, 479.0]]), errors)
    assert drawn.picture.ndim == 3


def test_a_jpeg_is_not_larger_than_it_may_be() -> None:
    noisy = np.random.default_rng(0).integers(0, 255, (400, 500, 3), dtype=np.uint8)
    content = jpeg_of(noisy, 20_000)
    assert len(content) <= 20_000
    read = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_COLOR)
    assert read is not None
    assert read.shape[1] / read.shape[0] == pytest.approx(1.25, rel=0.05)
    assert cv2.imdecode(np.frombuffer(jpeg_of(GRAY, 20_000), dtype=np.uint8), cv2.IMREAD_COLOR).shape[:2] == GRAY.shape
