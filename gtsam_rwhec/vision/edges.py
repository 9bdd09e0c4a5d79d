"""Corners of tags from their edges.

A corner detector's window holds a right angle, and blur rounds it: the corner moves inwards, by tenths of a pixel, all
four alike, so that the tag looks smaller and further away. A straight edge stays where it is under any symmetric blur.
So: the edge's place across a number of profiles along each side, a line through them in undistorted coordinates, and
the corners where the lines meet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.poses import Array
from gtsam_rwhec.vision.camera import Camera
from gtsam_rwhec.vision.images import Gray

#: Profiles along a side, over this part of it (near the corners two edges mix).
PROFILES, PART = 18, (0.12, 0.88)
#: Samples across an edge.
SAMPLES = 13
#: How far a profile reaches inwards and outwards, in modules of the tag, and in pixels at most. Inwards the code may be
#: white a module away and must not blur into it; outwards the paper may end.
INWARDS, OUTWARDS, REACH_PX = 0.55, 0.7, 5.0
ROUNDS = 2
#: Points further from their line than this many times the median are an occluder's.
GROSS = 3.5


@dataclass(frozen=True)
class RefinedCorners:
    """Corners of N tags.

    Attributes
    ----------
    corners_px : (N, 4, 2) array
        nan where the edges were not found.
    blur_px : (N,) array
        Standard deviation of the blur across the edges.
    """

    corners_px: Array
    blur_px: Array


def refine_corners(
    images: Sequence[Gray], image_of: np.ndarray, corners_px: Array, camera: Camera, modules: int
) -> RefinedCorners:
    """Refine corners of tags that are dark on light, of several images at once.

    Parameters
    ----------
    images : sequence of (height, width) uint8
        Of one size.
    image_of : (N,) integers
        Each tag's.
    corners_px : (N, 4, 2) array
        In order around the tag, within a pixel or two.
    camera : Camera
    modules : int
        Along a side, borders included: how far a profile may reach inwards before it meets the code.
    """
    corners = corners_px.copy()
    blur = np.full(len(corners), np.nan)
    stack = np.stack(images)
    for _ in range(ROUNDS if len(corners) else 0):
        corners, blur = _once(stack, image_of, corners, camera, modules)
    return RefinedCorners(corners, blur)


def _once(stack: Gray, image_of: np.ndarray, corners: Array, camera: Camera, modules: int) -> tuple[Array, Array]:
    start, end = corners, np.roll(corners, -1, axis=1)  # side k: corner k to k + 1
    along = end - start
    length = np.linalg.norm(along, axis=2, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        along = along / length
    normal = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    middle = corners.mean(axis=1, keepdims=True)
    outward = np.sign(np.einsum("nki,nki->nk", normal, 0.5 * (start + end) - middle))
    normal *= outward[..., None]
    share = np.linspace(*PART, PROFILES)
    # Across a slanted tag there is less than its sides are long: its area over the longest.
    with np.errstate(invalid="ignore", divide="ignore"):
        module = _area(corners) / length[..., 0].max(axis=1) / modules  # (N,)
    inwards, outwards = np.minimum(INWARDS * module, REACH_PX), np.minimum(OUTWARDS * module, REACH_PX)
    reach = (inwards + outwards)[:, None, None]
    u = np.linspace(0.0, 1.0, SAMPLES)
    d = u * reach[..., 0] - inwards[:, None]
    foot = start[:, :, None] + share[:, None] * length[:, :, None] * along[:, :, None]  # (N, 4, P, 2)
    # (N, 4, P, S, 2): from inside the dark border outwards
    points = foot[:, :, :, None] + d[:, None, None, :, None] * normal[:, :, None, None]
    profile = _sampled(stack, image_of, points)
    dark, light = profile[..., 0], profile[..., -2:].mean(axis=-1)
    contrast = light - dark  # (N, 4, P)
    # Black is as black all along a side, and one sample alone is noisy; white is as white as the light makes it there.
    black = np.median(dark, axis=2, keepdims=True)[..., None]
    with np.errstate(invalid="ignore", divide="ignore"):
        rise = (profile - black) / (light[..., None] - black)
        # The area under the rise tells where a step with the same plateaus would be, whatever its (symmetric) blur.
        area = (rise.sum(axis=-1) - 0.5 * (rise[..., 0] + rise[..., -1])) / (SAMPLES - 1)
        place = 1.0 - area  # in units of reach, from its inner end
        # The rise is the blur's distribution function: its variance is the second moment of its differences.
        centres = 0.5 * (u[1:] + u[:-1])
        mass = np.diff(rise, axis=-1)
        variance = (mass * (centres - place[..., None]) ** 2).sum(axis=-1)
    half = 0.5 * np.median(np.maximum(contrast, 0.0), axis=(1, 2), keepdims=True)
    with np.errstate(invalid="ignore"):
        good = (contrast > np.maximum(half, 8.0)) & (place > 0.1) & (place < 0.9)
    off = np.where(good, place, 0.0) * reach - inwards[:, None, None]
    edge = foot + off[..., None] * normal[:, :, None]
    lines = _lines(camera.undistort(edge), good)  # (N, 4, 3)
    # Corner k is where side k - 1 meets side k: the cross product of two lines.
    met = np.cross(np.roll(lines, 1, axis=1), lines)
    with np.errstate(invalid="ignore", divide="ignore"):
        refined = camera.pixels(met[..., :2] / met[..., 2:])
    # Further than the profiles reach, nothing was seen.
    moved = np.linalg.norm(refined - corners, axis=-1).max(axis=1)
    refined = np.where((moved[:, None, None] < reach + 0.5), refined, np.nan)
    middle_one = _median(np.where(good, variance, np.inf).reshape(len(corners), -1), good.sum(axis=(1, 2)))
    with np.errstate(invalid="ignore"):
        blur = np.sqrt(np.maximum(middle_one, 0.0)) * reach[:, 0, 0]
    return refined, blur


def _median(values: Array, count: np.ndarray) -> Array:
    """(...) medians of the first `count` of values (..., n) by size; the others are infinite."""
    middle = np.maximum((count - 1) // 2, 0)[..., None]
    median: Array = np.take_along_axis(np.sort(values, axis=-1), middle, axis=-1)[..., 0]
    return median


def _area(corners: Array) -> Array:
    """(N,) areas of quadrangles (N, 4, 2), pixels^2: half the cross product of the diagonals."""
    first, second = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    area: Array = 0.5 * np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    return area


def _sampled(stack: Gray, image_of: np.ndarray, points: Array) -> Array:
    """Bilinear gray values at points (N, ..., 2) of each one's image; borders go on outside.

    (cv2.remap rounds places to 1/32 of a pixel.)
    """
    _, height, width = stack.shape
    x = np.clip(np.nan_to_num(points[..., 0]), 0.0, width - 1.001)
    y = np.clip(np.nan_to_num(points[..., 1]), 0.0, height - 1.001)
    column, row = x.astype(np.intp), y.astype(np.intp)
    at = (image_of[:, None, None, None] * height + row) * width + column
    flat = stack.ravel()
    x, y = x - column, y - row
    upper = flat[at] * (1.0 - x) + flat[at + 1] * x
    lower = flat[at + width] * (1.0 - x) + flat[at + width + 1] * x
    values: Array = upper * (1.0 - y) + lower * y
    return values


def _lines(x: Array, good: np.ndarray) -> Array:
    """Homogeneous lines (N, 4, 3) through normalised points (N, 4, P, 2); nan where too few are good."""
    weight = np.where(good & np.isfinite(x).all(axis=-1), 1.0, 0.0)
    x = np.nan_to_num(x)
    for _ in range(3):
        total = weight.sum(axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = (weight[..., None] * x).sum(axis=-2) / total[..., None]
        off = np.nan_to_num(x - mean[..., None, :])
        C = np.einsum("nkp,nkpi,nkpj->nkij", weight, off, off)
        # The direction of least spread of a 2 x 2 matrix, in closed form.
        angle = 0.5 * np.arctan2(2.0 * C[..., 0, 1], C[..., 0, 0] - C[..., 1, 1]) + 0.5 * np.pi
        normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        distance = np.abs(np.einsum("nkpi,nki->nkp", off, normal))
        spread = _median(np.where(weight > 0.0, distance, np.inf), total.astype(int))[..., None]
        weight = np.where(distance <= GROSS * 1.4826 * spread + 1e-12, weight, 0.0)
    enough = weight.sum(axis=-1) >= PROFILES // 3
    lines = np.concatenate([normal, -np.einsum("nki,nki->nk", normal, np.nan_to_num(mean))[..., None]], axis=-1)
    return np.where(enough[..., None], lines, np.nan)
