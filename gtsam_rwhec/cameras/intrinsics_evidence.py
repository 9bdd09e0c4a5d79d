"""Whether the corners of a plane, seen from many sides, fit the stated intrinsics: Zhang's test.

A view of a plane gives eight equations, and its pose uses six: two are left for the intrinsics (Zhang 2000, section
2.3). Focal lengths and principal point are estimated with all poses, with a prior at the stated values (3 % and 30
pixels) and the stated distortion. A second fit has a wide prior and two coefficients of distortion: it finds a lens
distortion that nobody stated, or intrinsics of another resolution. The change is also compared with the scatter between
views, since a bent board gives all corners of a view similar errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from rwhec_factors import se3
from scipy.special import fdtrc

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.target_poses import stacked
from gtsam_rwhec.cameras.unknown_intrinsics import fitted_to_planes, linearised, poses_eliminated
from gtsam_rwhec.geometry.poses import Array

#: Fewer views give no result; a view needs this number of corners.
LEAST_VIEWS, LEAST_CORNERS = 8, 8
#: At most this number of views is used, spread evenly over the track.
MOST_VIEWS = 40
#: Prior of nominal intrinsics: focal length (relative), principal point (pixels).
NOMINAL_SHARE, NOMINAL_PX = 0.03, 30.0
#: In the second fit, the prior is this many times as wide, and coefficients of distortion have this standard deviation.
WIDER, DISTORTION = 20.0, 0.5
#: Views are different if the board is turned by this angle (radians), or moved by this share of its distance.
APART = 0.03
#: Corners have at least this standard deviation, pixels.
LEAST_PX = 0.02
#: Rounds of Gauss-Newton; it ends when no intrinsic number changes by more than `SETTLED_PX`.
ROUNDS, SETTLED_PX = 30, 1e-3
#: Shares of a step that are tried, until the cost is smaller.
SHARES = (1.0, 0.5, 0.25, 0.1, 0.02)
#: The stated intrinsics do not fit if the scatter between views explains the change with at most this probability, and
#: residuals are larger by at least this factor, and by this many pixels (difference of squares).
LEAST_PROBABILITY, LARGER, LARGER_PX = 1e-4, 1.08, 0.02
#: The same for the second fit: a bent board may look like distortion.
LEAST_FAR, LARGER_FAR = 1e-6, 1.25
#: Poses are useless if fx, fy, cx or cy is off by more than `USELESS` of the focal length, beyond two standard
#: deviations, or if the changed distortion moves the outermost corner by more than `USELESS_BEND` focal lengths.
USELESS, USELESS_BEND = 0.01, 0.003


@dataclass(frozen=True, eq=False)
class View:
    """Corners of a plane in an image: their places (n, 3), metres, z = 0; pixels (n, 2); T_camera_target (4, 4)."""

    corners_m: Array
    corners_px: Array
    T: Array


@dataclass(frozen=True, eq=False)
class IntrinsicsEvidence:
    """What the corners of a sensor say about its stated intrinsics."""

    stated: Camera
    fitted: Camera
    #: (4,) or (6,): standard deviations of the fitted fx, fy, cx, cy, pixels, and of two coefficients of distortion
    #: where they are fitted too
    sigma: Array
    #: Root mean squares of the reprojection errors, pixels, each with the poses that fit best
    stated_px: float
    fitted_px: float
    probability: float  #: Probability that correct intrinsics lead to so large a change
    views: int
    reach: float  #: Largest normalised radius of a corner that was seen

    @property
    def contradicts(self) -> bool:
        """Whether the stated intrinsics do not fit the corners."""
        far = len(self.sigma) > 4
        least, larger = (LEAST_FAR, LARGER_FAR) if far else (LEAST_PROBABILITY, LARGER)
        excess = self.stated_px**2 - self.fitted_px**2
        return self.probability < least and self.stated_px > larger * self.fitted_px and excess > LARGER_PX**2

    @property
    def is_far_off(self) -> bool:
        """Whether the stated intrinsics are so wrong that poses are useless (`USELESS`, `USELESS_BEND`)."""
        change = np.abs(_numbers(self.fitted)[:4] - _numbers(self.stated)[:4]) - 2.0 * self.sigma[:4]
        return bool((change > USELESS * self.stated.K[0, 0]).any()) or self.bend > USELESS_BEND

    @property
    def bend(self) -> float:
        """How far the fitted distortion moves the outermost corner that was seen, a share of the focal length."""
        if len(self.sigma) == 4:
            return 0.0
        at = np.array([[self.reach, 0.0]])
        moved = self.fitted.pixels(at) - self.fitted.K[:2, 2] - self.fitted.K[0, 0] * at
        before = self.stated.pixels(at) - self.stated.K[:2, 2] - self.stated.K[0, 0] * at
        return float(np.abs(moved / self.fitted.K[0, 0] - before / self.stated.K[0, 0]).max())


def evidence_of_intrinsics(camera: Camera, views: Sequence[View]) -> IntrinsicsEvidence | None:
    """Fit intrinsics to the views of planes; None if they are too few, or no fit is found."""
    views = [view for view in views if len(view.corners_px) >= LEAST_CORNERS]
    views = [views[i] for i in different([view.T for view in views])]
    if len(views) < LEAST_VIEWS:
        return None
    p, u, known = stacked([view.corners_m for view in views], [view.corners_px for view in views])
    T = np.array([view.T for view in views])
    stated = _fitted(camera, T, p, u, known, free=0.0)
    if stated is None:
        return None
    reach = float(np.linalg.norm(camera.undistort(u[known]), axis=1).max(initial=0.0))
    near = _fitted(camera, stated.T, p, u, known, free=1.0)
    found = None if near is None else _compared(camera, stated, near, known, reach)
    if near is not None and found is not None and found.contradicts:  # then what is stated is no prior for what fits
        again = _fitted(camera, near.T, p, u, known, free=WIDER)
        found = found if again is None else _compared(camera, stated, again, known, reach)
    lens = replace(camera, model="radtan", D=np.zeros(4)) if camera.model == "pinhole" else camera  # zero, to be fitted
    start = _far_start(lens, views)
    far = None if start is None else _fitted(lens, start[1], p, u, known, free=WIDER, lens=start[0])
    elsewhere = None if far is None else _compared(lens, stated, far, known, reach)
    if elsewhere is None or (found is not None and not elsewhere.contradicts):
        return found
    if found is not None and found.contradicts and elsewhere.fitted_px > LARGER * found.fitted_px:
        return found
    return elsewhere


def different(poses: Sequence[Array]) -> list[int]:
    """Indices of different poses, spread evenly over the track: all images of a camera at rest are one view."""
    kept: list[int] = []
    for i in np.unique(np.linspace(0, len(poses) - 1, 4 * MOST_VIEWS).astype(int)) if len(poses) else ():
        if kept:
            T = np.array([poses[k] for k in kept])
            turned = np.linalg.norm(se3.so3_logmap(T[:, :3, :3].swapaxes(1, 2) @ poses[i][:3, :3]), axis=1)
            moved = np.linalg.norm(T[:, :3, 3] - poses[i][:3, 3], axis=1) / np.linalg.norm(poses[i][:3, 3])
            if (np.maximum(turned, moved) < APART).any():
                continue
        kept.append(int(i))
    return [kept[i] for i in np.unique(np.linspace(0, len(kept) - 1, MOST_VIEWS).astype(int))] if kept else []


def _far_start(camera: Camera, views: Sequence[View]) -> tuple[Camera, Array] | None:
    """Intrinsics and poses by OpenCV, which finds them from far away; None for a fisheye, or if it finds none."""
    if camera.model != "radtan":
        return None
    corners, pixels = [view.corners_m for view in views], [view.corners_px for view in views]
    found = fitted_to_planes(corners, pixels, (camera.width, camera.height), "radial", camera.K)
    if found is None:
        return None
    K = found.K
    return _with_numbers(camera, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *found.D[:2]])), found.T


def _compared(camera: Camera, stated: _Fit, fitted: _Fit, known: np.ndarray, reach: float) -> IntrinsicsEvidence | None:
    """Test the change by the scatter between the views, and by that of all corners: the less certain one counts."""
    n, corners, free = len(known), int(known.sum()), len(fitted.H)
    if n <= free:
        return None
    change = (_numbers(fitted.camera) - _numbers(camera))[:free]
    freedom = max(2 * corners - 6 * n - free, 1)
    probability, sigma = change_test(
        change, fitted.H, fitted.parts, fitted.rms_px**2 * corners / freedom, freedom, least=1e-12
    )
    return IntrinsicsEvidence(camera, fitted.camera, sigma, stated.rms_px, fitted.rms_px, probability, n, reach)


def change_test(
    change: Array, H: Array, parts: Array, variance: float, freedom: int, least: float = 0.0
) -> tuple[float, Array]:
    """The probability of a change (q,) by chance, and its standard deviations (q,): the larger of two each.

    By the scatter of the views' gradients `parts` (views, q), which includes errors shared within a view (Liang and
    Zeger 1986; Hotelling's T^2), and by the variance of a corner's residual, with its degrees of freedom. `least` is
    added to the covariances' diagonals.
    """
    n, q = parts.shape
    back = np.linalg.inv(H)
    of_views = back @ (parts.T @ parts) @ back * n / (n - 1.0)
    of_corners = variance * back
    squared = [float(change @ np.linalg.solve(S + least * np.eye(q), change)) for S in (of_views, of_corners)]
    probability = max(
        float(fdtrc(q, n - q, squared[0] * (n - q) / (q * (n - 1.0)))), float(fdtrc(q, freedom, squared[1] / q))
    )
    return probability, np.sqrt(np.maximum(np.diag(of_views), np.diag(of_corners)))


@dataclass(frozen=True, eq=False)
class _Fit:
    """Intrinsics and poses at the minimum; H (q, q) and gradients (views, q) of q intrinsics, poses eliminated."""

    camera: Camera
    T: Array
    rms_px: float
    H: Array
    parts: Array


def _fitted(
    prior: Camera, T: Array, p: Array, u: Array, known: np.ndarray, *, free: float, lens: Camera | None = None
) -> _Fit | None:
    """Gauss-Newton on all poses, and on intrinsics with the nominal prior, made wider by the factor `free`.

    If `lens` is given, it is the start, and two coefficients of distortion are free too.
    """
    nominal = np.array([NOMINAL_SHARE * prior.K[0, 0], NOMINAL_SHARE * prior.K[1, 1], NOMINAL_PX, NOMINAL_PX])
    nominal *= free or 1.0
    if lens is not None:
        nominal = np.append(nominal, [DISTORTION, DISTORTION])
    q = len(nominal)
    count = int(known.sum())
    camera = lens or prior
    r, J, K = linearised(camera, T, p, u, known, q)
    for _ in range(ROUNDS):
        if not np.isfinite(r).all():
            return None
        from_prior = (_numbers(camera) - _numbers(prior))[:q]
        try:
            H, parts, solved = poses_eliminated(r, J, K)
        except np.linalg.LinAlgError:
            return None
        weight = max(float((r**2).sum()) / max(2 * count - 6 * len(T), 1), LEAST_PX**2) / nominal**2
        H = H + np.diag(weight)
        step = -np.linalg.solve(H, parts.sum(axis=0) + weight * from_prior) if free else np.zeros(q)
        motion = -(solved[..., q] + solved[..., :q] @ step)
        cost = float((r**2).sum() + weight @ from_prior**2)
        for share in SHARES:
            T_next, next_ = T @ se3.expmap(share * motion), _with_numbers(camera, _numbers(camera)[:q] + share * step)
            of_next = linearised(next_, T_next, p, u, known, q)
            if (of_next[0] ** 2).sum() + weight @ (_numbers(next_) - _numbers(prior))[:q] ** 2 <= cost * (1.0 + 1e-9):
                break
        T, camera, (r, J, K) = T_next, next_, of_next
        if max(np.abs(step).max(), np.abs(motion).max() * camera.K[0, 0]) < SETTLED_PX:
            break
    of_corners = float(np.sqrt((r**2).sum() / count))
    return _Fit(camera, T, of_corners, H, parts)


def _numbers(camera: Camera) -> Array:
    """fx, fy, cx, cy, and the first two coefficients of distortion."""
    K = camera.K
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *np.pad(camera.D, (0, 2))[:2]])


def _with_numbers(camera: Camera, numbers: Array) -> Camera:
    fx, fy, cx, cy, *bent = numbers.tolist()
    D = np.concatenate([bent, camera.D[len(bent) :]])
    return replace(camera, K=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), D=D)
