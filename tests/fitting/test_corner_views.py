"""Corners as residuals, against OpenCV and numeric derivatives."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from rwhec_factors import se3
from simulated_cells import BOARD, CAMERA, Cell, cell

from gtsam_rwhec.fitting.corner_residuals import Stack, linearised, pixel_errors, shaped, stacks_of
from gtsam_rwhec.fitting.observations import Observations

Array = NDArray[np.float64]
SHAPE = np.array([2e-3, 1e-3, -2e-3, 3e-3])


@pytest.fixture(scope="module")
def small() -> Cell:
    return cell(0, images=5)


@pytest.fixture(scope="module")
def stack(small: Cell) -> Stack:
    return stacks_of(small.observations)[0][0]


def test_pixels_of_the_truth_are_opencvs(small: Cell) -> None:
    stacks, A = stacks_of(small.observations)
    for stack in stacks:
        errors = pixel_errors(stack, small.X["board"], small.Y[stack.sensor], A, CAMERA.parameters, np.zeros(4))
        for v, i in enumerate(stack.instant):
            T = se3.inverse(small.Y[stack.sensor]) @ A[i] @ small.X["board"]
            seen, _ = cv2.projectPoints(BOARD.corners(), cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], CAMERA.K, CAMERA.D)
            assert errors[v].reshape(-1, 2) == pytest.approx(seen[:, 0] - stack.pixels[v], abs=1e-7)


def test_equal_carrier_poses_are_one_instant(small: Cell) -> None:
    stacks, A = stacks_of(small.observations)
    assert len(A) == 5
    for stack, view in zip(stacks, small.observations.views.values(), strict=True):
        assert np.array_equal(A[stack.instant], view.A)


def test_a_warped_board_is_higher_at_its_edge_and_larger() -> None:
    points = BOARD.corners()
    moved, _ = shaped(points, np.array([0.0, 1e-3, 0.0, 0.0]))
    edge = np.abs(points[:, 0]).argmax()
    assert moved[edge, 2] == pytest.approx(1e-3 * (points[edge, 0] / np.linalg.norm(points[edge])) ** 2, rel=0.3)
    assert shaped(points, np.array([0.01, 0.0, 0.0, 0.0]))[0] == pytest.approx(1.01 * points)


def test_derivatives(small: Cell, stack: Stack) -> None:
    _, A = stacks_of(small.observations)
    X, Y, p = small.X["board"], small.Y[stack.sensor], CAMERA.parameters
    rows = linearised(stack, X, Y, A, p, SHAPE)
    assert rows.residual == pytest.approx(pixel_errors(stack, X, Y, A, p, SHAPE))

    def check(analytic: Array, errors: Callable[[Array], Array], size: int, e: float) -> None:
        for i, step in enumerate(e * np.eye(size)):
            numeric = (errors(step) - errors(-step)) / (2 * e)
            assert analytic[..., i] == pytest.approx(
                numeric, rel=1e-5, abs=1e-4 * np.abs(analytic[..., i]).max() + 1e-6
            )

    def moved(T: Array, xi: Array) -> Array:
        return T @ se3.expmap(xi[None])[0]

    check(rows.by_X, lambda xi: pixel_errors(stack, moved(X, xi), Y, A, p, SHAPE), 6, 1e-6)
    check(rows.by_Y, lambda xi: pixel_errors(stack, X, moved(Y, xi), A, p, SHAPE), 6, 1e-6)
    check(rows.by_A, lambda xi: pixel_errors(stack, X, Y, moved(A, xi), p, SHAPE), 6, 1e-6)
    check(rows.by_camera, lambda d: pixel_errors(stack, X, Y, A, p + d, SHAPE), len(p), 1e-5)
    check(rows.by_shape, lambda d: pixel_errors(stack, X, Y, A, p, SHAPE + d), 4, 1e-6)


def test_a_corner_that_was_not_seen_says_nothing(small: Cell) -> None:
    views = {
        pair: (view.A, np.where(np.arange(35)[:, None] < 6, np.nan, view.pixels))
        for pair, view in small.observations.views.items()
    }
    hidden = Observations.of(small.observations.cameras, small.observations.corners, views)
    (stack, *_), A = stacks_of(hidden)
    rows = linearised(stack, small.X["board"], small.Y[stack.sensor], A, CAMERA.parameters, np.zeros(4))
    for name in ("residual", "by_X", "by_Y", "by_A", "by_camera", "by_shape"):
        assert not getattr(rows, name)[:, :12].any()
        assert getattr(rows, name)[:, 12:].all(axis=0).any()


def test_a_corner_behind_its_camera_is_infinitely_wrong(small: Cell, stack: Stack) -> None:
    _, A = stacks_of(small.observations)
    turned = small.Y[stack.sensor] @ np.diag([1.0, -1.0, -1.0, 1.0])
    assert np.isinf(pixel_errors(stack, small.X["board"], turned, A, CAMERA.parameters, np.zeros(4))).all()
