"""Corners of a target in a sensor's images, as users give them to ``Problem.add_corners``, and the checks of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import CameraError, CountError, NoiseError, TargetError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import is_real, real_array

#: An image with fewer corners than this determines no pose.
FEWEST = 4
#: Two corners closer than this share of the board's size are the same corner: single precision is enough.
SAME = 1e-5
#: Corners on one line: the board's second largest extent is below this share of its largest.
LINE = 1e-6
#: A corner may be outside its image by this share of the larger side.
OUTSIDE = 0.01

#: One array for all images, or one for each.
EachImage: TypeAlias = ArrayLike | Sequence[ArrayLike]


@dataclass(frozen=True, eq=False)
class SeenCorners:
    """Corners of a target in N images of a sensor: the board (n, 3), metres, and pixels (N, n, 2), nan if not seen."""

    board: Array
    pixels: Array


def seen_corners(
    image_points: EachImage,
    board_points: EachImage | None,
    corner_ids: Sequence[ArrayLike] | None,
    known_board: Array | None,
    where: str,
) -> SeenCorners:
    """Corners as arrays, in the order of the known board, if there is one.

    A CountError says that an image has fewer than four corners or has one twice, or that the numbers of pixels and
    corners differ; a TargetError that there is no board, or that it differs from the board of earlier corners.
    """
    views = [_rows(view, 2, f"{where}: image_points of image {i}") for i, view in enumerate(_each(image_points, where))]
    if not views:
        raise CountError(f"{where}: there are no images; leave the pair out instead")
    per_image = _is_per_image(board_points)
    if per_image and corner_ids is not None:
        raise CountError(f"{where}: board_points has the corners of each image, which corner_ids say too; give one")
    if per_image:
        board, ids = _by_points(views, board_points, known_board, where)
    else:
        board = _whole_board(board_points, known_board, where)
        ids = _by_ids(views, corner_ids, len(board), where)
    return SeenCorners(board, _scattered(views, ids, len(board), where))


def check_camera(camera: object, known: Camera | None, sensor: str, where: str) -> Camera:
    """The sensor's camera; a CameraError if there is none, or if a different one was given before."""
    if camera is None and known is not None:
        return known
    if not isinstance(camera, Camera):
        raise CameraError(
            f"{where}: camera is {brief(camera)}; give {sensor} intrinsics: camera=rw.Camera.of(width, height, "
            "'radtan', K, D, 'its name'). If nobody knows them: rw.calibrate_corners with "
            'rw.CornerOptions(stated="unknown")'
        )
    if known is None:
        return camera
    size, before = (camera.width, camera.height), (known.width, known.height)
    if size != before:
        raise CameraError(
            f"{where}: the camera has images of {size[0]} x {size[1]} pixels, and {sensor} had images of {before[0]} x "
            f"{before[1]} before; a sensor has one size of image: give each size a sensor of its own, or scale the "
            "corners and K"
        )
    if camera.model != known.model or not (np.array_equal(camera.K, known.K) and np.array_equal(camera.D, known.D)):
        raise CameraError(
            f"{where}: {sensor} had other intrinsics before ({known.model}, fx fy cx cy "
            f"{known.K[[0, 1, 0, 1], [0, 1, 2, 2]]} then, {camera.model}, {camera.K[[0, 1, 0, 1], [0, 1, 2, 2]]} now); "
            "give the same camera, or leave camera out"
        )
    return known


def check_in_image(pixels: Array, camera: Camera, where: str) -> None:
    """A CameraError where corners (N, n, 2) are not in the camera's images."""
    size = np.array([camera.width, camera.height])
    margin = OUTSIDE * size.max()
    with np.errstate(invalid="ignore"):
        out = ((pixels < -margin) | (pixels > size + margin)).any(axis=2)
    if out.any():
        image, corner = np.argwhere(out)[0]
        x, y = pixels[image, corner]
        raise CameraError(
            f"{where}: corner {corner} of image {image} is at ({x:.6g}, {y:.6g}), outside images of {camera.width} x "
            f"{camera.height} pixels ({int(out.sum())} corners are); are the images of another size than the camera's, "
            "or are rows and columns exchanged? Give (x, y), x to the right"
        )


def check_corner_px(value: object, known: float | None, where: str) -> float:
    """A corner's standard deviation; a NoiseError if it is not positive, or differs from the earlier one."""
    if value is None:
        return 0.1 if known is None else known
    if not (is_real(value) and 0.0 < value < np.inf):
        raise NoiseError(f"{where}: corner_px is {brief(value)}; give a positive number of pixels")
    if known is not None and value != known:
        raise NoiseError(
            f"{where}: corner_px is {value:g}, and it was {known:g} before; give one deviation for all corners of a "
            "problem (a refinement from corners estimates it)"
        )
    return float(value)


def same_board(one: Array, other: Array) -> bool:
    """Whether two boards (n, 3) have the same corners in the same order."""
    return one.shape == other.shape and float(np.abs(one - other).max()) <= SAME * _size(one)


def _each(image_points: Any, where: str) -> list[Any]:
    is_flat = isinstance(image_points, np.ndarray) and image_points.ndim not in (3, 4)
    if is_flat or not isinstance(image_points, Iterable):
        what = f"has shape {image_points.shape}" if is_flat else f"is a {type(image_points).__name__}"
        raise CountError(f"{where}: image_points {what}; give (N, n, 2), or a list of one (n, 2) an image")
    return list(image_points)


def _rows(values: Any, width: int, what: str) -> Array:
    """(n, width) numbers; OpenCV's (n, 1, width) and (1, n, width) too."""
    try:
        array = np.array(real_array(values))
    except ValueError as error:
        raise CountError(f"{what} cannot be read as numbers ({error}); give (n, {width})") from error
    if array.ndim == 3 and 1 in array.shape[:2]:
        array = array.reshape(-1, array.shape[2])
    if array.ndim != 2 or array.shape[1] != width:
        raise CountError(f"{what} has shape {array.shape}; give (n, {width})")
    return array


def _is_per_image(board_points: Any) -> bool:
    if board_points is None:
        return False
    if isinstance(board_points, np.ndarray):
        return board_points.ndim > 3 or (board_points.ndim == 3 and 1 not in board_points.shape[:2])
    return isinstance(board_points, list | tuple) and len(board_points) > 0 and np.ndim(board_points[0]) > 1


def _checked_board(points: Array, where: str) -> Array:
    if len(points) < FEWEST or not np.isfinite(points).all():
        raise TargetError(
            f"{where}: board_points has {len(points)} corners, finite: {bool(np.isfinite(points).all())}; give four or "
            "more finite points, in metres"
        )
    extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if extent[1] <= LINE * extent[0]:
        raise TargetError(f"{where}: board_points lie on one line, which determines no pose; give corners in a plane")
    pairs = cKDTree(points).query_pairs(SAME * _size(points))
    if pairs:
        i, j = min(pairs)
        raise TargetError(f"{where}: corners {i} and {j} of board_points are one point, {points[i].tolist()}")
    return points


def _whole_board(board_points: Any, known: Array | None, where: str) -> Array:
    if board_points is None:
        if known is None:
            raise TargetError(
                f"{where}: corners without a model of the board; give board_points, (n, 3) in metres in the target's "
                "frame, such as rw.cameras.Checkerboard(...).corners()"
            )
        return known
    points = _checked_board(_rows(board_points, 3, f"{where}: board_points"), where)
    if known is not None and not same_board(known, points):
        raise TargetError(
            f"{where}: board_points are not those that the target had before ({_words(points)} now, {_words(known)} "
            "then); give each board a name of its own, or leave board_points out"
        )
    return points if known is None else known


def _words(board: Array) -> str:
    return f"{len(board)} corners over {_size(board):.4g} m"


def _size(board: Array) -> float:
    return float(np.linalg.norm(np.ptp(board, axis=0)))


def _by_points(
    views: list[Array], board_points: Any, known: Array | None, where: str
) -> tuple[Array, list[np.ndarray]]:
    """The board and each image's numbers of corners, where each image has its own points (cv2's object points)."""
    points = [_rows(p, 3, f"{where}: board_points of image {i}") for i, p in enumerate(board_points)]
    _check_as_many(views, points, "board_points", where)
    every = np.concatenate(points)
    if not np.isfinite(every).all():
        raise TargetError(f"{where}: board_points of the images are not all finite; give metres")
    board = known
    if board is None:
        _, first = np.unique(every, axis=0, return_index=True)
        board = _checked_board(every[np.sort(first)], where)
    off, nearest = cKDTree(board).query(every)
    lost = np.flatnonzero(~(off <= SAME * _size(board)))
    if lost.size:
        raise TargetError(
            f"{where}: the corner {every[lost[0]].tolist()} of board_points is not on the board that the target had "
            f"before ({_words(board)}); give the whole board as board_points (n, 3) at the first call, with corner_ids"
        )
    ends = np.cumsum([len(p) for p in points])
    return board, np.split(nearest, ends[:-1])


def _by_ids(views: list[Array], corner_ids: Any, n: int, where: str) -> list[np.ndarray]:
    if corner_ids is None:
        for i, view in enumerate(views):
            if len(view) != n:
                raise CountError(
                    f"{where}: image {i} has {len(view)} pixels for {n} corners; give nan for corners that were not "
                    "seen, or corner_ids or board_points for each image"
                )
        return [np.arange(n)] * len(views)
    try:
        ids = [np.asarray(each).ravel() for each in corner_ids]
    except (TypeError, ValueError) as error:
        raise CountError(f"{where}: corner_ids={brief(corner_ids)}; give a list of one (n,) an image") from error
    _check_as_many(views, ids, "corner_ids", where)
    for i, each in enumerate(ids):
        if not np.issubdtype(each.dtype, np.integer) or each.min(initial=0) < 0 or each.max(initial=0) >= n:
            raise CountError(
                f"{where}: corner_ids of image {i} are {brief(each.tolist())}; give whole numbers from 0 to {n - 1}"
            )
    return ids


def _check_as_many(views: list[Array], others: Sequence[np.ndarray], name: str, where: str) -> None:
    if len(others) != len(views):
        raise CountError(f"{where}: {name} has {len(others)} images and image_points {len(views)}")
    for i, (view, other) in enumerate(zip(views, others, strict=True)):
        if len(view) != len(other):
            raise CountError(f"{where}: image {i} has {len(view)} pixels and {len(other)} in {name}; give one for each")


def _scattered(views: list[Array], ids: list[np.ndarray], n: int, where: str) -> Array:
    image, corner = np.repeat(np.arange(len(views)), [len(v) for v in views]), np.concatenate(ids)
    every = np.concatenate(views)
    if np.isinf(every).any():
        at = int(np.flatnonzero(np.isinf(every).any(axis=1))[0])
        raise CountError(f"{where}: a corner of image {image[at]} is at {every[at].tolist()}; give nan if not seen")
    place, counts = np.unique(image * n + corner, return_counts=True)
    if (counts > 1).any():
        twice = int(place[np.argmax(counts)])
        raise CountError(f"{where}: image {twice // n} has corner {twice % n} twice; leave one of the two out")
    pixels = np.full((len(views), n, 2), np.nan)
    pixels[image, corner] = np.where(np.isnan(every).any(axis=1, keepdims=True), np.nan, every)
    seen = np.isfinite(pixels[..., 0]).sum(axis=1)
    if seen.min() < FEWEST:
        raise CountError(
            f"{where}: image {int(seen.argmin())} has {seen.min()} corners; leave out images with fewer than {FEWEST}"
        )
    return pixels


#: Corners do not belong to a board if, in half of the images, their error is this share of the board's extent in the
#: image.
FARTHEST = 0.2
SECOND_NS = 1_000_000_000


@dataclass(frozen=True, eq=False)
class Candidates:
    """Both poses of N images: T (N, 2, 4, 4), metres; the second is nan where there is only one.

    squared_px (N, 2); covariance (N, 2, 6, 6), rotation first, right perturbation.
    """

    T: Array
    squared_px: Array
    covariance: Array
    corner_px: float

    def chosen(self, which: np.ndarray) -> tuple[Array, Array]:
        """Poses (N, 4, 4) and covariances (N, 6, 6) of chosen candidates (N,)."""
        at = np.arange(len(which))
        return self.T[at, which], self.covariance[at, which]

    def by_carriers(self, A: Array) -> np.ndarray:
        """The candidates (N,) that agree with the carriers' poses A (N, 4, 4) over all images."""
        from gtsam_rwhec.cameras.plane_ambiguity import choose_over_time

        order = SECOND_NS * np.arange(len(A))  # neighbours are compared whatever time is between them: A is known
        return choose_over_time(order, self.T, self.squared_px, self.covariance, self.corner_px, A).which

    def nearer(self, predicted: Array) -> np.ndarray:
        """The candidates (N,) whose rotations are nearer to predicted poses T_sensor_target (N, 4, 4)."""
        off = np.linalg.norm(self.T[:, :, :3, :3] - predicted[:, None, :3, :3], axis=(2, 3))
        return np.asarray(np.argmin(np.where(np.isnan(off), np.inf, off), axis=1))


def candidates_of(camera: Camera, board: Array, pixels: Array, corner_px: float, where: str) -> Candidates:
    """Both poses of each image from corners (N, n, 2) of a board (n, 3).

    A CameraError says that the lens model has no ray for a corner, or that an image has no pose; a TargetError that the
    corners do not belong to the board.
    """
    (both,) = candidates_of_each(camera, [(board, pixels, where)], corner_px)
    return both


def candidates_of_each(
    camera: Camera, seen: Sequence[tuple[Array, Array, str]], corner_px: float
) -> Iterator[Candidates]:
    """The same of several boards, all at once: board, pixels and where of each, as `candidates_of` takes them."""
    from gtsam_rwhec.cameras.target_poses import plane_poses

    known = [np.asarray(np.isfinite(pixels).all(axis=2)) for _, pixels, _ in seen]
    found = plane_poses(
        camera,
        [board[there] for (board, _, _), masks in zip(seen, known, strict=True) for there in masks],
        [
            px[there]
            for (_, each, _), masks in zip(seen, known, strict=True)
            for px, there in zip(each, masks, strict=True)
        ],
        corner_px=corner_px,
    )
    ends = np.cumsum([len(pixels) for _, pixels, _ in seen]).tolist()
    for (_, pixels, where), masks, end in zip(seen, known, ends, strict=True):
        own = slice(end - len(pixels), end)
        squared_px, reprojection_px = found.squared_px[own], found.reprojection_px[own]
        lost = np.flatnonzero(~np.isfinite(squared_px[:, 0]))
        _check_rays(lost, camera, pixels, masks, where)
        extent = np.sqrt(np.nanvar(np.where(masks[..., None], pixels, np.nan), axis=1).sum(axis=1))
        off = float(np.median(np.nan_to_num(reprojection_px[:, 0], nan=np.inf) / extent))
        if off > FARTHEST:
            missed = f"miss it by {100.0 * off:.0f} % of its size or more" if np.isfinite(off) else "have no pose of it"
            raise TargetError(
                f"{where}: the corners do not belong to the board: half of the images {missed}; give image_points in "
                "the order of board_points, and check its numbers of rows and columns, and whether it is another board"
            )
        if lost.size:
            raise CameraError(f"{where}: the corners of image {lost[0]} have no pose; are they on one line?")
        yield Candidates(found.T[own], squared_px, found.covariance[own], corner_px)


def _check_rays(images: np.ndarray, camera: Camera, pixels: Array, known: np.ndarray, where: str) -> None:
    """A CameraError where the lens model has no ray for a corner of some images."""
    dark = known[images] & ~np.isfinite(camera.undistort(pixels[images])).all(axis=2)
    if dark.any():
        image, corner = np.argwhere(dark)[0]
        x, y = pixels[images[image], corner]
        raise CameraError(
            f"{where}: the lens model ({camera.model}) has no ray for corner {corner} of image {images[image]} at "
            f"({x:.1f}, {y:.1f}): its distortion folds back there. Check D, give another model, or leave such corners "
            "out (nan)"
        )
