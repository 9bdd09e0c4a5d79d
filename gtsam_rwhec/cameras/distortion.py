"""Lens distortion in normalised coordinates, as OpenCV defines it, and its inverse."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.polynomial import Polynomial

from gtsam_rwhec.geometry.poses import Array

Model = Literal["pinhole", "radtan", "equidistant", "unified"]

#: Newton's method takes at most this many steps.
STEPS = 30
#: The iteration ends with a step smaller than this, in normalised coordinates.
NEAR = 1e-10


def distorted(model: Model, D: Array, x: Array) -> tuple[Array, Array]:
    """Distorted coordinates (..., 2) of normalised coordinates x (..., 2), and their derivatives (..., 2, 2) by x."""
    if model == "equidistant":
        return _equidistant(x, D)
    if model == "radtan":
        return _radtan(x, D)
    if model == "unified":
        m, by_x, _ = _from_sphere(x, D[0])
        bent, by_m = _radtan(m, D[1:])
        return bent, by_m @ by_x
    return x, np.broadcast_to(np.eye(2), (*x.shape[:-1], 2, 2))


def undistorted(model: Model, D: Array, wanted: Array, ring: float) -> Array:
    """Solve for x (..., 2) whose distorted coordinates are `wanted`, by Newton; x is nan if none is within `ring`."""
    if model == "pinhole":
        return wanted
    if model == "equidistant":
        return _undistorted_fisheye(D, wanted, ring)
    if model == "unified":
        return _to_rays(undistorted("radtan", D[1:], wanted, folding_radius("radtan", D[1:])), D[0], ring)
    x = wanted.copy()
    with np.errstate(all="ignore"):
        for _ in range(STEPS):
            bent, J = distorted(model, D, x)
            det = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
            off = wanted - bent
            # J^-1 off by Cramer's rule
            first = J[..., 1, 1] * off[..., 0] - J[..., 0, 1] * off[..., 1]
            second = J[..., 0, 0] * off[..., 1] - J[..., 1, 0] * off[..., 0]
            step = np.stack([first, second], axis=-1) / det[..., None]
            # Nothing is seen beyond the ring where distortion folds back (det <= 0).
            x = np.where(det[..., None] > 0.0, x + step, np.nan)
            if not np.nanmax(np.abs(step), initial=0.0) > NEAR:
                break
        reached = (np.abs(distorted(model, D, x)[0] - wanted) < 1e-8).all(axis=-1, keepdims=True)
        within = np.linalg.norm(x, axis=-1, keepdims=True) < ring
    return np.where(reached & within, x, np.nan)


def _undistorted_fisheye(D: Array, wanted: Array, ring: float) -> Array:
    """Do as `undistorted`, but by Newton on the angle, since tan grows too fast near 90 degrees."""
    k1, k2, k3, k4 = D
    curve = Polynomial([0.0, 1.0, 0.0, k1, 0.0, k2, 0.0, k3, 0.0, k4])
    slope = curve.deriv()
    furthest = float(np.arctan(ring))
    theta_d = np.linalg.norm(wanted, axis=-1, keepdims=True)
    theta = np.minimum(theta_d, furthest)
    with np.errstate(all="ignore"):
        for _ in range(STEPS):
            before = theta
            theta = np.clip(theta + (theta_d - curve(theta)) / slope(theta), 0.0, furthest)
            if not np.nanmax(np.abs(theta - before), initial=0.0) > NEAR:
                break
        seen = (np.abs(curve(theta) - theta_d) < 1e-9) & (theta < furthest)
        return np.where(seen, wanted * np.where(theta_d > 0.0, np.tan(theta) / theta_d, 1.0), np.nan)


def folding_radius(model: Model, D: Array) -> float:
    """The radius |x| at which the radial distortion folds back or has a pole; infinite if it does neither."""
    if model == "pinhole":
        return float("inf")
    if model == "equidistant":
        # d theta_d / d theta, in theta^2
        squared = _first_root(Polynomial([1.0, *(D * [3.0, 5.0, 7.0, 9.0])]))
        return float(np.tan(np.sqrt(squared))) if squared < (0.5 * np.pi) ** 2 else float("inf")
    if model == "unified":
        xi, folds = float(D[0]), folding_radius("radtan", D[1:])
        pole = float(np.sqrt(xi**-2 - 1.0)) if -1.0 < xi < 0.0 else float("inf")
        ray = float(_to_rays(np.array([folds, 0.0]), xi, pole)[0]) if np.isfinite(folds) else float("nan")
        return pole if np.isnan(ray) else ray
    k1, k2, _, _, k3, k4, k5, k6 = np.pad(D, (0, 8))[:8]
    above, below = Polynomial([1.0, k1, k2, k3]), Polynomial([1.0, k4, k5, k6])
    # d(r above / below) / dr, times below^2, in r^2
    slope = above * below + Polynomial([0.0, 2.0]) * (above.deriv() * below - above * below.deriv())
    return float(np.sqrt(min(_first_root(slope), _first_root(below))))


def _first_root(polynomial: Polynomial) -> float:
    """The smallest positive root of a polynomial that is 1 at 0. It is infinite if no root is real and positive."""
    # numpy finds the reciprocals of the roots here: the last coefficients can be almost 0, the first coefficient is 1.
    roots = np.roots(polynomial.coef)
    inverse = float(roots[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0.0)].real.max(initial=0.0))
    return 1.0 / inverse if inverse > 1e-12 else float("inf")


def _radtan(x: Array, D: Array) -> tuple[Array, Array]:
    """OpenCV's calib3d, "Detailed Description": x g(r^2) + tangential + thin prism, g rational."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = np.pad(D, (0, 14))[:12]
    a, b = x[..., 0], x[..., 1]
    r2 = a * a + b * b
    above, below = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    g = above / below
    # dg / d(r^2)
    dg = (k1 + r2 * (2 * k2 + 3 * k3 * r2) - g * (k4 + r2 * (2 * k5 + 3 * k6 * r2))) / below
    ab = a * b
    distorted = np.stack(
        [
            a * g + 2 * p1 * ab + p2 * (r2 + 2 * a * a) + r2 * (s1 + s2 * r2),
            b * g + p1 * (r2 + 2 * b * b) + 2 * p2 * ab + r2 * (s3 + s4 * r2),
        ],
        axis=-1,
    )
    J = np.empty((*x.shape, 2))
    mixed = 2 * ab * dg + 2 * p1 * a + 2 * p2 * b
    prism_a, prism_b = s1 + 2 * s2 * r2, s3 + 2 * s4 * r2
    J[..., 0, 0] = g + 2 * a * a * dg + 2 * p1 * b + 6 * p2 * a + 2 * a * prism_a
    J[..., 0, 1] = mixed + 2 * b * prism_a
    J[..., 1, 0] = mixed + 2 * a * prism_b
    J[..., 1, 1] = g + 2 * b * b * dg + 6 * p1 * b + 2 * p2 * a + 2 * b * prism_b
    return distorted, J


def _equidistant(x: Array, D: Array) -> tuple[Array, Array]:
    """OpenCV's fisheye: theta_d = theta (1 + k1 theta^2 + ... + k4 theta^8), x theta_d / r, r = tan theta."""
    r2 = np.einsum("...i,...i->...", x, x)
    r = np.sqrt(r2)
    theta = np.arctan(r)
    t2 = theta * theta
    k1, k2, k3, k4 = D
    theta_d = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
    small = r < 1e-6
    safe = np.where(small, 1.0, r)
    g = np.where(small, 1.0 + (k1 - 1.0 / 3.0) * r2, theta_d / safe)
    # (1/r) dg/dr, with dtheta/dr = 1 / (1 + r^2)
    dg = np.where(small, 2.0 * (k1 - 1.0 / 3.0), (slope / (1.0 + r2) - g) / (safe * safe))
    J = g[..., None, None] * np.eye(2) + dg[..., None, None] * x[..., :, None] * x[..., None, :]
    return x * g[..., None], J


def _from_sphere(x: Array, xi: float) -> tuple[Array, Array, Array]:
    """Mei and Rives 2007, (7): m = x / (1 + xi s), s = sqrt(1 + r^2); its derivatives by x (..., 2, 2) and by xi."""
    s = np.sqrt(1.0 + np.einsum("...i,...i->...", x, x))[..., None]
    below = 1.0 + xi * s
    m = x / below
    by_x = (np.eye(2) - xi * (m / s)[..., :, None] * x[..., None, :]) / below[..., None]
    return m, by_x, -s * m / below


def _to_rays(m: Array, xi: float, ring: float) -> Array:
    """x (..., 2) of m (..., 2), Mei and Rives 2007, (8); nan where the ray is not in front, or not within `ring`."""
    r2 = np.einsum("...i,...i->...", m, m)[..., None]
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = (xi + np.sqrt(1.0 + (1.0 - xi * xi) * r2)) / (1.0 + r2)
        x = m * scale / (scale - xi)
        return np.where((scale > xi) & (np.linalg.norm(x, axis=-1, keepdims=True) < ring), x, np.nan)


def coefficient_jacobian(model: Model, D: Array, x: Array) -> Array:
    """Derivatives (..., 2, n) of the distorted coordinates of x (..., 2) by the n coefficients."""
    r2 = np.einsum("...i,...i->...", x, x)
    if model == "equidistant":
        r = np.sqrt(r2)
        theta = np.arctan(r)
        over_r = np.where(r < 1e-6, 1.0, theta / np.where(r < 1e-6, 1.0, r))
        powers = np.stack([over_r * theta ** (2 * k) for k in range(1, 5)], axis=-1)
        along: Array = x[..., :, None] * powers[..., None, :]
        return along
    if model == "pinhole":
        return np.zeros((*x.shape, 0))
    if model == "unified":
        m, _, by_xi = _from_sphere(x, D[0])
        by_m = _radtan(m, D[1:])[1]
        return np.concatenate([by_m @ by_xi[..., None], coefficient_jacobian("radtan", D[1:], m)], axis=-1)
    k1, k2, _, _, k3, k4, k5, k6 = np.pad(D, (0, 14))[:8]
    a, b = x[..., 0], x[..., 1]
    J = np.zeros((*x.shape, len(D)))
    r4 = r2 * r2
    radial = {0: r2, 1: r4, 4: r4 * r2} if len(D) > 4 else {0: r2, 1: r4}
    if len(D) > 5:
        above, below = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        down = -above / (below * below)
        radial = {k: power / below for k, power in radial.items()} | {5: r2 * down, 6: r4 * down, 7: r4 * r2 * down}
    for k, along_x in radial.items():
        J[..., 0, k], J[..., 1, k] = a * along_x, b * along_x
    J[..., 0, 2], J[..., 0, 3] = 2 * a * b, r2 + 2 * a * a
    J[..., 1, 2], J[..., 1, 3] = r2 + 2 * b * b, 2 * a * b
    if len(D) > 8:
        J[..., 0, 8], J[..., 0, 9] = r2, r4
        J[..., 1, 10], J[..., 1, 11] = r2, r4
    return J
