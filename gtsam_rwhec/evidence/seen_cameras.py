"""Where cameras saw corners, how far these are off under an answer, and in which images they are farthest off."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from gtsam_rwhec.evidence.seen import CELLS, MOST_WORST, SeenCamera, WorstImage
from gtsam_rwhec.evidence.seen_views import CornerErrors, SeenView, errors_as_measured, errors_at_optimum
from gtsam_rwhec.fitting.reprojection_record import Reprojection
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.camera import Camera

#: So many corners of a camera are kept, and so many of all cameras together.
MOST_CORNERS, MOST_OF_ALL = 4000, 16_000
#: Of the worst images so many at most were left out of the answer.
MOST_LEFT_OUT = 2


class RatedView(NamedTuple):
    """An image with the errors of its corners: their rms along each axis, pixels, and over a corner's deviation."""

    sensor: str
    view: SeenView
    errors: CornerErrors
    rms_px: float
    times_noise: float | None


def rated_views(
    views: Mapping[str, Sequence[SeenView]],
    cameras: Mapping[str, Camera],
    found: Reprojection | None,
    noise_px: Callable[[str, str], float | None],
) -> list[RatedView]:
    """All images with errors that are finite; `noise_px` is a corner's deviation by target and sensor."""
    rated = []
    for sensor, of_sensor in views.items():
        for view in of_sensor:
            errors = None
            if found is not None and view.is_used:
                errors = errors_at_optimum(cameras[sensor], view, found)
            if errors is None:
                errors = errors_as_measured(cameras[sensor], view)
            if not errors.counts.any():
                continue
            finite = errors.px[np.isfinite(errors.px).all(axis=1)]
            rms = float(np.sqrt((finite**2).mean()))
            noise = noise_px(view.target, sensor)
            rated.append(RatedView(sensor, view, errors, rms, rms / noise if noise else None))
    return rated


def seen_cameras(
    rated: Iterable[RatedView], cameras: Mapping[str, Camera], found: Reprojection | None
) -> tuple[SeenCamera, ...]:
    """The corners of the images that are used, by camera."""
    of_sensor: dict[str, list[RatedView]] = {}
    for one in rated:
        if one.view.is_used:
            of_sensor.setdefault(one.sensor, []).append(one)
    most = min(MOST_CORNERS, MOST_OF_ALL // max(len(of_sensor), 1))
    return tuple(_seen_camera(sensor, cameras[sensor], of, found, most) for sensor, of in of_sensor.items())


def _seen_camera(
    sensor: str, camera: Camera, rated: Sequence[RatedView], found: Reprojection | None, most: int
) -> SeenCamera:
    pixels = np.concatenate([one.view.pixels for one in rated])
    errors = np.concatenate([one.errors.px for one in rated])
    counts = np.concatenate([one.errors.counts for one in rated])
    cells = cells_with_corners(pixels, (camera.width, camera.height))
    kept = np.flatnonzero(counts)
    if len(kept) > most:  # any, as every other would be the same columns of a board
        kept = np.sort(np.random.default_rng(0).permutation(kept)[:most])
    noise = [one.rms_px / one.times_noise for one in rated if one.times_noise]
    return SeenCamera(
        sensor=sensor,
        width=camera.width,
        height=camera.height,
        images=len(rated),
        corners=len(pixels),
        cells=tuple(map(tuple, cells.tolist())),
        share=float((cells > 0).mean()),
        rms_px=float(np.sqrt((errors[counts] ** 2).mean())),
        noise_px=float(np.median(noise)) if noise else None,
        at_optimum=found is not None and found.carrier_poses != "exact",
        x=tuple(pixels[kept, 0].round(2).tolist()),
        y=tuple(pixels[kept, 1].round(2).tolist()),
        dx=tuple(errors[kept, 0].round(4).tolist()),
        dy=tuple(errors[kept, 1].round(4).tolist()),
    )


def cells_with_corners(pixels: Array, size: tuple[int, int]) -> np.ndarray:
    """How many corners (n, 2) are in each cell of an image of a (width, height), rows from the top."""
    columns, rows = CELLS if size[0] >= size[1] else CELLS[::-1]
    cells = np.zeros((rows, columns), dtype=int)
    good = pixels[np.isfinite(pixels).all(axis=1)]
    at = np.clip(((good + 0.5) / size * [columns, rows]).astype(int), 0, [columns - 1, rows - 1])
    np.add.at(cells, (at[:, 1], at[:, 0]), 1)
    return cells


def worst_views(rated: Iterable[RatedView], most: int = MOST_WORST) -> list[RatedView]:
    """The images that are farthest off, the worst first; at most `MOST_LEFT_OUT` were left out of the answer."""
    ordered = sorted(rated, key=lambda one: -(one.times_noise if one.times_noise is not None else one.rms_px))
    left_out = [one for one in ordered if not one.view.is_used][:MOST_LEFT_OUT]
    used = [one for one in ordered if one.view.is_used][: most - len(left_out)]
    chosen = set(map(id, [*used, *left_out]))
    return [one for one in ordered if id(one) in chosen]


def worst_image(one: RatedView, name: str) -> WorstImage:
    """The record of an image, without its picture."""
    length = np.linalg.norm(one.errors.px, axis=1)
    return WorstImage(
        target=one.view.target,
        sensor=one.sensor,
        image=name,
        is_used=one.view.is_used,
        corners=len(one.view.pixels),
        rms_px=one.rms_px,
        largest_px=float(np.nanmax(length)),
        times_noise=one.times_noise,
    )
