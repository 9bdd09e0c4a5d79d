"""Intrinsics of a camera without any: from its views of a board, or a guess for a person to replace."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.unknown_intrinsics import estimated_intrinsics
from gtsam_rwhec.errors import CameraError
from gtsam_rwhec.files.rounded_numbers import rounded
from gtsam_rwhec.first_rig.boards_seen import BoardSeen
from gtsam_rwhec.rig.intrinsics_section import Intrinsics

#: Beside intrinsics that were found: who calibrated the camera says so.
STATED = "stated: calibration if this camera was calibrated, with this lens and focus"
#: A board's views determine a focal length with at least this number of images.
LEAST_IMAGES = 6
#: Focal lengths, over the images' width, that lenses on robots have.
SHORTEST, LONGEST = 0.25, 6.0
#: A camera that fits worse than this (pixels) is not the one.
LARGEST_RMS_PX = 1.5
#: The focal length over the width where nothing tells it: about 60 degrees across.
USUAL = 0.87


@dataclass(frozen=True)
class GuessedIntrinsics:
    """What the rig file has, the comment beside it (with ``TODO`` where a person must state another), and a camera."""

    section: Intrinsics
    words: str
    camera: Camera


def guessed_intrinsics(size: tuple[int, int], boards: Iterable[BoardSeen]) -> GuessedIntrinsics:
    """Intrinsics for images of this size (width, height) that saw some boards.

    Where a board determines them the rig file leaves them to be estimated: the calibration has more images than were
    looked at here, and frees the lens with the poses.
    """
    width, height = size
    for seen in boards:
        if len(seen.images) < LEAST_IMAGES:
            continue
        corners = seen.board.corners()
        try:
            fitted = estimated_intrinsics([corners[indices] for indices in seen.indices], seen.corners_px, size)
        except CameraError:
            continue
        (fx, fy), (cx, cy) = np.diagonal(fitted.camera.K)[:2], fitted.camera.K[:2, 2]
        is_lens = all(SHORTEST * width < f < LONGEST * width for f in (fx, fy)) and 0 < cx < width and 0 < cy < height
        if is_lens and fitted.rms_px < LARGEST_RMS_PX:
            return GuessedIntrinsics(
                Intrinsics(estimate="any"),
                f"no file has them: the images say them ({fitted.views} views of the board: f = {0.5 * (fx + fy):.0f} "
                f"px, to {rounded(fitted.rms_px, 2)} px). If the camera was calibrated, a file is better",
                fitted.camera,
            )
    K = (round(USUAL * width, 1), round(USUAL * width, 1), 0.5 * (width - 1), 0.5 * (height - 1))
    section = Intrinsics(K=K, size=size)
    return GuessedIntrinsics(
        section,
        "TODO no file has them, and this is a usual lens: calibrate the camera, intrinsics: FILE, or take images of a "
        "board, intrinsics: estimate",
        section.camera_of_numbers("a first guess"),
    )
