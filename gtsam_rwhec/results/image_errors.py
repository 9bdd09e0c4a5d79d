"""Corners in an image against their predictions by a calibration, for pictures and reports."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from pydantic import ConfigDict
from rwhec_factors import se3

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.fitting.corner_residuals import shaped
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.fitting.reprojection_record import WARPS, BoardShape, Reprojection
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.results.file_record import Count, FileRecord, PositiveCount, Row

#: An image's longer side has so many cells, and its shorter side so many, for the share that has corners.
CELLS = (8, 6)

#: So many images whose corners are farthest off are shown.
MOST_WORST = 6


class SeenCamera(FileRecord):
    """Where a camera saw corners, in the images that are used."""

    sensor: str
    width: PositiveCount  #: Pixels
    height: PositiveCount  #: Pixels
    images: Count  #: Images with corners, once for each target
    corners: Count  #: Corners in them
    cells: tuple[tuple[int, ...], ...]  #: Corners in each cell of the image, rows from the top
    share: float  #: Share of the cells that have a corner
    rms_px: float  #: Root mean square of dx and dy over all corners that count
    noise_px: float | None  #: Deviation of a corner along each axis, as it counted
    #: True: the carriers' pose of each image as its corners and the pose's noise together say; false: the pose as
    #: measured
    at_optimum: bool
    x: Row  #: Some of the corners, spread over all images: pixels from the left
    y: Row  #: Pixels from the top
    dx: Row  #: Seen minus predicted, pixels
    dy: Row  #: Seen minus predicted, pixels


class WorstImage(FileRecord):
    """An image whose corners are far off under the answer."""

    model_config = ConfigDict(ser_json_bytes="base64", val_json_bytes="base64")

    target: str
    sensor: str
    image: str  #: Name of the image's file; else its stamp in nanoseconds, or its place in the pair
    is_used: bool  #: Whether it is in the answer
    corners: PositiveCount  #: Corners in it
    rms_px: float  #: Root mean square of its corners' errors along each axis, pixels
    largest_px: float  #: Length of the largest error, pixels
    times_noise: float | None  #: Rms over the deviation of a corner
    magnified: float = 1.0  #: Errors are drawn so many times as long
    picture: bytes | None = None  #: The target in it, JPEG, base64; null where there is none


#: Fewer corners than this in an image say nothing beside its pose.
FEWEST = 4
#: A corner is far off if its error exceeds this many times the median of its image, or the noise.
FAR = 6.0


class SeenView(NamedTuple):
    """A target's corners in an image: pixels (n, 2), and the same points (n, 3) in the camera's frame, metres.

    With the points' derivatives (n, 3, 6) by A Expmap([omega, v]), the image's stamp (or its index, where there are no
    stamps), the target, and whether the calibration uses it.
    """

    pixels: Array
    points: Array
    by_A: Array
    stamp_ns: int
    target: str = ""
    is_used: bool = True

    @staticmethod
    def of(
        pixels: Array,
        corners: Array,
        T_camera_targetcarrier: Array,
        T_targetcarrier_target: Array,
        stamp_ns: int,
        target: str = "",
        *,
        is_used: bool = True,
    ) -> SeenView:
        """A view of corners (n, 3) in the target's frame."""
        Q = corners @ T_targetcarrier_target[:3, :3].T + T_targetcarrier_target[:3, 3]
        R = T_camera_targetcarrier[:3, :3]
        by_xi = np.concatenate([-se3.hat(Q), np.broadcast_to(np.eye(3), (len(Q), 3, 3))], axis=2)
        points = Q @ R.T + T_camera_targetcarrier[:3, 3]
        return SeenView(pixels, points, R @ by_xi, stamp_ns, target, is_used)


class CornerErrors(NamedTuple):
    """Seen minus predicted (n, 2), pixels, and which corners count, (n,) bool: the others are far off."""

    px: Array
    counts: np.ndarray


def warp_of(shape: BoardShape | None) -> Array:
    """Heights (3,) of the edge over the middle along x, y and the diagonals, metres."""
    found = {} if shape is None else dict(zip(shape.names, shape.values, strict=True))
    return np.array([found.get(name, 0.0) for name in WARPS.values()])


def board_of(refined: RefinedPoses, target: str, corners: Array) -> Array:
    """A target's corners (n, 3) with its estimated size and warp."""
    scale = refined.scale if isinstance(refined.scale, float) else refined.scale[target]
    found = None if refined.reprojection is None else refined.reprojection.boards.get(target)
    board = shaped(corners, np.r_[1.0 / scale - 1.0, warp_of(found)])[0]
    return board + np.array(found.corners_off_m) if found is not None and found.corners_off_m else board


def errors_as_measured(camera: Camera, view: SeenView) -> CornerErrors:
    """Errors with A as it was measured; corners that are behind the camera, or have no ray, do not count."""
    off = view.pixels - camera.project(view.points)
    return CornerErrors(off, np.isfinite(off).all(axis=1) & (view.points[:, 2] > 0.0))


def errors_at_optimum(camera: Camera, view: SeenView, found: Reprojection) -> CornerErrors | None:
    """Errors of an image's corners at the optimum of a refinement from corners; None where an image says nothing.

    There A of each image has an error too, which its noise and its corners determine together. With the derivatives J
    of the pixels by A's errors over their deviations, and residuals r over the corners' noise: r - J (J' J + I)^-1 J'
    r, to first order. Corners that are far off do not count.
    """
    P = view.points
    deviations = np.repeat([found.carrier_rotation_rad, found.carrier_translation_m], 3)
    x = P[:, :2] / P[:, 2:]
    predicted, by_x = camera.pixel_jacobian(x)
    off = view.pixels - predicted
    if len(P) < FEWEST or not (np.isfinite(off).all() and (P[:, 2] > 0.0).all()):
        return None
    to_x = np.concatenate([np.broadcast_to(np.eye(2), (len(P), 2, 2)), -x[:, :, None]], axis=2)
    J = by_x @ (to_x / P[:, 2, None, None]) @ view.by_A * deviations / found.corner_px
    length = np.linalg.norm(_at_optimum(J, off, np.ones(len(P), dtype=bool)), axis=1)
    counts = length <= FAR * max(float(np.median(length)), found.corner_px)
    return CornerErrors(_at_optimum(J, off, counts), counts) if counts.sum() >= FEWEST else None


def _at_optimum(J: Array, errors: Array, counts: np.ndarray) -> Array:
    """Errors (n, 2) without what A's errors explain of those that count; derivatives (n, 2, 6) in deviations."""
    flat = J[counts].reshape(-1, 6)
    xi = np.linalg.solve(flat.T @ flat + np.eye(6), flat.T @ errors[counts].ravel())
    return errors - J @ xi


#: At most this many corners are kept for one camera, and for all cameras together.
MOST_CORNERS, MOST_OF_ALL = 4000, 16_000
#: At most this many of the worst images that are shown were left out of the answer.
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
    """How many corners (n, 2) each cell of a (width, height) image has, rows from the top."""
    columns, rows = CELLS if size[0] >= size[1] else CELLS[::-1]
    good = np.clip(pixels[np.isfinite(pixels).all(axis=1)] + 0.5, 0.0, size)
    cells, *_ = np.histogram2d(good[:, 1], good[:, 0], (rows, columns), ((0.0, size[1]), (0.0, size[0])))
    return np.asarray(cells, dtype=int)


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
