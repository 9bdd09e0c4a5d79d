"""Intrinsics of a camera that nobody calibrated, from its views of flat boards: by homographies (Zhang 2000).

The lens model has only the coefficients that the corners determine (Schwarz's criterion): others would distort the
image where no corner was seen.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.distortion import coefficient_jacobian
from gtsam_rwhec.cameras.target_poses import stacked
from gtsam_rwhec.errors import CameraError
from gtsam_rwhec.files.optional_packages import extra_named
from gtsam_rwhec.files.terminal_text import counted
from gtsam_rwhec.geometry.poses import Array

#: Which coefficients of distortion are estimated: none; k1 and k2; or k1, k2, p1 and p2.
Distortion = Literal["none", "radial", "all"]
#: Fisheye lenses are started at these focal lengths over the larger side; the first is 180 degrees from edge to edge.
FOCAL_OF_SIZE = (1.0 / np.pi, 0.4, 0.6, 1.0)


@dataclass(frozen=True, eq=False)
class PlanesFitted:
    """Intrinsics that fit views of planes."""

    rms_px: float  #: Root mean square length of the reprojection errors, pixels
    K: Array  #: (3, 3)
    D: Array  #: (4,): k1, k2, p1, p2; of a fisheye k1, k2, k3, k4
    T: Array  #: (n, 4, 4): T_camera_target of each view, metres


def fitted_to_planes(
    corners_m: Sequence[Array],
    corners_px: Sequence[Array],
    size: tuple[int, int],
    distortion: Distortion,
    K: Array | None = None,
) -> PlanesFitted | None:
    """Fit a pinhole with distortion to views of planes; None where OpenCV finds no fit.

    ``corners_m`` (n_i, 3) have z = 0, metres; ``size`` is width and height of the images, pixels. ``K`` (3, 3) is the
    start; by default the homographies give one.
    """
    with extra_named():
        import cv2

    fixed = {
        "none": cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3,
        "radial": cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3,
        "all": cv2.CALIB_FIX_K3,
    }
    points = [np.ascontiguousarray(p, dtype=np.float32) for p in corners_m]
    pixels = [np.ascontiguousarray(u, dtype=np.float32) for u in corners_px]
    try:
        start = cv2.initCameraMatrix2D(points, pixels, size) if K is None else np.array(K, dtype=np.float64)
        with one_opencv_thread():
            return _planes_fitted(
                *cv2.calibrateCamera(
                    points, pixels, size, start, np.zeros(5), flags=fixed[distortion] | cv2.CALIB_USE_INTRINSIC_GUESS
                )
            )
    except cv2.error:
        return None


def _planes_fitted(rms: float, K: Any, D: Any, turns: Sequence[Any], t: Any) -> PlanesFitted:
    with extra_named():
        import cv2

    R = np.array([cv2.Rodrigues(turn)[0] for turn in turns])
    T = se3.pose(R, np.reshape(t, (len(R), 3)))
    return PlanesFitted(float(rms), np.asarray(K, dtype=np.float64), np.asarray(D, dtype=np.float64).ravel()[:4], T)


def fisheye_fitted_to_planes(
    corners_m: Sequence[Array], corners_px: Sequence[Array], size: tuple[int, int], coefficients: int = 4
) -> PlanesFitted | None:
    """As `fitted_to_planes`, for an equidistant lens: its first ``coefficients`` are free, the others 0."""
    with extra_named():
        import cv2

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
                return _planes_fitted(
                    *cv2.fisheye.calibrate(points, pixels, size, start, np.zeros((4, 1)), flags=flags)
                )
        except cv2.error:  # the start sees a corner behind it, or the views do not say f
            continue
    return None


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """One thread of OpenCV's: its sums over views then have one order, and the same views give the same bits."""
    with extra_named():
        import cv2

    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


def _fisheye_flag(name: str) -> int:
    """OpenCV 5 has the fisheye model's flags beside the others, OpenCV 4 in a module of their own."""
    with extra_named():
        import cv2

    return int(getattr(cv2.fisheye if hasattr(cv2.fisheye, name) else cv2, name))


#: Corners (n, 3) of flat targets, metres, and where they were seen (n, 2), pixels.
Views: TypeAlias = Sequence[tuple[Array, Array]]
#: The lens models that can be estimated; "any" is whichever fits.
Lens = Literal["any", "pinhole", "radtan", "equidistant", "unified"]
#: Views with fewer corners, and cameras with fewer views, give no intrinsics.
CORNERS, VIEWS = 6, 3
#: This many views, as different as possible, are enough.
ENOUGH = 40
#: A fisheye's model is tried where the image reaches further than this (degrees) from its axis, or where corners are
#: off by more than this (pixels) without it; it is taken if Schwarz's criterion is less by this (very strong evidence).
WIDE_DEG, BADLY_PX, CLEARLY = 40.0, 0.3, 10.0
#: The kinds of distortion that are tried, with their numbers of coefficients, and these numbers for a fisheye.
USUAL: tuple[tuple[Distortion, int], ...] = (("none", 0), ("radial", 2), ("all", 4))
FISHEYE = (2, 4)
#: Corners that fit better than this (pixels) say nothing more about the lens.
FINEST_PX = 0.01
#: A view whose corners are off by more than this multiple of the median view's, and by a pixel, was misread.
MISREAD, MISREAD_PX = 4.0, 1.0
#: Intrinsics are undetermined if the standard deviation of f over f, or of c over the width, is larger than this.
LARGEST_SIGMA = 0.1


@dataclass(frozen=True, eq=False)
class EstimatedIntrinsics:
    """Intrinsics that fit views of planes."""

    camera: Camera
    sigma: Array  #: (4,): standard deviations of fx, fy, cx and cy, pixels, by the corners' residuals
    rms_px: float  #: Root mean square length of the residuals, pixels
    #: How many of them were used
    views: int
    corners: int


@dataclass(frozen=True, eq=False)
class _Fit:
    """A camera and poses (V, 4, 4) that fit views; squared residuals (V,), px^2; the camera's number of parameters."""

    camera: Camera
    T: Array
    squares: Array
    parameters: int

    def criterion(self, corners: int) -> float:
        """Schwarz's criterion of 2 residuals a corner."""
        least = corners * FINEST_PX**2
        return float(2 * corners * np.log(max(self.squares.sum(), least)) + self.parameters * np.log(2 * corners))


def estimated_intrinsics(
    corners_m: Sequence[Array], corners_px: Sequence[Array], size: tuple[int, int], lens: Lens = "any"
) -> EstimatedIntrinsics:
    """Estimate a camera's intrinsics.

    Parameters
    ----------
    corners_m : sequence of (n_i, 3) arrays
        Corners of flat targets, with z = 0, metres. Views of fewer than `CORNERS` are not used.
    corners_px : sequence of (n_i, 2) arrays
        Where they were seen, pixels.
    size : (int, int)
        Width and height of the images, pixels.
    lens : "any", "pinhole", "radtan", "equidistant" or "unified"

    Raises
    ------
    CameraError
        There are too few views, no intrinsics fit them, or they do not determine any.
    """
    views = [(p, u) for p, u in zip(corners_m, corners_px, strict=True) if len(p) >= CORNERS]
    if len(views) < VIEWS:
        raise CameraError(
            f"cannot be estimated from {counted(len(views), 'view')} of a flat target with "
            f"{CORNERS} corners and more; at least {VIEWS} are needed, at different tilts"
        )
    views = _well_read(different_views(views), size)
    found = _best(views, size, lens)
    if found is None:
        raise CameraError(
            f"could not be estimated: no {'camera' if lens == 'any' else lens} fits its {len(views)} views of flat "
            "targets. Frontal views do not tell a focal length: tilt the targets by 20 to 50 degrees, each way"
        )
    corners = sum(len(p) for p, _ in views)
    sigma = _sigma(found, views)
    K = found.camera.K
    if not (sigma[:2] <= LARGEST_SIGMA * K[[0, 1], [0, 1]]).all() or not (sigma[2:] <= LARGEST_SIGMA * size[0]).all():
        tilts = np.degrees(np.arccos(np.clip(np.abs(found.T[:, 2, 2]), 0.0, 1.0)))
        raise CameraError(
            f"are not determined by its {len(views)} views of flat targets: f = {K[0, 0]:.0f} px with a standard "
            f"deviation of {_number(sigma[:2].max())} px, and the centre's is {_number(sigma[2:].max())} px. The "
            f"targets are tilted by {tilts.min():.0f} to {tilts.max():.0f} degrees against the image; tilt them by 20 "
            "to 50 degrees, each way"
        )
    rms_px = float(np.sqrt(found.squares.sum() / corners))
    camera = _as_unified(found.camera, views) if lens == "unified" else found.camera
    return EstimatedIntrinsics(camera, sigma, rms_px, len(views), corners)


def different_views(views: Views, most: int = ENOUGH) -> list[tuple[Array, Array]]:
    """At most ``most`` views, in their order, chosen as different from each other as possible.

    Views differ by the place of a board's outline in the image: many views come from a camera that stood still.
    """
    if len(views) <= most:
        return list(views)
    outlines = np.array([_outline(p, u) for p, u in views])
    usable = np.flatnonzero(np.isfinite(outlines).all(axis=1))
    if len(usable) <= most:
        return [views[i] for i in usable.tolist()] or list(views[:most])
    away = np.linalg.norm(outlines[usable] - outlines[usable].mean(axis=0), axis=1)
    chosen = [int(np.argmin(away))]
    away = np.linalg.norm(outlines[usable] - outlines[usable[chosen[0]]], axis=1)
    for _ in range(most - 1):
        chosen.append(int(np.argmax(away)))
        away = np.minimum(away, np.linalg.norm(outlines[usable] - outlines[usable[chosen[-1]]], axis=1))
    return [views[usable[i]] for i in sorted(chosen)]


def _well_read(views: list[tuple[Array, Array]], size: tuple[int, int]) -> list[tuple[Array, Array]]:
    """The views without those that fit a usual lens far worse than most."""
    found = next(_usual(views, size, USUAL[1:2]), None)
    if found is None:
        return views
    rms = np.sqrt(found.squares / [len(p) for p, _ in views])
    good = rms <= max(MISREAD_PX, MISREAD * float(np.median(rms)))
    kept = [view for view, is_good in zip(views, good.tolist(), strict=True) if is_good]
    return kept if len(kept) >= VIEWS else views


def _outline(points: Array, pixels: Array) -> Array:
    """Where the corners of the smallest upright rectangle about a view's corners are in the image (8,)."""
    with extra_named():
        import cv2

    H, _ = cv2.findHomography(points[:, :2], pixels, 0)
    if H is None:
        return np.full(8, np.nan)
    (left, down), (right, up) = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    rectangle = np.array([[left, down], [right, down], [right, up], [left, up]])[:, None]
    return np.asarray(cv2.perspectiveTransform(rectangle, H), dtype=float).ravel()


def _best(views: Views, size: tuple[int, int], lens: Lens) -> _Fit | None:
    """The fit with the lens model that Schwarz's criterion selects."""
    corners = sum(len(p) for p, _ in views)

    def least(fits: Iterator[_Fit]) -> _Fit | None:
        return min(fits, key=lambda fit: fit.criterion(corners), default=None)

    if lens in ("equidistant", "unified"):
        return least(_fisheye(views, size))
    usual = least(_usual(views, size, USUAL[:1] if lens == "pinhole" else USUAL))
    if lens != "any" or (usual is not None and _is_usual(usual, corners)):
        return usual
    fisheye = least(_fisheye(views, size))
    if usual is None or fisheye is None:
        return usual or fisheye
    return fisheye if fisheye.criterion(corners) < usual.criterion(corners) - CLEARLY else usual


def _is_usual(fit: _Fit, corners: int) -> bool:
    """Whether the lens is not wide and the fit is good."""
    camera = fit.camera
    reach = np.degrees(np.arctan2(0.5 * np.hypot(camera.width, camera.height), camera.K[0, 0]))
    return bool(reach < WIDE_DEG and fit.squares.sum() < corners * BADLY_PX**2)


def _usual(views: Views, size: tuple[int, int], tried: Sequence[tuple[Distortion, int]]) -> Iterator[_Fit]:
    """Pinholes with these kinds of distortion."""
    points, pixels = [p for p, _ in views], [u for _, u in views]
    for distortion, number in tried:
        fitted = fitted_to_planes(points, pixels, size, distortion)
        if fitted is not None:
            yield from _checked(views, size, "radtan" if number else "pinhole", fitted, number)


def _fisheye(views: Views, size: tuple[int, int]) -> Iterator[_Fit]:
    """Fisheyes, with the later of the four coefficients zero or free."""
    points, pixels = [p for p, _ in views], [u for _, u in views]
    for number in FISHEYE:
        fitted = fisheye_fitted_to_planes(points, pixels, size, number)
        if fitted is not None:
            yield from _checked(views, size, "equidistant", fitted, number)


def _checked(views: Views, size: tuple[int, int], model: str, fitted: PlanesFitted, number: int) -> Iterator[_Fit]:
    """The fit, if a camera can have these intrinsics and its lens does not fold back in the image.

    The first ``number`` coefficients were free; the others are zero, and a pinhole has none.
    """
    K, T, D = fitted.K, fitted.T, fitted.D if model == "equidistant" else fitted.D[:number]
    upright = [[K[0, 0], 0.0, K[0, 2]], [0.0, K[1, 1], K[1, 2]], [0.0, 0.0, 1.0]]
    if not np.isfinite(T).all():
        return
    try:
        camera = Camera.of(*size, model, upright, D, "an estimate")
    except CameraError:  # no camera has such a focal length, centre or distortion
        return
    w, h = size[0] - 1.0, size[1] - 1.0
    border = np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]])
    # A fisheye's image may be a circle inside the picture.
    looked_at = np.concatenate([u for _, u in views] + [border] * (model != "equidistant"))
    if not np.isfinite(camera.undistort(looked_at)).all():
        return
    p, u, known = stacked(*zip(*views, strict=True))
    r, _, _ = linearised(camera, T, p, u, known, 4)
    squares = np.einsum("vi,vi->v", r, r)
    if np.isfinite(squares).all():
        yield _Fit(camera, T, squares, 4 + number)


def _as_unified(camera: Camera, views: Views) -> Camera:
    """A fisheye's curve as f (m + k1 m^3 + k2 m^5), m = tan(theta / 2), which is the unified model with xi = 1."""
    seen = camera.undistort(np.concatenate([u for _, u in views]))
    furthest = np.arctan(np.nanmax(np.linalg.norm(seen, axis=1)))
    theta = np.linspace(0.0, furthest, 50)[1:]
    curve = theta * (1.0 + (theta[:, None] ** [2, 4, 6, 8]) @ camera.D)
    f, *k = np.linalg.lstsq(np.tan(0.5 * theta)[:, None] ** [1, 3, 5], curve, rcond=None)[0].tolist()
    K = camera.K * [[f, 1.0, 1.0], [1.0, f, 1.0], [1.0, 1.0, 1.0]]
    return replace(camera, model="unified", K=K, D=np.array([1.0, *(np.array(k) / f), 0.0, 0.0]))


def _sigma(fit: _Fit, views: Views) -> Array:
    """Standard deviations (4,) of fx, fy, cx and cy, with poses and coefficients free; infinite if undetermined."""
    p, u, known = stacked(*zip(*views, strict=True))
    q = min(fit.parameters, 4 + len(fit.camera.D))
    _, J, K = linearised(fit.camera, fit.T, p, u, known, q)
    freedom = 2 * int(known.sum()) - 6 * len(views) - fit.parameters
    scale = np.linalg.norm(K.reshape(-1, q), axis=0)
    K = K / np.where(scale > 0.0, scale, 1.0)
    # residuals that the poses leave: K - J J^+ K
    rest = K - J @ (np.linalg.pinv(J) @ K)
    information = np.einsum("vip,viq->pq", rest, rest)
    eigenvalues = np.linalg.eigvalsh(information)
    if freedom <= 0 or eigenvalues[0] <= 1e-14 * eigenvalues[-1]:
        return np.full(4, np.inf)
    variance = max(float(fit.squares.sum()) / freedom, FINEST_PX**2)
    return np.asarray(np.sqrt(variance * np.diagonal(np.linalg.inv(information))[:4]) / scale[:4])


def board_rows(camera: Camera, T: Array, p: Array, u: Array, known: np.ndarray) -> tuple[Array, Array, Array, Array]:
    """Errors of corners p (n, 3) or (views, n, 3) against pixels u, in views with poses T (views, 4, 4).

    Residuals (views, 2 n), their derivatives by right perturbations of the poses (views, 2 n, 6) and by the places
    (views, n, 2, 3), and normalised coordinates (views, n, 2); all zero where a corner is not `known`.
    """
    seen = p @ T[:, :3, :3].swapaxes(1, 2) + T[:, None, :3, 3]
    seen = np.where(known[..., None], seen, [0.0, 0.0, 1.0])
    x = seen[..., :2] / seen[..., 2:]
    pixels, by_x = camera.pixel_jacobian(x)
    by_seen = np.concatenate([by_x, -(by_x @ x[..., None])], axis=-1) / seen[..., 2, None, None]
    on = known[..., None].astype(float)
    by_place = by_seen @ T[:, None, :3, :3] * on[..., None]
    J = np.concatenate([-by_place @ se3.hat(p), by_place], axis=-1)
    return ((pixels - u) * on).reshape(len(T), -1), J.reshape(len(T), -1, 6), by_place, x


def linearised(camera: Camera, T: Array, p: Array, u: Array, known: np.ndarray, q: int) -> tuple[Array, Array, Array]:
    """Residuals (views, 2 n), and their derivatives by the poses (right perturbations) and by q intrinsic numbers."""
    r, J, _, x = board_rows(camera, T, p, u, known)
    bent = (camera.pixels(x) - camera.K[:2, 2]) / np.diagonal(camera.K)[:2]
    K = np.zeros((*bent.shape, q))
    K[..., 0, 0], K[..., 1, 1] = bent[..., 0], bent[..., 1]
    K[..., 0, 2] = K[..., 1, 3] = 1.0
    if q > 4:
        K[..., 4:] = np.diagonal(camera.K)[:2, None] * coefficient_jacobian(camera.model, camera.D, x)[..., : q - 4]
    return r, J, (K * known[..., None, None]).reshape(len(T), -1, q)


def poses_eliminated(r: Array, J: Array, K: Array) -> tuple[Array, Array, Array]:
    """Gauss-Newton with the poses eliminated: H (q, q) and gradients (views, q) of the q numbers that all views share.

    Also the poses' solutions (views, 6, q + 1), for the columns of K and for r. Raises LinAlgError for a singular view.
    """
    Jt, Kt = J.swapaxes(1, 2), K.swapaxes(1, 2)
    H_pk, q = Jt @ K, K.shape[2]
    solved = np.linalg.solve(Jt @ J, np.concatenate([H_pk, Jt @ r[..., None]], axis=2))
    parts = (Kt @ r[..., None])[..., 0] - np.einsum("vij,vi->vj", H_pk, solved[..., q])
    return (Kt @ K - H_pk.swapaxes(1, 2) @ solved[..., :q]).sum(axis=0), parts, solved


def _number(value: float) -> str:
    return f"{value:.0f}" if np.isfinite(value) else "unlimited"
