"""Corners by their model: sharp on drawn crossings, unmoved by gamma, not good where something else is."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from gtsam_rwhec.detect.checkerboards import fitted_corners

ROWS, COLUMNS, STEP_PX = 3, 4, 24.0
#: Pixels of squares, of a board that is turned and sheared.
J = STEP_PX * np.array([[0.96, -0.2], [0.25, 0.7]])
FIRST = np.array([40.3, 32.7])
OFF_PX = np.array([0.8, -0.6])


def on_image(squares: np.ndarray) -> np.ndarray:
    return squares @ J.T + FIRST


def board(blur_px: float, gamma: float = 1.0) -> np.ndarray:
    """Gray values 0 to 255 of a blurred board that has no end: products of two square waves."""
    y, x = np.indices((150, 180)).astype(float)
    squares = (np.stack([x, y], axis=-1) - FIRST) @ np.linalg.inv(J).T
    sigma = blur_px * np.linalg.norm(np.linalg.inv(J), axis=1)
    waves = []
    for i in range(2):
        edges = np.arange(-8, 16)
        signs = (-1.0) ** edges
        waves.append(1.0 + (2.0 * ndtr((squares[..., i, None] - edges) / sigma[i]) * signs).sum(axis=-1))
    light = 0.5 + 0.4 * (waves[0] - waves[0].mean().round()) * (waves[1] - waves[1].mean().round())
    return 255.0 * np.clip(light, 0.0, 1.0) ** gamma


TRUTH = on_image(np.stack(np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)), axis=-1).astype(float))


@pytest.mark.parametrize("gamma", [0.5, 1.0, 1.5])
@pytest.mark.parametrize("blur_px", [0.6, 1.5])
def test_corners_are_sharp_from_a_plane_that_is_a_pixel_off(blur_px: float, gamma: float) -> None:
    image = board(blur_px, gamma)
    noise = np.random.default_rng(0).normal(scale=2.0, size=image.shape)
    gray = np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)
    fitted = fitted_corners(gray, lambda squares: on_image(squares) + OFF_PX, ROWS, COLUMNS)
    assert fitted.good.all()
    assert np.sqrt(((fitted.corners_px - TRUTH) ** 2).mean()) < 0.03
    if gamma == 1.0:
        assert np.abs(fitted.blur_px - blur_px).max() < 0.15


def test_a_shadows_edge_does_not_move_corners() -> None:
    image = board(1.0)
    along = np.indices(image.shape)[1] - TRUTH[1, 1, 0] - 6.0
    gray = np.rint(image * (1.0 - 0.5 * ndtr(along / 3.0))).astype(np.uint8)
    fitted = fitted_corners(gray, on_image, ROWS, COLUMNS)
    off = np.linalg.norm(fitted.corners_px - TRUTH, axis=-1)
    assert fitted.good.all()
    assert off[fitted.sharp].max() < 0.25
    assert np.median(off) < 0.02
    assert fitted.sharp.mean() > 0.8


def test_where_no_squares_meet_nothing_is_good() -> None:
    y, x = np.indices((150, 180))
    for image in (np.full((150, 180), 128), 40 + 200 * (x > 70), 255 * ((x // 3 + y // 3) % 2), 255 * (x % 2)):
        fitted = fitted_corners(image.astype(np.uint8), on_image, ROWS, COLUMNS)
        assert not fitted.good.any()
        assert np.isfinite(fitted.corners_px).all()


def test_a_board_outside_the_image_is_not_good() -> None:
    fitted = fitted_corners(board(1.0).astype(np.uint8), lambda squares: on_image(squares) + 1e4, ROWS, COLUMNS)
    assert not fitted.good.any()
