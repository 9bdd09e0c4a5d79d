"""Whether a board's tags are where the rig file has them: each tag's place, turn and size, and the gap of a grid.

All images of a track see one board: a mistake of the rig file moves the corners equally in all of them, in the board's
frame. Each hypothesis moves corners by G theta in that frame; theta is estimated with all poses, and tested against its
scatter between the views. Also: which parts of a board no image shows, although the images cover their places.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.intrinsics_evidence import change_test, different
from gtsam_rwhec.cameras.targets import Charuco, Target
from gtsam_rwhec.cameras.unknown_intrinsics import board_rows, poses_eliminated
from gtsam_rwhec.files.terminal_text import counted, some
from gtsam_rwhec.geometry.poses import Array

#: A hypothesis needs this many views that show moved corners beside other corners.
LEAST_VIEWS = 6
#: Rounds of Gauss-Newton.
ROUNDS = 6
#: Corners have at least this standard deviation, pixels.
LEAST_PX = 0.02
#: A shape does not fit if scatter explains the change with at most this probability (of all hypotheses together), and
#: residuals are larger by at least this factor.
LEAST_PROBABILITY, LARGER = 1e-4, 1.1
#: A change counts beyond two standard deviations, above this length (metres), this share of the board's extent, and
#: these pixels (all three): printed ink and a camera's gamma move a tag's edges by some hundredths of a pixel.
LEAST_M, LEAST_SHARE, LEAST_MOVED_PX = 0.0003, 0.003, 0.15
#: Above both of these, the poses are useless.
USELESS_M, USELESS_SHARE = 0.001, 0.01

#: A hypothesis: what is moved, and the number of the tag.
Key: TypeAlias = tuple[str, int]


@dataclass(frozen=True, eq=False)
class BoardView:
    """Corners of a board in an image: their numbers (m,), pixels (m, 2), and T_camera_board (4, 4)."""

    indices: np.ndarray
    corners_px: Array
    T: Array


@dataclass(frozen=True, eq=False)
class ShapeEvidence:
    """What the views say about one hypothesis."""

    key: Key  #: The hypothesis
    #: (q,): the numbers that fit best, and their standard deviations
    theta: Array
    sigma: Array
    moved_m: float  #: Largest distance by which a corner is moved, less two standard deviations; metres
    #: The same in the median view, pixels; for a gap its change, since the tags' edges beside the gap show it
    moved_px: float
    #: Root mean squares of the reprojection errors, pixels, each with the poses that fit best
    stated_px: float
    fitted_px: float
    probability: float  #: Probability that a board of the stated shape leads to so large a change
    views: int
    extent_m: float  #: Largest side of the box around the board, metres

    @property
    def contradicts(self) -> bool:
        """Whether the stated shape does not fit the corners: the difference is significant and matters."""
        return (
            self.probability < LEAST_PROBABILITY
            and self.stated_px > LARGER * self.fitted_px
            and self.moved_m > max(LEAST_M, LEAST_SHARE * self.extent_m)
            and self.moved_px > LEAST_MOVED_PX
        )

    @property
    def is_far_off(self) -> bool:
        """Whether the shape is so wrong that the poses are useless for a calibration."""
        return self.moved_m > max(USELESS_M, USELESS_SHARE * self.extent_m)


def evidence_of_shape(
    camera: Camera, corners: Array, hypotheses: Mapping[Key, Array], views: Sequence[BoardView]
) -> ShapeEvidence | None:
    """Return the hypothesis that fits the views best; None if none of them can be tested.

    ``corners`` (n, 3) are the board's as stated, metres; ``hypotheses`` (n, 3, q) say by how much each corner moves for
    each of the q numbers of a hypothesis. Only views of different poses count.
    """
    views = [views[i] for i in different([view.T for view in views])]
    if len(views) < LEAST_VIEWS:
        return None
    pixels = np.zeros((len(views), len(corners), 2))
    known = np.zeros((len(views), len(corners)), dtype=bool)
    for i, view in enumerate(views):
        pixels[i, view.indices], known[i, view.indices] = view.corners_px, True
    T = np.array([view.T for view in views])
    found = []
    for key, G in hypotheses.items():
        moves = G.any(axis=(1, 2))
        # The place of a tag needs other corners in the view. A gap moves all tags of a grid against each other.
        beside = (known & ~moves).sum(axis=1) >= 4 if moves.sum() <= 4 else known.sum(axis=1) >= 8
        told = np.flatnonzero(beside & (known & moves).any(axis=1))
        if len(told) >= max(LEAST_VIEWS, G.shape[2] + 3):
            one = _tested(camera, corners, G, key, T[told], pixels[told], known[told], len(hypotheses))
            found += [] if one is None else [one]
    return max(found, key=_gain, default=None)


def _gain(found: ShapeEvidence) -> float:
    """By how much the hypothesis fits better: the logarithm of the ratio of residuals, for each view."""
    return found.views * float(np.log(found.stated_px / found.fitted_px))


def _tested(
    camera: Camera, corners: Array, G: Array, key: Key, T: Array, u: Array, known: np.ndarray, tries: int
) -> ShapeEvidence | None:
    stated = _fitted(camera, corners, G, T, u, known, is_free=False)
    fitted = None if stated is None else _fitted(camera, corners, G, stated.T, u, known, is_free=True)
    if stated is None or fitted is None:
        return None
    n, q, count = len(T), G.shape[2], int(known.sum())
    freedom = max(2 * count - 6 * n - q, 1)
    variance = max(fitted.rms_px**2 * count / freedom, LEAST_PX**2)
    by_chance, sigma = change_test(fitted.theta, fitted.H, fitted.parts, variance, freedom)
    probability = tries * by_chance
    surely = np.sign(fitted.theta) * np.maximum(np.abs(fitted.theta) - 2.0 * sigma, 0.0)
    moved = float(np.linalg.norm(G @ surely, axis=1).max())
    px_per_m = camera.focal_px / float(np.median(T[:, 2, 3]))
    extent = float(np.ptp(corners, axis=0).max())
    moved_px = px_per_m * (abs(float(surely[0])) if key[0] == "gap" else moved)
    return ShapeEvidence(
        key, fitted.theta, sigma, moved, moved_px, stated.rms_px, fitted.rms_px, min(probability, 1.0), n, extent
    )


@dataclass(frozen=True, eq=False)
class _Fit:
    """Poses and theta at the minimum; H (q, q) and gradients (views, q) of theta, with the poses eliminated."""

    T: Array
    theta: Array
    rms_px: float
    H: Array
    parts: Array


def _fitted(
    camera: Camera, corners: Array, G: Array, T: Array, u: Array, known: np.ndarray, *, is_free: bool
) -> _Fit | None:
    """Gauss-Newton on all poses, and on theta if it is free; None if it does not converge."""
    q = G.shape[2]
    theta = np.zeros(q)
    for round_ in range(ROUNDS + 1):
        r, J, by_place, _ = board_rows(camera, T, corners + G @ theta, u, known)
        if not np.isfinite(r).all():
            return None
        try:
            H, parts, solved = poses_eliminated(r, J, (by_place @ G).reshape(len(T), -1, q))
            step = -np.linalg.solve(H, parts.sum(axis=0)) if is_free else np.zeros(q)
        except np.linalg.LinAlgError:
            return None
        if round_ == ROUNDS:
            break
        T = T @ se3.expmap(-(solved[..., q] + solved[..., :q] @ step))
        theta = theta + step
    if np.linalg.cond(H) > 1e12:
        return None
    return _Fit(T, theta, float(np.sqrt((r**2).sum() / known.sum())), H, parts)


#: A part counts as never seen if this number of images cover its place and do not show it.
LEAST_IMAGES = 5
#: Places count within the image, by this share of its width and height from its edges.
EDGE = 0.05
#: A part faces the camera if the cosine between its normal and the line of sight is at least this.
LEAST_FACING = 0.5


def never_seen(board: Target, camera: Camera, views: Sequence[BoardView]) -> str:
    """Name the parts of a board of tags that no image shows; "" if nothing is missing.

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
    return f"tag{'s' * (len(names) > 1)} {some(names, 6)}"


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
            parts.append(f"{words} {counted(count, what)} of corners")
    if not parts:
        return ""
    return f"{' and '.join(parts)} (if they are not there, write squares: [{left[2] + 1}, {left[1] + 1}])"
