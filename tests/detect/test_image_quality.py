"""How sharp and bright images are, against images of known blur; cameras of resized images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from rendered import BARREL, FISHEYE

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.detect.clues import (
    brightened,
    brightest_value,
    edge_blur_px,
    folded,
    motion_blur_px,
    resized,
    saturated_share,
)


def step(blur_px: float, noise: float = 2.0) -> np.ndarray:
    """A slanted edge from 40 to 200, blurred."""
    x, y = np.meshgrid(np.arange(320.0), np.arange(240.0))
    sharp = np.where(x + 0.3 * y > 190.0, 200.0, 40.0)
    soft = cv2.GaussianBlur(sharp, (0, 0), blur_px) if blur_px else sharp
    noisy = soft + noise * np.random.default_rng(0).normal(size=soft.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("blur_px", [1.0, 2.0, 3.0, 5.0])
def test_the_blur_of_an_edge(blur_px: float) -> None:
    assert edge_blur_px(step(blur_px)) == pytest.approx(blur_px, rel=0.2)


def test_images_without_edges_have_no_blur() -> None:
    assert np.isnan(edge_blur_px(np.full((240, 320), 90, np.uint8)))
    assert edge_blur_px(step(0.0)) < 0.8


def test_brightness() -> None:
    dark = (step(1.0, 0.0) // 20).astype(np.uint8)  # 2 to 10
    assert brightest_value(dark) <= 10
    assert np.ptp(brightened(dark).astype(int)) > 240
    assert saturated_share(np.full((10, 10), 255, np.uint8)) == 1.0
    assert saturated_share(dark) == 0.0


def test_what_is_nearly_black_is_told_from_black() -> None:
    image = np.full((60, 60), 10, np.uint8)
    image[20:40, 20:40] = 20
    apart = folded(image, 20.0)
    assert apart[30, 30] < 8
    assert apart[5, 5] in (79, 80)  # darker is light


@pytest.mark.parametrize("camera", [BARREL, FISHEYE])
@pytest.mark.parametrize("scale", [0.5, 2.0, 0.37])
def test_a_resized_image_has_its_camera(camera: Camera, scale: float) -> None:
    gray, of_it = resized(np.zeros((240, 320), np.uint8), camera, scale)
    assert gray.shape == (of_it.height, of_it.width)
    points = np.array([[0.1, 0.05, 1.0], [-0.2, 0.1, 1.0], [0.0, 0.0, 1.0]])
    factor = np.array([of_it.width / 320, of_it.height / 240])
    np.testing.assert_allclose(of_it.project(points) + 0.5, (camera.project(points) + 0.5) * factor, atol=1e-9)


def squares(way_px: int, defocus_px: float) -> np.ndarray:
    """A turned checkerboard that moved along x while the shutter was open, out of focus."""
    x, y = np.meshgrid(np.arange(320.0), np.arange(240.0))
    u, v = 0.8 * x + 0.6 * y, -0.6 * x + 0.8 * y
    sharp = np.where((u // 31 + v // 31) % 2 == 0, 200.0, 40.0) + 30.0 * (np.sin(x / 9.0) > 0.0) + 30.0 * (y % 60 > 30)
    moved = cv2.filter2D(sharp, -1, np.full((1, way_px), 1.0 / way_px))
    noisy = cv2.GaussianBlur(moved, (0, 0), defocus_px) + 2.0 * np.random.default_rng(0).normal(size=moved.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("way_px", "defocus_px", "is_motion"), [(1, 0.8, False), (1, 2.0, False), (9, 0.8, True)])
def test_motion_blurs_edges_across_its_way_only(way_px: int, defocus_px: float, is_motion: bool) -> None:
    wide_px, narrow_px = motion_blur_px(squares(way_px, defocus_px))
    assert (wide_px > 1.5 * narrow_px) is is_motion
    assert 0.4 < narrow_px < 1.6
