"""Centres of circles: centroids of their gray values, corrected for perspective and for the lens's distortion.

The image of a circle's centre is not the centre of its image (Heikkila 2000, section 3.1). The circle's outline is
projected; by how much its centroid is off the projected centre is subtracted from the centroid that was measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.detect.board_evidence import BoardPlane
from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.geometry.poses import Array

#: A circle's outline is a polygon of this many points: its centroid is exact for an ellipse.
OUTLINE = 32
#: The background is seen beyond this share of the way from a circle's edge to half way to its neighbour's.
RING = 0.5
#: The part of a circle's radius inside which its contrast is measured.
MIDDLE = 0.6
#: Light changes within a circle by 0.3 % a pixel, and noise is 2 % of it: the squared quotient (pixels squared).
STEADY = 44.0
#: Light falls to this share of its value in the middle of a circle at most.
LEAST_LIT = 0.2
#: A window with a larger half side than this (pixels) is sampled at every second pixel, or third, and so on.
LARGEST_WINDOW_PX = 32
#: Pixels further away than this are nowhere near an image.
FAR_PX = 1e5


@dataclass(frozen=True, eq=False)
class Circles:
    """Circles (...) as they are in an image."""

    seen_px: Array  #: (..., 2): centroids of the gray values, pixels
    centres_px: Array  #: (..., 2): images of the circles' centres, pixels
    radii: Array  #: (...): in steps of the grid, from the areas
    contrasts: Array  #: (...): (background - circle) / the lighter of the two; negative if that is the circle
    #: (...): by how much the light on the background around a circle is off a plane: root mean square, as a share of
    #: it. Where a shadow's edge crosses a circle, its centroid is off.
    uneven: Array
    seen: np.ndarray  #: (...): whether a circle is whole in the image and its numbers are finite


def measured_circles(gray: Gray, plane: BoardPlane, steps: Array, about_px: Array, radii: Array) -> Circles:
    """Measure circles at places (..., 2) of the grid, near pixels about_px (..., 2), with about these radii (...).

    Around each, a plane is fitted to the gray values between it and its neighbours: light that changes across a circle
    would move its centroid.
    """
    shape = np.shape(radii)
    steps, about, r = steps.reshape(-1, 2), about_px.reshape(-1, 2), np.clip(radii.ravel(), 0.02, 0.9)
    edge = r + 0.5 * _gaps(steps, r)
    J = plane.jacobians(steps)
    with np.errstate(invalid="ignore"):
        usable = np.asarray((np.abs(about) < FAR_PX).all(axis=1) & (np.abs(J) < FAR_PX).all(axis=(1, 2)))
        usable &= np.abs(np.linalg.det(np.where(usable[:, None, None], J, np.eye(2)))) > 1e-9
    J, about = np.where(usable[:, None, None], J, np.eye(2)), np.where(usable[:, None], about, 0.0)
    reach = edge * np.linalg.norm(J, ord=2, axis=(1, 2))
    moved, whole = np.zeros((len(r), 2)), np.zeros(len(r), bool)
    total, contrast, uneven = np.zeros((3, len(r)))
    small = reach <= 1.3 * np.median(reach)
    for group in (small, ~small):  # the larger dot's window is not everyone's
        if group.any():
            seen_here = _shaded(gray, about[group], J[group], r[group], edge[group], float(reach[group].max()))
            moved[group], total[group], contrast[group], uneven[group], whole[group] = seen_here
    area, astray = _outlines(plane, steps, r)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = r * np.sqrt(np.maximum(total / contrast, 0.0) / area)
        # A centroid outside its circle is not one: the shade around it has both signs.
        seen = whole & usable & (np.linalg.norm(moved, axis=1) < reach) & np.isfinite(found) & np.isfinite(astray[:, 0])
    centroid = about + moved
    return Circles(
        centroid.reshape(*shape, 2), (centroid - astray).reshape(*shape, 2), found.reshape(shape),
        contrast.reshape(shape), uneven.reshape(shape), seen.reshape(shape),
    )  # fmt: skip


def _shaded(
    gray: Gray, about: Array, J: Array, r: Array, edge: Array, reach_px: float
) -> tuple[Array, Array, Array, Array, np.ndarray]:
    """Centroids (n, 2) from `about`, sums (n,) of shade, contrasts (n,), and whether circles are whole in the image.

    A pixel's shade is (background - gray) / light. How the light falls is seen on the lighter of circle and background:
    a dark background's values, by which noise would be divided, say little.
    """
    stride = int(np.ceil((reach_px + 1.0) / LARGEST_WINDOW_PX))
    half = int(np.ceil((reach_px + 1.0) / stride))
    offset = stride * np.stack(np.meshgrid(*2 * [np.arange(-half, half + 1)]), axis=-1).reshape(-1, 2)
    at = np.rint(about).astype(int)[:, None] + offset
    limit = np.array(gray.shape[::-1]) - 1
    inside = ((at >= 0) & (at <= limit)).all(axis=-1)
    column, row = np.moveaxis(np.clip(at, 0, limit), -1, 0)
    values = gray[row, column].astype(float)
    there = at - about[:, None]
    away = np.linalg.norm(there @ np.linalg.inv(J).swapaxes(1, 2), axis=-1)  # in steps of the grid
    near = (away <= edge[:, None]) & inside
    ring = near & (away >= (r + RING * (edge - r))[:, None])
    whole = (inside | (away > r[:, None])).all(axis=1) & (ring.sum(axis=1) >= 6)
    core = (away <= MIDDLE * r[:, None]) & inside
    basis = np.concatenate([np.ones((*there.shape[:2], 1)), there], axis=2)
    of_ground, of_circle = _light(values, basis, ring, 1e-9), _light(values, basis, core, STEADY)
    ground = (basis @ of_ground[..., None])[..., 0]
    lighter = np.where(of_circle[:, :1] > of_ground[:, :1], of_circle, of_ground)
    lit = np.maximum((basis @ lighter[..., None])[..., 0], np.maximum(LEAST_LIT * lighter[:, :1], 1.0))
    shade = np.where(near, (ground - values) / lit, 0.0)
    contrast = (shade * core).sum(axis=1) / np.maximum(core.sum(axis=1), 1)
    total = shade.sum(axis=1)
    squared = (((ground - values) / lit) ** 2 * ring).sum(axis=1)
    uneven = np.sqrt(squared / np.maximum(ring.sum(axis=1), 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = np.nan_to_num((shade[..., None] * there).sum(axis=1) / total[:, None], nan=np.inf)
    return moved, stride**2 * total, contrast, uneven, whole


def _light(values: Array, basis: Array, where: np.ndarray, steady: float) -> Array:
    """The planes (n, 3) that fit gray values (n, p) best in some of the pixels; basis (n, p, 3) has 1, du, dv."""
    weighed = (basis * where[..., None]).swapaxes(1, 2)
    normal = weighed @ basis + np.diag([1e-9, steady, steady])
    planes: Array = np.linalg.solve(normal, weighed @ values[..., None])[..., 0]
    return planes


def _gaps(steps: Array, radii: Array) -> Array:
    """From each circle's edge to the nearest one's (n,), in steps; at least a twentieth.

    At most as far as in a symmetric grid: half a step from the outer circles' centres a board may end.
    """
    apart = np.linalg.norm(steps[:, None] - steps, axis=-1) - radii[:, None] - radii
    np.fill_diagonal(apart, np.inf)
    return np.asarray(np.clip(apart.min(axis=1), 0.05, np.maximum(1.0 - 2.0 * radii, 0.2)))


def _outlines(plane: BoardPlane, steps: Array, radii: Array) -> tuple[Array, Array]:
    """Areas (n,) of the circles' images, px^2, and how far (n, 2) their centroids are off the projected centres."""
    angle = 2.0 * np.pi * np.arange(OUTLINE) / OUTLINE
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    centre = plane.pixels(steps)
    here = plane.pixels(steps[:, None] + radii[:, None, None] * unit) - centre[:, None]
    there = np.roll(here, -1, axis=1)
    cross = here[..., 0] * there[..., 1] - here[..., 1] * there[..., 0]
    signed = 0.5 * cross.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        astray: Array = ((here + there) * cross[..., None]).sum(axis=1) / (6.0 * signed[:, None])
    # A polygon of n corners inscribed in an ellipse has this share of its area.
    share = np.sin(2.0 * np.pi / OUTLINE) * OUTLINE / (2.0 * np.pi)
    return np.abs(signed) / share, astray
