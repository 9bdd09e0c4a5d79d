"""Geometry of tags' sides: gray values between pixels, lines through points, homographies from the unit square."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.images import Gray

#: A point is of something in front of the tag if its distance from the line is above this times 1.4826 of the median.
GROSS = 3.5


def median(values: Array, count: np.ndarray) -> Array:
    """Medians (...) of values (..., n); the last n - count values by size are infinite and do not count."""
    middle = np.maximum((count - 1) // 2, 0)[..., None]
    found: Array = np.take_along_axis(np.sort(values, axis=-1), middle, axis=-1)[..., 0]
    return found


def area(corners: Array) -> Array:
    """Areas (N,) of quadrangles (N, 4, 2), pixels^2: half the cross product of the diagonals."""
    first, second = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    found: Array = 0.5 * np.abs(_cross(first, second))
    return found


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
    product: Array = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return product
