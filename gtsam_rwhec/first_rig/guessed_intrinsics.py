"""Intrinsics of a camera without any: from its views of a board, or a guess for a person to replace."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from gtsam_rwhec.files.rounded_numbers import rounded
from gtsam_rwhec.first_rig.boards_seen import BoardSeen
from gtsam_rwhec.rig.intrinsics_section import Intrinsics
from gtsam_rwhec.vision.zhang import fitted_to_planes

#: Beside intrinsics that were found: who calibrated the camera says so.
STATED = "stated: calibration if this camera was calibrated, with this lens and focus"
#: A board's views determine a focal length with at least this number of images.
LEAST_IMAGES = 6
#: Focal lengths, over the images' width, that lenses on robots have.
SHORTEST, LONGEST = 0.25, 6.0
#: A pinhole that fits worse than this (pixels) is not the camera.
LARGEST_RMS_PX = 1.5
#: The focal length over the width where nothing tells it: about 60 degrees across.
USUAL = 0.87


@dataclass(frozen=True)
class GuessedIntrinsics:
    """A pinhole, and the comment beside it; ``TODO`` is in it where a person must state another."""

    section: Intrinsics
    words: str


def guessed_intrinsics(size: tuple[int, int], boards: Iterable[BoardSeen]) -> GuessedIntrinsics:
    """A pinhole without distortion of images of this size (width, height) that saw some boards."""
    width, height = size
    for seen in boards:
        if len(seen.images) < LEAST_IMAGES:
            continue
        corners = seen.board.corners()
        fitted = fitted_to_planes([corners[indices] for indices in seen.indices], seen.corners_px, size, "none")
        if fitted is None:
            continue
        fx, fy, cx, cy = (float(fitted.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        is_lens = all(SHORTEST * width < f < LONGEST * width for f in (fx, fy)) and 0 < cx < width and 0 < cy < height
        if is_lens and fitted.rms_px < LARGEST_RMS_PX:
            numbers = (round(fx, 1), round(fy, 1), round(cx, 1), round(cy, 1))
            return GuessedIntrinsics(
                Intrinsics(K=numbers, size=size),
                f"a guess: no file has them; a pinhole that fits {len(seen.images)} views of the board to "
                f"{rounded(fitted.rms_px, 2)} px. A calibration of the camera is better",
            )
    K = (round(USUAL * width, 1), round(USUAL * width, 1), 0.5 * (width - 1), 0.5 * (height - 1))
    return GuessedIntrinsics(
        Intrinsics(K=K, size=size),
        "TODO no file has them, and this is a usual lens: calibrate the camera, intrinsics: FILE",
    )
