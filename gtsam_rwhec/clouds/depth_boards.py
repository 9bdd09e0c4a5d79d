"""A checkerboard, ChArUco board or tag that a 3D camera's own image shows: its pose from its corners in 3D."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from rwhec_factors.se3 import expmap, hat, pose, so3_nearest

from gtsam_rwhec.clouds.cloud import Cloud
from gtsam_rwhec.errors import CloudError, CountError, OptionError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import is_between, real_array

#: Points about a corner that tell where it is: those within this many pixels.
WINDOW_PX = 4.0
#: Fewer points do not tell it: a third of them may be missing on black squares.
FEWEST_POINTS = 12
#: Fewer corners in 3D do not tell a pose and its errors.
FEWEST_CORNERS = 4
#: A corner that is off by this many of the usual errors is left out.
GATE = 4.0
#: Points that differ from the others about a corner by this share of their depth are of something else.
JUMP = 0.02


@dataclass(frozen=True)
class DepthBoard:
    """A board by its corners in 3D.

    Attributes
    ----------
    T_sensor_board : (4, 4)
        In the cloud's frame, metres.
    covariance : (6, 6)
        Of the right perturbation [omega, v]; rad, m.
    corners : (n, 3)
        The corners in the cloud's frame; nan where the cloud has too few points about one.
    used : (n,) booleans
        The corners that agree with the board.
    rms_m : float
        Root mean square of the used corners' distances from their places on the board.
    """

    T_sensor_board: Array
    covariance: Array
    corners: Array
    used: np.ndarray
    rms_m: float


def board_in_depth(
    cloud: Cloud, corners_px: ArrayLike, board_points: ArrayLike, *, corner_px: float = 0.1
) -> DepthBoard:
    """The pose of a board from the places of its corners in an organised cloud.

    Corners come from the image that belongs to the cloud, pixel for pixel: of a ``rw.detect.Detector``,
    ``detection.corners_px`` and ``target.corners()[detection.indices]``. Each is looked up in the points about it,
    which are a smooth function of the pixel on a flat board, so no intrinsics are used.

    Parameters
    ----------
    cloud : Cloud
        Organised: with a ``shape``.
    corners_px : (n, 2)
        Pixels, x to the right and y down, the middle of the first pixel at 0.
    board_points : (n, 3)
        The same corners in the board's frame, metres.
    corner_px : float
        Standard deviation of a corner along each axis, pixels.

    Raises
    ------
    CloudError
        The cloud is not organised, or has points about too few corners.
    CountError
        The numbers of corners differ.
    OptionError
        ``corner_px`` is not positive.
    """
    where = cloud.source or cloud.frame_id or "the cloud"
    pixels, board = real_array(corners_px).reshape(-1, 2), real_array(board_points).reshape(-1, 3)
    if len(pixels) != len(board):
        raise CountError(f"{where}: {len(pixels)} corners in pixels and {len(board)} on the board; give one for each")
    if not is_between(corner_px, 1e-4, 100.0):
        raise OptionError(f"corner_px={brief(corner_px)}; give a number of pixels from 0.0001 to 100")
    if cloud.shape is None:
        raise CloudError(f"{where} is no image of points (rows, columns, 3); a corner in pixels has no point in it")
    rows, columns = cloud.shape
    place = np.full((rows, columns), -1)
    place.flat[cloud.at] = np.arange(len(cloud))
    corners, spreads = np.full((len(pixels), 3), np.nan), np.full((len(pixels), 3, 3), np.nan)
    for k, pixel in enumerate(pixels):
        found = _corner(cloud.points, place, pixel, corner_px)
        if found is not None:
            corners[k], spreads[k] = found
    used = np.isfinite(corners).all(axis=1)
    for _ in range(5):
        if used.sum() < FEWEST_CORNERS:
            raise CloudError(
                f"{where}: of {len(pixels)} corners only {used.sum()} have points that agree with the board; "
                "look whether image and cloud belong together, and whether the cloud is in metres"
            )
        T = _aligned(corners[used], board[used])
        off = corners - board @ T[:3, :3].T - T[:3, 3]
        distance = np.linalg.norm(off, axis=1)
        usual = np.median(distance[used]) / 1.538  # of a length in three dimensions
        agree = np.isfinite(distance) & (distance < GATE * max(usual, 1e-6))
        if np.array_equal(agree, used):
            break
        used = agree
    # [omega, v] moves a corner p by R (omega x p + v)
    R = T[:3, :3]
    J = np.concatenate([-R @ hat(board[used]), np.broadcast_to(R, (int(used.sum()), 3, 3))], axis=2)
    weights = np.linalg.inv(spreads[used])
    covariance = np.linalg.inv((J.transpose(0, 2, 1) @ weights @ J).sum(axis=0))
    step = covariance @ np.einsum("nij,njk,nk->i", J.transpose(0, 2, 1), weights, off[used])
    T = T @ expmap(step[None])[0]
    off = corners - board @ T[:3, :3].T - T[:3, 3]
    squares = np.einsum("ni,nij,nj->", off[used], weights, off[used]) / max(3 * used.sum() - 6, 1)
    rms = float(np.sqrt((off[used] ** 2).sum(axis=1).mean()))
    return DepthBoard(T, covariance * max(squares, 1.0), corners, used, rms)


def _corner(points: Array, place: np.ndarray, pixel: Array, corner_px: float) -> tuple[Array, Array] | None:
    """A corner in 3D, and its covariance: points are linear in the pixel nearby, once divided by their depth."""
    if not np.isfinite(pixel).all():
        return None
    reach = int(np.ceil(WINDOW_PX))
    x, y = np.round(pixel).astype(int)
    rows, columns = (
        np.arange(max(c - reach, 0), min(c + reach + 1, n)) for c, n in zip((y, x), place.shape, strict=True)
    )
    v, u = np.meshgrid(rows, columns, indexing="ij")
    index = place[v, u]
    near = (index >= 0) & (np.hypot(u - pixel[0], v - pixel[1]) <= WINDOW_PX)
    p, du, dv = points[index[near]], u[near] - pixel[0], v[near] - pixel[1]
    same = np.abs(p[:, 2] - np.median(p[:, 2])) < JUMP * np.abs(np.median(p[:, 2])) if len(p) else np.zeros(0, bool)
    if same.sum() < FEWEST_POINTS:
        return None
    M = np.stack([np.ones(len(du)), du, dv], axis=1)[same]
    p = p[same]
    # 1 / z of a plane is linear in the pixel, and so are x / z and y / z
    rays = np.column_stack([p[:, :2] / p[:, 2:], 1.0 / p[:, 2]])
    inverse = np.linalg.inv(M.T @ M)
    a = inverse @ M.T @ rays
    left = rays - M @ a
    noise = left.T @ left / (len(p) - 3) * inverse[0, 0] + corner_px**2 * a[1:].T @ a[1:]
    z = 1.0 / a[0, 2]
    corner = np.array([a[0, 0] * z, a[0, 1] * z, z])
    by_ray = np.array([[z, 0.0, -corner[0] * z], [0.0, z, -corner[1] * z], [0.0, 0.0, -z * z]])
    return corner, by_ray @ noise @ by_ray.T + 1e-14 * np.eye(3)


def _aligned(a: Array, b: Array) -> Array:
    """T_a_b (4, 4) that takes points b (n, 3) to points a by least squares (Umeyama 1991)."""
    R = so3_nearest(((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))[None])[0]
    return pose(R, a.mean(axis=0) - R @ b.mean(axis=0))
