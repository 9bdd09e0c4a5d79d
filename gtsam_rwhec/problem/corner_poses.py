"""Each image's pose of a target by its corners alone: what a problem with corners measures.

A flat board has two poses in an image that look nearly alike. All images that are added together choose, by the
carriers' poses: the target turns against the camera as the carriers turn against each other (`vision.ambiguity`), as
in logs. `nearer_poses` chooses again by an answer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import CameraError, TargetError
from gtsam_rwhec.geometry.poses import Array

#: Corners do not belong to a board where they miss it by this share of its extent in the image, in half of the images.
FARTHEST = 0.2
SECOND_NS = 1_000_000_000


@dataclass(frozen=True, eq=False)
class Candidates:
    """Poses of N images: T (N, 2, 4, 4), metres, the second nan where there is one; squared_px (N, 2); covariance
    (N, 2, 6, 6), rotation first, right perturbation."""

    T: Array
    squared_px: Array
    covariance: Array
    corner_px: float

    def chosen(self, which: np.ndarray) -> tuple[Array, Array]:
        """Poses (N, 4, 4) and covariances (N, 6, 6) of chosen candidates (N,)."""
        at = np.arange(len(which))
        return self.T[at, which], self.covariance[at, which]

    def by_carriers(self, A: Array) -> np.ndarray:
        """The candidates (N,) that agree with the carriers' poses A (N, 4, 4) over all images."""
        from gtsam_rwhec.cameras.plane_ambiguity import choose_over_time

        order = SECOND_NS * np.arange(len(A))  # neighbours are compared whatever time is between them: A is known
        return choose_over_time(order, self.T, self.squared_px, self.covariance, self.corner_px, A).which

    def nearer(self, predicted: Array) -> np.ndarray:
        """The candidates (N,) whose rotations are nearer to predicted poses T_sensor_target (N, 4, 4)."""
        off = np.linalg.norm(self.T[:, :, :3, :3] - predicted[:, None, :3, :3], axis=(2, 3))
        return np.asarray(np.argmin(np.where(np.isnan(off), np.inf, off), axis=1))


def candidates_of(camera: Camera, board: Array, pixels: Array, corner_px: float, where: str) -> Candidates:
    """Both poses of each image from corners (N, n, 2) of a board (n, 3).

    Raises
    ------
    CameraError
        The lens model has no ray for a corner, or an image has no pose.
    TargetError
        The corners do not belong to the board.
    """
    from gtsam_rwhec.cameras.target_poses import plane_poses

    known = np.asarray(np.isfinite(pixels).all(axis=2))
    found = plane_poses(
        camera,
        [board[seen] for seen in known],
        [corners[seen] for corners, seen in zip(pixels, known, strict=True)],
        corner_px=corner_px,
    )
    lost = np.flatnonzero(~np.isfinite(found.squared_px[:, 0]))
    _check_rays(lost, camera, pixels, known, where)
    extent = np.sqrt(np.nanvar(np.where(known[..., None], pixels, np.nan), axis=1).sum(axis=1))
    off = np.nan_to_num(found.reprojection_px[:, 0], nan=np.inf) / extent
    if np.median(off) > FARTHEST:
        missed = f"miss it by {100.0 * np.median(off):.0f} % of its size or more" if np.isfinite(np.median(off)) else ""
        raise TargetError(
            f"{where}: the corners do not belong to the board: half of the images {missed or 'have no pose of it'}; "
            "give image_points in the order of board_points, and check its numbers of rows and columns, and whether "
            "it is another board"
        )
    if lost.size:
        raise CameraError(f"{where}: the corners of image {lost[0]} have no pose; are they on one line?")
    return Candidates(found.T, found.squared_px, found.covariance, corner_px)


def _check_rays(images: np.ndarray, camera: Camera, pixels: Array, known: np.ndarray, where: str) -> None:
    """A CameraError where the lens model has no ray for a corner of some images."""
    dark = known[images] & ~np.isfinite(camera.undistort(pixels[images])).all(axis=2)
    if dark.any():
        image, corner = np.argwhere(dark)[0]
        x, y = pixels[images[image], corner]
        raise CameraError(
            f"{where}: the lens model ({camera.model}) has no ray for corner {corner} of image {images[image]} at "
            f"({x:.1f}, {y:.1f}): its distortion folds back there. Check D, give another model, or leave such corners "
            "out (nan)"
        )
