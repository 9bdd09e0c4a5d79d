"""Corners of tags from their edges.

A corner detector's window holds a right angle, and blur rounds it: the corner moves inwards, by tenths of a pixel, all
four alike, so that the tag looks smaller and further away. A straight edge stays where it is under any symmetric blur.
So: the edge's place across a number of profiles along each side, a line through them in undistorted coordinates, and
the corners where the lines meet. First by the area under each profile, which needs no start; then by a model of the
neighbours that blur into it (`edge_profiles`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.camera import Camera
from gtsam_rwhec.vision.edge_geometry import area, crossings, from_unit_square, lines_through, mapped, median, sampled
from gtsam_rwhec.vision.edge_profiles import fit_profiles
from gtsam_rwhec.vision.images import Gray

#: Profiles along a side, over this part of it (near the corners two edges mix), and how many must be good.
PROFILES, PART, LEAST = 18, (0.12, 0.88), 6
#: Samples across an edge.
SAMPLES = 13
#: How far a first profile reaches inwards and outwards, in modules of the tag, and in pixels at most. Inwards the code
#: may be white a module away and must not blur into it; outwards the paper may end.
INWARDS, OUTWARDS, REACH_PX = 0.55, 0.7, 5.0
#: As far in modules where the model is, which knows of both; and at most so many standard deviations of the blur, and
#: pixels more.
MODEL_INWARDS, MODEL_OUTWARDS, BLURS, MORE_PX = 1.1, 0.9, 3.5, 1.5
#: Of areas, and of the model.
ROUNDS, MODEL_ROUNDS = 2, 3
#: The blur is at least this (pixels, a pixel's own), and at most so many modules: beyond, no code is read.
LEAST_BLUR_PX, MOST_BLUR = 0.35, 1.0
#: Of a profile, in units of its step: what the model may leave, and how high the step must be for it to count.
MOST_LEFT, LEAST_STEP, LEAST_GRAY = 0.15, 0.5, 8.0


@dataclass(frozen=True)
class RefinedCorners:
    """Corners of N tags.

    Attributes
    ----------
    corners_px : (N, 4, 2) array
        nan where the edges were not found.
    blur_px : (N,) array
        Standard deviation of the blur across the edges, of the side where it is largest; a pixel's own is in it.
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
    if len(corners) == 0:
        return RefinedCorners(corners, blur)
    for _ in range(ROUNDS):
        corners, blur = _by_areas(stack, image_of, corners, camera, modules)
    state = _Edges(corners, np.repeat(np.clip(np.nan_to_num(blur, nan=1.0), 0.5, 3.0)[:, None], 4, axis=1), None)
    for _ in range(MODEL_ROUNDS):
        state = _by_model(stack, image_of, state, camera, modules)
    return RefinedCorners(
        state.corners_px, np.where(np.isfinite(state.corners_px[:, 0, 0]), state.blur_px.max(axis=1), np.nan)
    )


@dataclass(frozen=True, eq=False)
class _Edges:
    """Corners (N, 4, 2), the blur across each side (N, 4), pixels, and how much lighter the paper is (N,)."""

    corners_px: Array
    blur_px: Array
    step: Array | None


def _by_areas(stack: Gray, image_of: np.ndarray, corners: Array, camera: Camera, modules: int) -> tuple[Array, Array]:
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
        module = area(corners) / length[..., 0].max(axis=1) / modules  # (N,)
    inwards, outwards = np.minimum(INWARDS * module, REACH_PX), np.minimum(OUTWARDS * module, REACH_PX)
    reach = (inwards + outwards)[:, None, None]
    u = np.linspace(0.0, 1.0, SAMPLES)
    d = u * reach[..., 0] - inwards[:, None]
    foot = start[:, :, None] + share[:, None] * length[:, :, None] * along[:, :, None]  # (N, 4, P, 2)
    # (N, 4, P, S, 2): from inside the dark border outwards
    points = foot[:, :, :, None] + d[:, None, None, :, None] * normal[:, :, None, None]
    profile = sampled(stack, image_of, points)
    dark, light = profile[..., 0], profile[..., -2:].mean(axis=-1)
    contrast = light - dark  # (N, 4, P)
    # Black is as black all along a side, and one sample alone is noisy; white is as white as the light makes it there.
    black = np.median(dark, axis=2, keepdims=True)[..., None]
    with np.errstate(invalid="ignore", divide="ignore"):
        rise = (profile - black) / (light[..., None] - black)
        # The area under the rise tells where a step with the same plateaus would be, whatever its (symmetric) blur.
        place = 1.0 - (rise.sum(axis=-1) - 0.5 * (rise[..., 0] + rise[..., -1])) / (
            SAMPLES - 1
        )  # in units of reach, from its inner end
        # The rise is the blur's distribution function: its variance is the second moment of its differences.
        centres = 0.5 * (u[1:] + u[:-1])
        mass = np.diff(rise, axis=-1)
        variance = (mass * (centres - place[..., None]) ** 2).sum(axis=-1)
    half = 0.5 * np.median(np.maximum(contrast, 0.0), axis=(1, 2), keepdims=True)
    with np.errstate(invalid="ignore"):
        good = (contrast > np.maximum(half, LEAST_GRAY)) & (place > 0.1) & (place < 0.9)
    off = np.where(good, place, 0.0) * reach - inwards[:, None, None]
    edge = foot + off[..., None] * normal[:, :, None]
    refined = _corners(camera, edge, good)
    # Further than the profiles reach, nothing was seen.
    moved = np.linalg.norm(refined - corners, axis=-1).max(axis=1)
    refined = np.where((moved[:, None, None] < reach + 0.5), refined, np.nan)
    middle_one = median(np.where(good, variance, np.inf).reshape(len(corners), -1), good.sum(axis=(1, 2)))
    with np.errstate(invalid="ignore"):
        blur = np.sqrt(np.maximum(middle_one, 0.0)) * reach[:, 0, 0]
    return refined, blur


def _corners(camera: Camera, edge: Array, good: np.ndarray) -> Array:
    """(N, 4, 2) where lines through the good ones of points on edges (N, 4, P, 2) meet, in undistorted coordinates."""
    with np.errstate(invalid="ignore", over="ignore"):
        return camera.pixels(crossings(lines_through(camera.undistort(edge), good, LEAST)))


def _by_model(stack: Gray, image_of: np.ndarray, edges: _Edges, camera: Camera, modules: int) -> _Edges:
    """One round from edges that are right to a pixel."""
    x = camera.undistort(edges.corners_px)
    # Of each side: the square that it is the first side of.
    H = from_unit_square(np.stack([np.roll(x, -k, axis=1) for k in range(4)], axis=1))
    share = np.linspace(*PART, PROFILES)
    foot, inner = (camera.pixels(mapped(H, share, y)) for y in (0.0, 1.0 / modules))  # (N, 4, P, 2)
    with np.errstate(invalid="ignore", divide="ignore"):
        along = camera.pixels(mapped(H, share + 0.01, 0.0)) - camera.pixels(mapped(H, share - 0.01, 0.0))
        along /= np.linalg.norm(along, axis=-1, keepdims=True)
        normal = np.stack([along[..., 1], -along[..., 0]], axis=-1)
        module = np.einsum("nkpi,nkpi->nkp", foot - inner, normal)
        normal *= np.sign(module)[..., None]
        module = np.clip(np.nan_to_num(np.abs(module), nan=1.0), 0.1, 1e3)
    blur = np.repeat(edges.blur_px[..., None], PROFILES, axis=2)
    inwards, outwards = (
        np.minimum(reach * module, BLURS * blur + MORE_PX)[..., None] for reach in (MODEL_INWARDS, MODEL_OUTWARDS)
    )
    places = -inwards + (inwards + outwards) * np.linspace(0.0, 1.0, SAMPLES)  # (N, 4, P, S)
    values = sampled(stack, image_of, foot[..., None, :] + places[..., None] * normal[..., None, :])
    rough = np.median(values[..., -3] - values[..., 2], axis=(1, 2)) if edges.step is None else edges.step
    step = np.asarray(np.maximum(rough, LEAST_GRAY))
    fitted = fit_profiles(values, places, module, blur, np.broadcast_to(step[:, None, None], module.shape))
    with np.errstate(invalid="ignore"):
        good = (fitted.step > LEAST_STEP * step[:, None, None]) & (fitted.rms < MOST_LEFT)
        good &= np.abs(fitted.shift) < np.minimum(0.6 * module, 2.5 * blur + 1.0)
    edge = foot + np.where(good, fitted.shift, 0.0)[..., None] * normal
    refined = _corners(camera, edge, good)
    count = good.sum(axis=2)
    wider = np.where(count > 0, median(np.where(good, fitted.wider, np.inf), count), 0.0)
    change = np.clip(np.where(np.isfinite(wider), wider, 0.0), -0.5 * edges.blur_px, 0.5 * edges.blur_px)
    widest = np.maximum(MOST_BLUR * np.median(module, axis=2), LEAST_BLUR_PX)
    height = median(np.where(good, fitted.step, np.inf).reshape(len(step), -1), good.sum(axis=(1, 2)))
    return _Edges(
        refined,
        np.clip(edges.blur_px + change, LEAST_BLUR_PX, widest),
        np.where(np.isfinite(height), height, step),
    )
