"""Corners of boards: where squares meet, which blur leaves where they are."""

from __future__ import annotations

import cv2
import numpy as np

from gtsam_rwhec.poses import Array
from gtsam_rwhec.vision.dictionaries import dictionary
from gtsam_rwhec.vision.images import Gray
from gtsam_rwhec.vision.targets import AprilGrid, Charuco, Checkerboard

#: Of cornerSubPix: rounds, and the step (pixels) that ends them.
CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 1e-3)
#: A corner that refinement moves further than this share of its window went to another one.
MOST_MOVED = 0.8


def charuco_detector(board: Charuco) -> cv2.aruco.CharucoDetector:
    """OpenCV's detector of a board."""
    ids = np.array(board.ids, dtype=np.int32)
    made = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.square_m, board.marker_m, dictionary(board.family), ids
    )
    return cv2.aruco.CharucoDetector(made)


def charuco_corners(
    gray: Gray, detector: cv2.aruco.CharucoDetector, ids: np.ndarray, markers_px: Array
) -> tuple[np.ndarray, Array]:
    """Indices (n,) and places (n, 2) of a board's inner corners, from its markers' ids (m,) and corners (m, 4, 2)."""
    if len(ids) == 0:
        return np.zeros(0, dtype=int), np.zeros((0, 2))
    corners, indices, _, _ = detector.detectBoard(
        gray, markerCorners=list(markers_px.astype(np.float32)[:, None]), markerIds=ids.astype(np.int32)[:, None]
    )
    if indices is None or len(indices) == 0:
        return np.zeros(0, dtype=int), np.zeros((0, 2))
    return np.ravel(indices).astype(int), np.reshape(corners, (-1, 2)).astype(float)


def aprilgrid_corners(gray: Gray, board: AprilGrid, ids: np.ndarray, tags_px: Array) -> tuple[np.ndarray, Array]:
    """Indices (n,) and places (n, 2) of a grid's corners, from its tags' ids (m,) and corners (m, 4, 2).

    Printed tags are turned against OpenCV's by a multiple of a right angle, which differs between generators: the turn
    under which all corners together fit a plane best is taken.
    """
    unique, counts = np.unique(ids, return_counts=True)
    once = np.isin(ids, unique[counts == 1])
    ids, tags_px = ids[once], tags_px[once]
    if len(ids) == 0:
        return np.zeros(0, dtype=int), np.zeros((0, 2))
    indices = (4 * (ids - board.first_id)[:, None] + np.arange(4)).ravel()
    plane = board.corners()[indices, :2]
    fits = [_plane_error(plane, np.roll(tags_px, turn, axis=1).reshape(-1, 2)) for turn in range(4)]
    corners = np.roll(tags_px, int(np.argmin(fits)), axis=1)
    side = float(np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).min())
    # Inside the window only this corner's two black squares: a tag's border is an eighth of it and more.
    half = int(np.clip(0.5 * min(board.spacing, 0.2) * side, 2, 7))
    refined = refined_corners(gray, corners.reshape(-1, 2), half)
    stayed = np.linalg.norm(refined - corners.reshape(-1, 2), axis=1) < MOST_MOVED * half
    return indices[stayed], refined[stayed]


def checkerboard_corners(gray: Gray, board: Checkerboard) -> Array:
    """Inner corners (columns rows, 2), left to right from the top; (0, 2) where the board is not whole in the image.

    The top is where the first corner's outer square is black: a half turn changes its colour.
    """
    found, corners = cv2.findChessboardCornersSB(
        gray, (board.columns, board.rows), flags=cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
    )
    if not found:
        return np.zeros((0, 2))
    grid = np.reshape(corners, (board.rows, board.columns, 2)).astype(float)
    right, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if right[0] * down[1] - right[1] * down[0] < 0.0:  # a mirror image: nobody sees a board from behind
        grid = grid[::-1]
    if _outer_square(gray, grid) > _outer_square(gray, grid[::-1, ::-1]):
        grid = grid[::-1, ::-1]
    return grid.reshape(-1, 2)


def _outer_square(gray: Gray, grid: Array) -> float:
    """Gray value of the middle of the square outside the first corner (by the inner square's mirror image)."""
    middle = grid[0, 0] - 0.5 * (grid[1, 1] - grid[0, 0])
    x, y = np.clip(np.rint(middle).astype(int), 0, [gray.shape[1] - 1, gray.shape[0] - 1])
    return float(gray[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2].mean())


def refined_corners(gray: Gray, corners: Array, half: int) -> Array:
    """Places (n, 2) of corners where two dark squares meet, to a fraction of a pixel; windows of 2 half + 1 pixels."""
    places = np.ascontiguousarray(corners.reshape(-1, 1, 2), dtype=np.float32)
    return cv2.cornerSubPix(gray, places, (half, half), (-1, -1), CRITERIA).reshape(-1, 2).astype(float)


def _plane_error(plane: Array, pixels: Array) -> float:
    """Mean squared error of the best homography, pixels^2; by least squares over all points."""
    H, _ = cv2.findHomography(plane, pixels)
    if H is None:
        return float("inf")
    projected = cv2.perspectiveTransform(plane[:, None], H)[:, 0]
    return float(((projected - pixels) ** 2).sum(axis=1).mean())
