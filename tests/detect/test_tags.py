"""Tags of whole families are read in perspective and in every turn; other quadrangles are not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rendered import PINHOLE, pose, printed, render

from gtsam_rwhec.cameras.targets import FAMILIES, AprilGrid, Tag
from gtsam_rwhec.detect.tags import dictionary, identified, quadrangles, tags_in_image, unlike

SIDE = 240


def tag_in_perspective(family: str, number: int, corners: np.ndarray, border_bits: int = 1) -> np.ndarray:
    """An image (300, 300) with a tag whose corners, clockwise from its first, are at (4, 2) pixels."""
    drawn = cv2.aruco.generateImageMarker(dictionary(family), number, SIDE, borderBits=border_bits)
    square = np.array([[0, 0], [SIDE, 0], [SIDE, SIDE], [0, SIDE]], np.float32) - 0.5
    H = cv2.getPerspectiveTransform(square, corners.astype(np.float32))
    return cv2.warpPerspective(drawn, H, (300, 300), borderValue=200)


@settings(max_examples=40, deadline=None)
@given(
    family=st.sampled_from(["tag36h11", "tag25h9", "aruco_4x4_50", "aruco_5x5_1000"]),
    share=st.floats(0.0, 0.999),
    bends=st.lists(st.floats(-18.0, 18.0), min_size=8, max_size=8),
    turns=st.integers(0, 3),
)
def test_every_tag_of_a_family(family: str, share: float, bends: list[float], turns: int) -> None:
    number = int(share * FAMILIES[family])
    corners = np.array([[90.0, 80.0], [210.0, 85.0], [205.0, 215.0], [85.0, 205.0]]) + np.reshape(bends, (4, 2))
    image = tag_in_perspective(family, number, np.roll(corners, turns, axis=0))
    assert identified(image, corners[None], family).tolist() == [number]
    found = quadrangles(image)
    assert number in identified(image, found, family)
    left = unlike(found, corners[None])
    assert len(left) < len(found)
    assert number not in identified(image, left, family)


def test_a_wrong_bit_is_corrected_and_a_wrong_border_is_not() -> None:
    corners = np.array([[60.0, 60.0], [220.0, 60.0], [220.0, 220.0], [60.0, 220.0]])
    image = tag_in_perspective("tag36h11", 33, corners)
    cell = image[60 + 3 * 20 : 60 + 4 * 20, 60 + 3 * 20 : 60 + 4 * 20]
    cell[:] = 255 - cell
    assert identified(image, corners[None], "tag36h11").tolist() == [33]
    image[60:80, 60:220] = 255
    image[200:220, 60:220] = 255
    assert identified(image, corners[None], "tag36h11").tolist() == [-1]


@pytest.mark.parametrize("family", ["tag36h11", "aruco_4x4_50"])
def test_quadrangles_without_a_tag_have_no_id(family: str) -> None:
    flat = np.full((100, 100), 90, np.uint8)
    corners = np.array([[[20.0, 20.0], [80.0, 20.0], [80.0, 80.0], [20.0, 80.0]], [[5.0, 5.0]] * 4])
    assert identified(flat, corners, family).tolist() == [-1, -1]
    assert identified(flat, corners[:0], family).tolist() == []
    assert quadrangles(flat).shape == (0, 4, 2)


def test_double_borders() -> None:
    corners = np.array([[60.0, 60.0], [220.0, 70.0], [215.0, 220.0], [55.0, 210.0]])
    image = tag_in_perspective("tag36h11", 5, corners, border_bits=2)
    assert identified(image, corners[None], "tag36h11", 2).tolist() == [5]
    assert identified(image, corners[None], "tag36h11", 1).tolist() == [-1]


def test_three_corners_on_a_line_are_no_tag() -> None:
    gray = np.random.default_rng(0).integers(0, 256, (60, 60)).astype(np.uint8)
    flat = np.array([[[10, 10], [30, 10], [50, 10], [10, 50]], [[10, 10], [10, 10], [10, 10], [10, 10]]], dtype=float)
    assert identified(gray, flat, "tag36h11").tolist() == [-1, -1]


def test_tags_of_every_family_are_found_once_at_each_place() -> None:
    scene = [
        (Tag("a", "tag36h11", 3, 0.05), pose((0.0, 0.0, 0.0), (-0.12, -0.08, 0.4))),
        (Tag("b", "tag25h9", 5, 0.05), pose((0.0, 0.0, 0.0), (0.0, -0.08, 0.4))),
        (Tag("c", "aruco_5x5_1000", 700, 0.05), pose((0.0, 0.0, 0.0), (0.12, -0.08, 0.4))),
        (Tag("d", "aruco_6x6_50", 1, 0.05), pose((0.0, 0.0, 0.0), (-0.12, 0.08, 0.4))),
        (AprilGrid("e", "tag36h11", 1, 1, 0.05, 0.3, first_id=40), pose((0.0, 0.0, 0.0), (0.08, 0.07, 0.35))),
    ]  # fmt: skip
    image = render(PINHOLE, [(printed(target), T) for target, T in scene], blur_px=0.9)
    assert sorted((tag.family, tag.id, tag.is_double) for tag in tags_in_image(image)) == [
        ("aruco_5x5_1000", 700, False), ("aruco_6x6_1000", 1, False), ("tag25h9", 5, False), ("tag36h11", 3, False),
        ("tag36h11", 40, True),
    ]  # fmt: skip
    assert tags_in_image(render(PINHOLE, [])) == []
