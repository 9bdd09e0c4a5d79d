"""Corners of boards, the points where two dark squares meet: blur does not move them."""

from __future__ import annotations

import cv2
import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.board_tags import charuco_board
from gtsam_rwhec.vision.camera import Camera
from gtsam_rwhec.vision.images import Gray
from gtsam_rwhec.vision.targets import AprilGrid, Charuco

#: cornerSubPix ends after 30 rounds, or with a step of at most 1e-3 pixels.
CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 1e-3)
#: A corner that refinement moves by more than this share of its window is another corner, and is not used.
MOST_MOVED = 0.8
#: The half window that finds an AprilGrid's corner is this share of a tag's side. It is large because OpenCV's contours
#: are wrong by pixels where black squares touch.
FIND = 0.2
#: The half window that finds a corner is at most this share of the gap between tags.
FIND_GAP = 0.7
#: The half window that measures a found corner is this share of a tag's side.
MEASURE = 0.13
#: The half window that measures a corner is at most this share of the gap between tags.
MEASURE_GAP = 0.55
#: A corner further than this (pixels) from the place that the other corners predict is not used.
ASTRAY_PX = 1.5
#: Blur and the gradient's window carry a marker's edge outwards by this many pixels.
GRADIENT_PX = 0.5


def charuco_corners(
    gray: Gray, board: Charuco, ids: np.ndarray, markers_px: Array, *, is_legacy: bool = False
) -> tuple[np.ndarray, Array]:
    """Indices (n,) and places (n, 2) of a board's inner corners, from its markers' ids (m,) and corners (m, 4, 2).

    OpenCV's windows reach into the markers of a turned or slanted board, and its corners are wrong by tenths of a
    pixel. The corners are therefore measured again in smaller windows.
    """
    if len(ids) == 0:
        return np.zeros(0, dtype=int), np.zeros((0, 2))
    corners, indices, _, _ = cv2.aruco.CharucoDetector(charuco_board(board, is_legacy)).detectBoard(
        gray, markerCorners=list(markers_px.astype(np.float32)[:, None]), markerIds=ids.astype(np.int32)[:, None]
    )
    if indices is None or len(indices) == 0:
        return np.zeros(0, dtype=int), np.zeros((0, 2))
    indices, found = np.ravel(indices).astype(int), np.reshape(corners, (-1, 2)).astype(float)
    half = _to_the_markers(board, board.corners()[indices, :2], found) - GRADIENT_PX
    return indices, refined_corners(gray, found, int(np.clip(half, 2, 8)))


def _to_the_markers(board: Charuco, plane: Array, pixels: Array) -> float:
    """The smallest distance between any corner (n, 2) and its nearest marker, in pixels along x or y."""
    if len(plane) < 4:
        return 0.0
    H, _ = cv2.findHomography(plane, pixels)
    if H is None:
        return 0.0
    gap = 0.5 * (board.square_m - board.marker_m)
    around = plane[:, None] + gap * np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    there, here = (cv2.perspectiveTransform(p.reshape(-1, 1, 2), H).reshape(p.shape) for p in (around, plane))
    return float(np.abs(there - here[:, None]).max(axis=2).min())


def aprilgrid_corners(gray: Gray, board: AprilGrid, ids: np.ndarray, tags_px: Array) -> tuple[np.ndarray, Array]:
    """Indices (n,) and places (n, 2) of a grid's corners, from its tags' ids (m,) and corners (m, 4, 2).

    The corners are in the board's own order, as `board_tags` gives them.
    """
    if len(ids) == 0:
        return np.zeros(0, dtype=int), np.zeros((0, 2))
    indices = (4 * (ids - board.first_id)[:, None] + np.arange(4)).ravel()
    corners = tags_px
    side = float(np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).min())
    rough = corners.reshape(-1, 2)
    # A window holds only the corner's two black squares: a tag's border is a fifth of its side.
    half = int(np.clip(min(FIND, FIND_GAP * board.spacing) * side, 3, 12))
    found = refined_corners(gray, rough, half)
    moved = np.linalg.norm(found - rough, axis=1)
    kept = (moved > 0.0) & (moved < MOST_MOVED * half)  # OpenCV returns its input if it does not converge
    half = int(np.clip(min(MEASURE, MEASURE_GAP * board.spacing) * side, 2, 8))
    return indices[kept], refined_corners(gray, found[kept], half)


def on_one_plane(camera: Camera, corners_m: Array, corners_px: Array) -> np.ndarray:
    """Say which (n,) of a board's corners (n, 3), seen at (n, 2), agree with most corners. Under six corners all do."""
    everyone = np.ones(len(corners_m), dtype=bool)
    x = camera.undistort(corners_px)
    if len(corners_m) < 6 or not np.isfinite(x).all():
        return everyone
    focal = 0.5 * (camera.K[0, 0] + camera.K[1, 1])
    H, agrees = cv2.findHomography(corners_m[:, :2], x * focal, cv2.RANSAC, ASTRAY_PX)
    return everyone if H is None else agrees.ravel().astype(bool)


def refined_corners(gray: Gray, corners: Array, half: int) -> Array:
    """Places (n, 2) of corners where two dark squares meet, in windows of 2 half + 1 pixels."""
    places = np.ascontiguousarray(corners.reshape(-1, 1, 2), dtype=np.float32)
    return cv2.cornerSubPix(gray, places, (half, half), (-1, -1), CRITERIA).reshape(-1, 2).astype(float)
