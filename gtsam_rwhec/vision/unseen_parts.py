"""Parts of a board that are in no image, though the images have their places beside what was seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.camera import Camera
from gtsam_rwhec.vision.shape_evidence import BoardView
from gtsam_rwhec.vision.targets import Charuco, Target

#: A part counts as never seen if this number of images have its place.
LEAST_IMAGES = 5
#: Places count within the image, by this share of its width and height from its edges.
EDGE = 0.05
#: A part faces the camera if the cosine between its normal and the line of sight is at least this.
LEAST_FACING = 0.5


def never_seen(board: Target, camera: Camera, views: Sequence[BoardView]) -> str:
    """Name what of a board of tags is in no image; "" if nothing is missing.

    Of a ChArUco board these are rows and columns of corners at its edges; of other boards, tags.
    """
    corners = board.corners()
    if len(views) < LEAST_IMAGES:
        return ""
    seen = np.zeros(len(corners), dtype=bool)
    for view in views:
        seen[view.indices] = True
    if seen.all():
        return ""
    expected = np.array([_shown(camera, corners, view.T) for view in views])  # (views, corners)
    if isinstance(board, Charuco):
        return _lines(board, seen, expected)
    tags = corners.reshape(-1, 4, 3)
    normals = np.cross(tags[:, 1] - tags[:, 0], tags[:, 0] - tags[:, 3])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    T = np.array([view.T for view in views])
    middles = np.einsum("vij,tj->vti", T[:, :3, :3], tags.mean(axis=1)) + T[:, None, :3, 3]
    facing = -np.einsum("vij,tj,vti->vt", T[:, :3, :3], normals, middles) / np.linalg.norm(middles, axis=2)
    there = expected.reshape(len(views), -1, 4).all(axis=2) & (facing >= LEAST_FACING)
    missing = ~seen.reshape(-1, 4).any(axis=1) & (there.sum(axis=0) >= LEAST_IMAGES)
    names = [str(i) for i, is_missing in zip(board.ids, missing, strict=True) if is_missing]
    if not names:
        return ""
    listed = ", ".join(names[:6]) + (" and others" if len(names) > 6 else "")
    return f"tag{'s' * (len(names) > 1)} {listed}"


def _shown(camera: Camera, corners: Array, T: Array) -> np.ndarray:
    """Which corners are in front of the camera, and in the image's inner part."""
    points = corners @ T[:3, :3].T + T[:3, 3]
    ahead = points[:, 2] > 0.0
    pixels = camera.project(np.where(ahead[:, None], points, [0.0, 0.0, 1.0]))
    size = np.array([camera.width, camera.height])
    within = ((pixels > EDGE * size) & (pixels < (1.0 - EDGE) * size)).all(axis=1)
    return np.asarray(ahead & camera.inside(pixels) & within)


def _lines(board: Charuco, seen: np.ndarray, expected: np.ndarray) -> str:
    """Rows at the top and bottom and columns at the left and right of which no corner was seen."""
    shape = (board.rows - 1, board.columns - 1)
    seen_there, expected_there = seen.reshape(shape), expected.reshape(-1, *shape)
    parts = []
    sides = (("the upper", 1, False), ("the lowest", 1, True), ("the left", 2, False), ("the right", 2, True))
    left = {1: shape[0], 2: shape[1]}
    for words, axis, is_last in sides:
        lines = seen_there.any(axis=2 - axis)
        shown = expected_there.all(axis=3 - axis).sum(axis=0) >= LEAST_IMAGES
        unseen = ~lines & shown
        unseen = unseen[::-1] if is_last else unseen
        count = len(unseen) if unseen.all() else int(np.argmin(unseen))
        if 0 < count < len(unseen):
            left[axis] -= count
            what = "row" if axis == 1 else "column"
            parts.append(f"{words} {count} {what}{'s' * (count > 1)} of corners")
    if not parts:
        return ""
    return f"{' and '.join(parts)} (if they are not there, write squares: [{left[2] + 1}, {left[1] + 1}])"
