"""Intrinsics from views of planes, by OpenCV (Zhang 2000): a start from nothing, or from far away."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array

#: Which coefficients of distortion are estimated: none; k1 and k2; or k1, k2, p1 and p2.
Distortion = Literal["none", "radial", "all"]
_FIXED = {
    "none": cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3,
    "radial": cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3,
    "all": cv2.CALIB_FIX_K3,
}
#: Fisheye lenses are started at these focal lengths over the larger side; the first is 180 degrees from edge to edge.
FOCAL_OF_SIZE = (1.0 / np.pi, 0.4, 0.6, 1.0)


@dataclass(frozen=True, eq=False)
class PlanesFitted:
    """Intrinsics that fit views of planes.

    Attributes
    ----------
    rms_px : float
        Root mean square length of the reprojection errors, pixels.
    K : (3, 3) array
    D : (4,) array
        k1, k2, p1, p2; of a fisheye k1, k2, k3, k4.
    T : (n, 4, 4) array
        T_camera_target of each view, metres.
    """

    rms_px: float
    K: Array
    D: Array
    T: Array


def fitted_to_planes(
    corners_m: Sequence[Array],
    corners_px: Sequence[Array],
    size: tuple[int, int],
    distortion: Distortion,
    K: Array | None = None,
) -> PlanesFitted | None:
    """Fit a pinhole with distortion to views of planes; None where OpenCV finds no fit.

    Parameters
    ----------
    corners_m : sequence of (n_i, 3) arrays
        With z = 0, metres.
    corners_px : sequence of (n_i, 2) arrays
    size : (int, int)
        Width and height of the images, pixels.
    distortion : "none", "radial" or "all"
    K : (3, 3) array, optional
        The start; by default the homographies give one.
    """
    points = [np.ascontiguousarray(p, dtype=np.float32) for p in corners_m]
    pixels = [np.ascontiguousarray(u, dtype=np.float32) for u in corners_px]
    try:
        start = cv2.initCameraMatrix2D(points, pixels, size) if K is None else np.array(K, dtype=np.float64)
        with one_opencv_thread():
            rms, found, D, turns, t = cv2.calibrateCamera(
                points, pixels, size, start, np.zeros(5), flags=_FIXED[distortion] | cv2.CALIB_USE_INTRINSIC_GUESS
            )
    except cv2.error:
        return None
    R = np.array([cv2.Rodrigues(turn)[0] for turn in turns])
    T = se3.pose(R, np.reshape(t, (len(R), 3)))
    return PlanesFitted(float(rms), np.asarray(found, dtype=np.float64), np.asarray(D, dtype=np.float64).ravel()[:4], T)


def fisheye_fitted_to_planes(
    corners_m: Sequence[Array], corners_px: Sequence[Array], size: tuple[int, int], coefficients: int = 4
) -> PlanesFitted | None:
    """As `fitted_to_planes`, for an equidistant lens whose first so many coefficients are free, and the others 0."""
    points = [np.ascontiguousarray(p, dtype=np.float64)[None] for p in corners_m]
    pixels = [np.ascontiguousarray(u, dtype=np.float64)[None] for u in corners_px]
    names = ("CALIB_RECOMPUTE_EXTRINSIC", "CALIB_FIX_SKEW", "CALIB_USE_INTRINSIC_GUESS")
    flags = sum(map(_fisheye_flag, names))
    flags += sum(_fisheye_flag(f"CALIB_FIX_K{number}") for number in range(coefficients + 1, 5))
    width, height = size
    for share in FOCAL_OF_SIZE:
        f = share * max(size)
        start = np.array([[f, 0.0, 0.5 * (width - 1)], [0.0, f, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
        try:
            with one_opencv_thread():
                rms, K, D, turns, t = cv2.fisheye.calibrate(points, pixels, size, start, np.zeros((4, 1)), flags=flags)
        except cv2.error:  # the start sees a corner behind it, or the views do not say f
            continue
        R = np.array([cv2.Rodrigues(turn)[0] for turn in turns])
        T = se3.pose(R, np.reshape(t, (len(R), 3)))
        return PlanesFitted(float(rms), np.asarray(K, dtype=np.float64), np.asarray(D, dtype=np.float64).ravel()[:4], T)
    return None


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """One thread of OpenCV's: its sums over views then have one order, and the same views give the same bits."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


def _fisheye_flag(name: str) -> int:
    """OpenCV 5 has the fisheye model's flags beside the others, OpenCV 4 in a module of their own."""
    return int(getattr(cv2.fisheye if hasattr(cv2.fisheye, name) else cv2, name))
