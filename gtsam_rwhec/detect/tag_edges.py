"""Corners of tags from their edges.

Blur rounds the right angle in a corner detector's window: all four corners move inwards by tenths of a pixel, and the
tag looks smaller and further away. A straight edge stays where it is under any symmetric blur. Therefore each side is
found in profiles across it, a line is fitted to each side in undistorted coordinates, and the lines meet in the
corners. The area under each profile gives a first place of the edge; then a model of the edge's neighbours, which blur
into it, gives the place (`fit_profiles`): the code's cell, one module of black border, one module of paper, and what is
beyond. Last, the border's inner edges tell by how much all edges moved towards black or white, by gamma or by ink.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.geometry.poses import Array

#: A point is of something in front of the tag if its distance from the line is above this times 1.4826 of the median.
GROSS = 3.5


def median(values: Array, count: np.ndarray) -> Array:
    """Medians (...) of values (..., n); the last n - count values by size are infinite and do not count."""
    middle = np.maximum((count - 1) // 2, 0)[..., None]
    return np.take_along_axis(np.sort(values, axis=-1), middle, axis=-1)[..., 0]


def area(corners: Array) -> Array:
    """Areas (N,) of quadrangles (N, 4, 2), pixels^2: half the cross product of the diagonals."""
    first, second = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    return 0.5 * np.abs(_cross(first, second))


def sampled(stack: Gray, image_of: np.ndarray, points: Array) -> Array:
    """Bilinear gray values at points (N, ..., 2), each point in its own image; the border's values go on outside.

    cv2.remap is not used, because it rounds places to 1/32 of a pixel.
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


def lines_through(x: Array, good: np.ndarray, least: int) -> Array:
    """Homogeneous lines (N, 4, 3) through points (N, 4, P, 2); nan where fewer than `least` points are good."""
    weight = np.where(good & np.isfinite(x).all(axis=-1), 1.0, 0.0)
    x = np.nan_to_num(x)
    for _ in range(3):
        total = weight.sum(axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = (weight[..., None] * x).sum(axis=-2) / total[..., None]
        off = np.nan_to_num(x - mean[..., None, :])
        C = np.einsum("nkp,nkpi,nkpj->nkij", weight, off, off)
        # A closed form gives the direction in which a 2 x 2 matrix has the smallest spread.
        angle = 0.5 * np.arctan2(2.0 * C[..., 0, 1], C[..., 0, 0] - C[..., 1, 1]) + 0.5 * np.pi
        normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        distance = np.abs(np.einsum("nkpi,nki->nkp", off, normal))
        spread = median(np.where(weight > 0.0, distance, np.inf), total.astype(int))[..., None]
        weight = np.where(distance <= GROSS * 1.4826 * spread + 1e-12, weight, 0.0)
    enough = weight.sum(axis=-1) >= least
    lines = np.concatenate([normal, -np.einsum("nki,nki->nk", normal, np.nan_to_num(mean))[..., None]], axis=-1)
    return np.where(enough[..., None], lines, np.nan)


def crossings(lines: Array) -> Array:
    """Corners (N, 4, 2) of homogeneous lines (N, 4, 3) along sides: sides k - 1 and k meet in corner k."""
    met = np.cross(np.roll(lines, 1, axis=1), lines)
    with np.errstate(invalid="ignore", divide="ignore"):
        corners: Array = met[..., :2] / met[..., 2:]
    return corners


def from_unit_square(corners: Array) -> Array:
    """Homographies (..., 3, 3) from (0, 0), (1, 0), (1, 1), (0, 1) to corners (..., 4, 2) (Heckbert 1989, 2.2.3)."""
    p0, p1, p2, p3 = np.moveaxis(corners, -2, 0)
    d1, d2, s = p1 - p2, p3 - p2, p0 - p1 + p2 - p3
    with np.errstate(invalid="ignore", divide="ignore"):
        g, h = _cross(s, d2) / _cross(d1, d2), _cross(d1, s) / _cross(d1, d2)
    H = np.ones((*corners.shape[:-2], 3, 3))
    H[..., :2, 0], H[..., :2, 1], H[..., :2, 2] = p1 - p0 + g[..., None] * p1, p3 - p0 + h[..., None] * p3, p0
    H[..., 2, 0], H[..., 2, 1] = g, h
    return H


def mapped(H: Array, x: Array, y: float) -> Array:
    """Points (..., P, 2) to which homographies (..., 3, 3) take (x, y), x (P,)."""
    places = H[..., None, :, 0] * x[:, None] + H[..., None, :, 1] * y + H[..., None, :, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        points: Array = places[..., :2] / places[..., 2:]
    return points


def _cross(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


#: Gray values beyond the border and beyond the paper have this prior standard deviation, in units of the edge's step.
BEYOND = 2.0
#: The edge's shift and the blur's change in one round have this prior standard deviation, in units of the blur.
SHIFT = 1.0
#: A sample has this noise, in units of the step. With so little noise the priors only separate columns that the samples
#: do not separate.
NOISE = 0.01


@dataclass(frozen=True, eq=False)
class Fitted:
    """Edges that were fitted to profiles (...); all arrays (...).

    The edge is `shift` further outwards and the blur `wider` than assumed, in the profiles' unit of length; the paper
    is lighter than the border by `step`; `rms` is the root mean square of the residuals, in units of the step.
    """

    shift: Array
    wider: Array
    step: Array
    rms: Array


def fit_profiles(values: Array, places: Array, module: Array, blur: Array, step: Array) -> Fitted:
    """Fit edges to profiles by one Gauss-Newton step from an edge at 0.

    Profiles are gray values (..., S) at places (..., S), from inside (negative) outwards. `module` (...) is the
    distance from the edge inwards to the code, `blur` (...) the blur's standard deviation, and `step` (...) about how
    much lighter the paper is than the border: a scale for the priors.
    """
    sigma = blur[..., None]
    z = places / sigma
    inner, outer = (places + module[..., None]) / sigma, (places - module[..., None]) / sigma
    bell = np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
    K = np.stack([np.ones_like(z), ndtr(z), ndtr(-inner), ndtr(outer), -bell, -z * bell], axis=-1)
    prior = np.array([0.0, 0.0, *[(NOISE / BEYOND) ** 2] * 2, *[(NOISE / SHIFT) ** 2] * 2])
    H = np.swapaxes(K, -1, -2) @ K + np.diag(prior) + 1e-9 * np.eye(6)
    y = values / step[..., None]
    c = np.linalg.solve(H, np.swapaxes(K, -1, -2) @ y[..., None])[..., 0]
    rms = np.sqrt(((np.einsum("...sk,...k->...s", K, c) - y) ** 2).mean(axis=-1))
    height = np.where(np.abs(c[..., 1]) > 1e-3, c[..., 1], np.nan)
    return Fitted(c[..., 4] / height * blur, c[..., 5] / height * blur, c[..., 1] * step, rms / np.abs(height))


#: A side has this number of profiles.
PROFILES = 18
#: Profiles lie in this part of a side, because two edges mix near the corners.
PART = (0.12, 0.88)
#: A line needs at least this number of good profiles.
LEAST = 6
#: A profile has this number of samples across an edge.
SAMPLES = 13
#: A first profile reaches this far inwards (modules): a white cell, one module away, must not blur into it.
INWARDS = 0.55
#: A first profile reaches this far outwards (modules), because the paper may end there.
OUTWARDS = 0.7
#: A first profile never reaches further than this (pixels).
REACH_PX = 5.0
#: The model's profiles reach this far inwards (modules), because the model contains the code.
MODEL_INWARDS = 1.1
#: The model's profiles reach this far outwards (modules), because the model contains the paper's end.
MODEL_OUTWARDS = 0.9
#: The model's profiles reach at most this many standard deviations of the blur, and `MORE_PX` further.
BLURS = 3.5
#: The model's profiles reach at most this many pixels beyond `BLURS`.
MORE_PX = 1.5
#: The edges are refined by areas in this number of rounds.
ROUNDS = 2
#: The edges are then refined by the model in this number of rounds.
MODEL_ROUNDS = 3
#: The blur is at least this (pixels): a pixel itself blurs so much.
LEAST_BLUR_PX = 0.35
#: The blur is at most this (modules): beyond it no code can be read.
MOST_BLUR = 1.0
#: A profile is good only if the root mean square of its residuals is at most this, in units of the step.
MOST_LEFT = 0.15
#: A profile is good only if its step is at least this share of the tag's step.
LEAST_STEP = 0.5
#: The inner edges of the border, beside the code's white cells, have this number of profiles for each cell, at these
#: places in it.
IN_CELL = np.array([0.35, 0.5, 0.65])
#: A cell is white if its step is at least this share of the tag's.
INNER_STEP = 0.7
#: A tag's edges are corrected if at least this number of inner profiles is good.
LEAST_INNER = 9
#: At most this correction, in units of the blur: more is no gamma, and no ink.
MOST_GROWN = 0.6
#: A tag needs a step of at least this, in gray values.
LEAST_GRAY = 8.0


@dataclass(frozen=True)
class RefinedCorners:
    """Corners of N tags."""

    corners_px: Array  #: (N, 4, 2): pixels; nan where the edges were not found
    #: (N,): standard deviation of the blur across the edges, on the side with the largest blur. It contains a pixel's
    #: blur.
    blur_px: Array


def refine_corners(
    images: Sequence[Gray], image_of: np.ndarray, corners_px: Array, camera: Camera, modules: int
) -> RefinedCorners:
    """Refine the corners of dark tags on light paper, in several images at once.

    Parameters
    ----------
    images : sequence of (height, width) uint8
        Images of one size.
    image_of : (N,) integers
        The number of each tag's image.
    corners_px : (N, 4, 2) array
        Corners in order around the tag, right to a pixel or two.
    modules : int
        Modules along a side with both borders: they tell where the code begins.
    """
    if len(corners_px) == 0:
        return RefinedCorners(corners_px.copy(), np.zeros(0))
    stack, corners = np.stack(images), corners_px
    blur: Array = np.zeros(0)
    for _ in range(ROUNDS):
        corners, blur = _by_areas(stack, image_of, corners, camera, modules)
    state = _Edges(corners, np.repeat(np.clip(np.nan_to_num(blur, nan=1.0), 0.5, 3.0)[:, None], 4, axis=1), None)
    for _ in range(MODEL_ROUNDS):
        state = _by_model(stack, image_of, state, camera, modules)
    grown = _grown(stack, image_of, state, camera, modules)
    return RefinedCorners(
        _moved_outwards(state, grown, camera),
        np.where(np.isfinite(state.corners_px[:, 0, 0]), state.blur_px.max(axis=1), np.nan),
    )


@dataclass(frozen=True, eq=False)
class _Edges:
    """Corners (N, 4, 2), the blur across each side (N, 4), pixels, and paper minus tag in gray values (N,)."""

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
    # A slanted tag is narrower than its sides are long, so its width is its area over its longest side.
    with np.errstate(invalid="ignore", divide="ignore"):
        module = area(corners) / length[..., 0].max(axis=1) / modules  # (N,)
    inwards, outwards = np.minimum(INWARDS * module, REACH_PX), np.minimum(OUTWARDS * module, REACH_PX)
    reach = (inwards + outwards)[:, None, None]
    u = np.linspace(0.0, 1.0, SAMPLES)
    d = u * reach[..., 0] - inwards[:, None]
    foot = start[:, :, None] + share[:, None] * length[:, :, None] * along[:, :, None]  # (N, 4, P, 2)
    # (N, 4, P, S, 2): from the dark border outwards
    points = foot[:, :, :, None] + d[:, None, None, :, None] * normal[:, :, None, None]
    profile = sampled(stack, image_of, points)
    dark, light = profile[..., 0], profile[..., -2:].mean(axis=-1)
    contrast = light - dark  # (N, 4, P)
    # Black is equal along a side, and a single sample is noisy: take the median. The white side stays as it is: its
    # gray value varies with the light along the side.
    black = np.median(dark, axis=2, keepdims=True)[..., None]
    with np.errstate(invalid="ignore", divide="ignore"):
        rise = (profile - black) / (light[..., None] - black)
        # The area under the rise gives the place of a step with the same plateaus, under any symmetric blur. The unit
        # is the reach, from its inner end.
        place = 1.0 - np.trapezoid(rise, u, axis=-1)
        # The rise is the blur's distribution function: the second moment of its differences is the blur's variance.
        centres = 0.5 * (u[1:] + u[:-1])
        mass = np.diff(rise, axis=-1)
        variance = (mass * (centres - place[..., None]) ** 2).sum(axis=-1)
    half = 0.5 * np.median(np.maximum(contrast, 0.0), axis=(1, 2), keepdims=True)
    with np.errstate(invalid="ignore"):
        good = (contrast > np.maximum(half, LEAST_GRAY)) & (place > 0.1) & (place < 0.9)
    off = np.where(good, place, 0.0) * reach - inwards[:, None, None]
    edge = foot + off[..., None] * normal[:, :, None]
    refined = _corners(camera, edge, good)
    # A corner that moves further than the profiles reach is not measured.
    moved = np.linalg.norm(refined - corners, axis=-1).max(axis=1)
    refined = np.where((moved[:, None, None] < reach + 0.5), refined, np.nan)
    middle_one = median(np.where(good, variance, np.inf).reshape(len(corners), -1), good.sum(axis=(1, 2)))
    with np.errstate(invalid="ignore"):
        blur = np.sqrt(np.maximum(middle_one, 0.0)) * reach[:, 0, 0]
    return refined, blur


def _corners(camera: Camera, edge: Array, good: np.ndarray) -> Array:
    """Corners (N, 4, 2) from the good points on edges (N, 4, P, 2), by lines in undistorted coordinates."""
    with np.errstate(invalid="ignore", over="ignore"):
        return camera.pixels(crossings(lines_through(camera.undistort(edge), good, LEAST)))


def _sides(camera: Camera, corners: Array) -> Array:
    """Homographies (N, 4, 3, 3) from the unit square to undistorted corners; each side gets the one it is first in."""
    x = camera.undistort(corners)
    return from_unit_square(np.stack([np.roll(x, -k, axis=1) for k in range(4)], axis=1))


def _line(camera: Camera, H: Array, share: Array, y: float, inner: float) -> tuple[Array, Array, Array, Array]:
    """Feet (N, 4, P, 2) on lines at y of unit squares, normals away from the line at `inner`, its distances (N, 4, P).

    The last (N, 4, P, 2) are directions along the square's other sides, of length 1 along the normals.
    """
    foot, other = (camera.pixels(mapped(H, share, at)) for at in (y, inner))
    with np.errstate(invalid="ignore", divide="ignore"):
        along = camera.pixels(mapped(H, share + 0.01, y)) - camera.pixels(mapped(H, share - 0.01, y))
        along /= np.linalg.norm(along, axis=-1, keepdims=True)
        normal = np.stack([along[..., 1], -along[..., 0]], axis=-1)
        module = np.einsum("nkpi,nkpi->nkp", foot - other, normal)
        normal *= np.sign(module)[..., None]
        module = np.clip(np.nan_to_num(np.abs(module), nan=1.0), 0.1, 1e3)
    slant = (foot - other) / np.einsum("nkpi,nkpi->nkp", foot - other, normal)[..., None]
    return foot, normal, module, np.asarray(slant)


def _grown(stack: Gray, image_of: np.ndarray, edges: _Edges, camera: Camera, modules: int) -> Array:
    """By how much (N,) white has grown into black, in units of the blur; 0 where it cannot be measured.

    A camera's gamma makes the light side of a blurred edge wider, and ink spreads or does not reach: all edges move
    towards black, or all towards white. The border is a module wide. Its inner edges, beside white cells, tell by how
    much it looks thinner, without a model of either.
    """
    share = ((np.arange(1, modules - 1)[:, None] + IN_CELL) / modules).ravel()
    # From the border into the code, along the cells: across the edges of a slanted tag lie other cells.
    foot, _, module, along = _line(camera, _sides(camera, edges.corners_px), share, 1.0 / modules, 0.0)
    blur = np.repeat(edges.blur_px[..., None], len(share), axis=2)
    reach = np.minimum(MODEL_OUTWARDS * module, BLURS * blur + MORE_PX)[..., None]
    places = reach * np.linspace(-1.0, 1.0, SAMPLES)
    values = sampled(stack, image_of, foot[..., None, :] + places[..., None] * along[..., None, :])
    assert edges.step is not None, "it follows the model"
    step = np.asarray(np.maximum(edges.step, LEAST_GRAY))
    fitted = fit_profiles(values, places, module, blur, np.broadcast_to(step[:, None, None], module.shape))
    with np.errstate(invalid="ignore"):
        good = (fitted.step > INNER_STEP * step[:, None, None]) & (fitted.rms < MOST_LEFT)
        good &= np.abs(fitted.shift) < blur
        inwards = np.where(good, fitted.shift / blur, np.inf).reshape(len(step), -1)
    count = good.sum(axis=(1, 2))
    # Outer edges move inwards as well, and with them the place where the inner ones are looked for.
    found = -median(inwards, count) / (2.0 * (1.0 - 1.0 / modules))
    return np.where((count >= LEAST_INNER) & (np.abs(found) < MOST_GROWN), found, 0.0)


def _moved_outwards(edges: _Edges, grown: Array, camera: Camera) -> Array:
    """Corners (N, 4, 2) of edges that are moved outwards by `grown` (N,) times their blur."""
    share = np.linspace(*PART, LEAST)
    foot, normal, _, _ = _line(camera, _sides(camera, edges.corners_px), share, 0.0, 0.5)
    edge = foot + (grown[:, None] * edges.blur_px)[..., None, None] * normal
    return _corners(camera, edge, np.ones(edge.shape[:3], dtype=bool))


def _by_model(stack: Gray, image_of: np.ndarray, edges: _Edges, camera: Camera, modules: int) -> _Edges:
    """Refine edges that are right to a pixel, by one round of the model."""
    share = np.linspace(*PART, PROFILES)
    foot, normal, module, _ = _line(camera, _sides(camera, edges.corners_px), share, 0.0, 1.0 / modules)
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
        refined, np.clip(edges.blur_px + change, LEAST_BLUR_PX, widest), np.where(np.isfinite(height), height, step)
    )
