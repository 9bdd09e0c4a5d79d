"""Poses of targets from their corners: both of a plane's two candidates, refined, with covariances.

IPPE (Collins and Bartoli 2014, in OpenCV) gives two poses. Gauss-Newton on the reprojection error in pixels refines
both, for all targets at once. A far or nearly frontal plane has two minima of nearly the same error: a single image
does not show which one is right (see `ambiguity`).

Corners of several planes start from SQPnP (Terzakis and Lourakis 2020, in OpenCV). The second candidate is that of the
plane nearest to them, if it leads to another minimum: a thin bundle far away is almost a plane.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.files.optional_packages import extra_named
from gtsam_rwhec.geometry.poses import Array

#: Gauss-Newton takes at most this many steps.
STEPS = 15
#: The iteration ends when the costs change by less than this share.
SETTLED = 1e-9
#: Corners are in one plane if they are nearer to it than this share of their extent.
FLAT = 1e-4


@dataclass(frozen=True, eq=False)
class PlanePoses:
    """Poses of N targets. Each target has up to two candidates, and the better candidate is first."""

    T: Array  #: (N, 2, 4, 4): T_camera_target, metres; nan where no pose was found
    squared_px: Array  #: (N, 2): sums of squared reprojection errors, px^2
    reprojection_px: Array  #: (N, 2): root mean square over corners of the error's length, px
    covariance: Array  #: (N, 2, 6, 6): covariance of the right perturbation [omega (rad), v (m)], from corner noise
    #: (N, n, 2): seen minus predicted corners of the better candidate; nan where a target has fewer corners
    errors_px: Array


def plane_poses(
    camera: Camera, corners_m: Sequence[Array], corners_px: Sequence[Array], *, corner_px: float
) -> PlanePoses:
    """Estimate poses of targets.

    Parameters
    ----------
    corners_m : sequence of (n_i, 3) arrays
        In each target's frame, in one plane or not. A target with fewer than four corners has no pose (nan).
    corners_px : sequence of (n_i, 2) arrays
        Where the corners were seen.
    corner_px : float
        Standard deviation of a corner along each axis, pixels.
    """
    p, u, known = stacked(corners_m, corners_px)
    x = camera.undistort(np.where(known[..., None], u, camera.K[:2, 2]))
    start = np.array([_starts(p[i, k], x[i, k]) for i, k in enumerate(known)]).reshape(-1, 2, 4, 4)
    T, squared, covariance, errors = _refined(camera, start, p, u, known, corner_px)
    order = np.argsort(np.where(np.isfinite(squared), squared, np.inf), axis=1)
    T, covariance = (np.take_along_axis(x, order[:, :, None, None], axis=1) for x in (T, covariance))
    squared = np.take_along_axis(squared, order, axis=1)
    errors = np.take_along_axis(errors, order[:, :1, None, None], axis=1)[:, 0]
    errors[~known] = np.nan
    count = np.maximum(known.sum(axis=1), 1)[:, None]
    return PlanePoses(T, squared, np.sqrt(squared / count), covariance, errors)


def stacked(corners_m: Sequence[Array], corners_px: Sequence[Array]) -> tuple[Array, Array, np.ndarray]:
    """Corners (N, n, 3), pixels (N, n, 2), and which of them there are (N, n), of N views with up to n corners each."""
    N, most = len(corners_m), max((len(points) for points in corners_m), default=0)
    p, u, known = np.zeros((N, most, 3)), np.zeros((N, most, 2)), np.zeros((N, most), dtype=bool)
    for i, (points, pixels) in enumerate(zip(corners_m, corners_px, strict=True)):
        n = len(points)
        p[i, :n], u[i, :n], known[i, :n] = points, pixels, True
    return p, u, known


def _starts(points: Array, x: Array) -> Array:
    """First poses (2, 4, 4) from corners (n, 3) and normalised coordinates; nan where there is none."""
    with extra_named():
        import cv2

    if len(points) < 4 or not points[:, 2].any():
        return _ippe(points, x)
    middle = points.mean(axis=0)
    _, extent, axes = np.linalg.svd(points - middle, full_matrices=False)
    to_plane = np.eye(4)  # T_plane_target, with z = 0 in the plane
    to_plane[:3, :3] = axes * np.array([1.0, 1.0, np.sign(np.linalg.det(axes))])[:, None]
    to_plane[:3, 3] = -to_plane[:3, :3] @ middle
    in_plane = points @ to_plane[:3, :3].T + to_plane[:3, 3]
    is_flat = extent[2] <= FLAT * extent[0]
    in_plane[:, 2] = 0.0
    T = _ippe(in_plane, x) @ to_plane
    if is_flat or not np.isfinite(x).all():
        return T
    found, turn, t = cv2.solvePnP(points[:, None], x[:, None], np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
    if not found or not np.isfinite(turn).all() or not t[2, 0] > 0.0:
        return T
    best = se3.pose(cv2.Rodrigues(turn)[0], t[:, 0])
    # The plane's pose that is further from SQPnP's may lead to another minimum.
    likeness = np.nan_to_num(np.einsum("cij,ij->c", T[:, :3, :3], best[:3, :3]), nan=np.inf)
    return np.stack([best, T[int(np.argmin(likeness))]])


def _ippe(points: Array, x: Array) -> Array:
    """IPPE's two poses (2, 4, 4) from normalised coordinates. A pose that is not found is nan."""
    with extra_named():
        import cv2

    T = np.full((2, 4, 4), np.nan)
    if len(x) < 4 or not np.isfinite(x).all():
        return T
    # OpenCV is wrong, or divides by zero, for targets that are exactly frontal or on the axis: add a little noise.
    aside = np.stack([np.cos(np.arange(len(x))), np.sin(2.0 * np.arange(len(x)))], axis=1) * np.ptp(x, axis=0).max()
    for share in (1e-6, 1e-5):
        try:
            _, rotations, translations, _ = cv2.solvePnPGeneric(
                points[:, None], (x + share * aside)[:, None], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
            )
        except cv2.error:
            return T  # The corners are on one line.
        if all(np.isfinite(turn).all() for turn in rotations):
            break
    for k, (turn, t) in enumerate(zip(rotations[:2], translations[:2], strict=True)):
        if np.isfinite(turn).all() and np.isfinite(t).all() and t[2, 0] > 0.0:
            T[k] = np.eye(4)
            T[k, :3, :3], T[k, :3, 3] = cv2.Rodrigues(turn)[0], t[:, 0]
    return T


def _refined(
    camera: Camera, T: Array, p: Array, u: Array, known: np.ndarray, corner_px: float
) -> tuple[Array, Array, Array, Array]:
    """Refine T by damped Gauss-Newton; return T, sums of squares, covariances, and errors (N, 2, n, 2)."""
    shape = T.shape[:2]
    T = T.reshape(-1, 4, 4).copy()
    target = np.repeat(np.arange(shape[0]), shape[1])  # of each candidate
    damping = np.full(len(T), 1e-9)
    with np.errstate(invalid="ignore"):
        errors, H, g = _normal_equations(camera, T, p[target], u[target], known[target])
        cost = (errors**2).sum(axis=(1, 2))
        left = np.arange(len(T))  # candidates that still move
        for _ in range(STEPS):
            diagonal = np.einsum("naa->na", H[left])
            step = _solved(H[left] + np.eye(6) * (damping[left, None] * diagonal + 1e-12)[:, None], g[left][..., None])
            tried = T[left] @ se3.expmap(np.nan_to_num(step[..., 0]))
            of = target[left]
            new_errors, new_H, new_g = _normal_equations(camera, tried, p[of], u[of], known[of])
            before, new_cost = cost[left], (new_errors**2).sum(axis=(1, 2))
            better = new_cost <= before
            taken = left[better]
            T[taken], errors[taken], H[taken] = tried[better], new_errors[better], new_H[better]
            g[taken], cost[taken] = new_g[better], new_cost[better]
            damping[left] = np.where(better, damping[left] * 0.1, np.maximum(damping[left], 1e-6) * 100.0)
            # A change within rounding counts as converged, whether the cost falls or rises.
            moved = np.abs(before - new_cost) > SETTLED * (1e-6 + before)
            left = left[moved & (better | (damping[left] < 1.0))]
            if not len(left):
                break
    H /= corner_px**2
    covariance = _solved(H, np.broadcast_to(np.eye(6), H.shape))
    covariance = 0.5 * (covariance + np.swapaxes(covariance, -1, -2))
    cost = np.where(np.isfinite(T).all(axis=(-1, -2)) & np.isfinite(covariance).all(axis=(-1, -2)), cost, np.nan)
    return (
        T.reshape(*shape, 4, 4), cost.reshape(shape), covariance.reshape(*shape, 6, 6),
        errors.reshape(*shape, *errors.shape[1:]),
    )  # fmt: skip


def _normal_equations(camera: Camera, T: Array, p: Array, u: Array, known: np.ndarray) -> tuple[Array, Array, Array]:
    """Errors (M, n, 2), seen minus predicted, and J'J (M, 6, 6) and J'e (M, 6) of the predictions' derivatives J.

    A right perturbation [omega, v] moves a point of the target by R (omega x p + v) in the camera's frame.
    """
    R, t, rows = T[:, :3, :3], T[:, :3, 3], 2 * known.shape[1]
    seen = p @ R.transpose(0, 2, 1) + t[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        z = np.where(seen[..., 2] > 1e-9, seen[..., 2], np.nan)
        x = seen[..., :2] / z[..., None]
        pixels, D = camera.pixel_jacobian(x)
        # d(x, y)/d(X, Y, Z) = [I, -x] / Z
        by_seen = np.concatenate([D, -(D @ x[..., None])], axis=-1) / z[..., None, None]
        by_point = (by_seen.reshape(len(T), rows, 3) @ R).reshape(*known.shape, 2, 3)
    by_turn = np.cross(p[:, :, None], by_point)  # row' (omega x p) = omega' (p x row)
    J = np.where(known[..., None, None], np.concatenate([by_turn, by_point], axis=-1), 0.0).reshape(len(T), rows, 6)
    errors = np.where(known[..., None], u - pixels, 0.0)
    Jt = J.transpose(0, 2, 1)
    return errors, Jt @ J, (Jt @ errors.reshape(len(T), rows, 1))[..., 0]


def _solved(H: Array, g: Array) -> Array:
    """H^-1 g, with g (..., 6, n). It is nan where H is singular or not finite."""
    bad = np.asarray(~np.isfinite(H).all(axis=(-1, -2)))
    # Units differ (rad, m): scale to a unit diagonal before the test and the solution.
    unit = np.sqrt(np.where(bad[..., None], 1.0, np.maximum(np.einsum("...aa->...a", H), 1e-300)))
    scaled = np.where(bad[..., None, None], np.eye(6), H / (unit[..., :, None] * unit[..., None, :]))
    bad |= np.linalg.eigvalsh(scaled)[..., 0] < 1e-14
    scaled = np.where(bad[..., None, None], np.eye(6), scaled)
    result = np.linalg.solve(scaled, np.nan_to_num(g) / unit[..., None]) / unit[..., None]
    return np.where(bad[..., None, None], np.nan, result)
