"""How far off is a point that a sensor sees: the uncertainty of a calibration in task units.

A point p in the frame f, seen from a carrier or from another frame g on the same carrier, is q = T_g_f p. To first
order an error xi = [omega, v] of T_g_f Expmap(xi) moves it by R_g_f (omega x p + v), so its covariance is J Sigma J'
with J = R_g_f [-[p]x, I]. With one scale for all lengths, the point is taken as measured (true = measured / scale), and
an error of the scale moves it by -p d(scale) / scale. On the other carrier, T_g_f has the pose A of the moment.

The noise of one new measurement comes on top, and is told apart: it averages out over measurements, and the
calibration's error does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from rwhec_factors import se3
from scipy.special import chdtr, chdtri, fdtr, fdtri

from gtsam_rwhec.errors import OptionError, PoseError
from gtsam_rwhec.files.rounded_numbers import rounded
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.poses import LARGEST_M, Array
from gtsam_rwhec.geometry.real_numbers import is_real

#: Nodes of the quadrature over directions, in cos(polar angle) and in azimuth. With these the probability of a ball is
#: right to 1e-6 for axes of any ratio that changes the radius.
NODES = (48, 24)


@dataclass(frozen=True, eq=False)
class PointUncertainty:
    """How far off a point is that is seen in one frame and expressed in another.

    Attributes
    ----------
    point_m : (3,) array
        The point in ``frame``, metres.
    frame, seen_from : str
        The frame of the point, and the frame in which it is expressed.
    level : float
        Probability of the ellipsoid and of the ball.
    centre_m : (3,) array
        The point in ``seen_from``, metres.
    covariance_m2 : (3, 3) array
        Covariance of the centre from the calibration's errors, in the axes of ``seen_from``, m^2; infinite in rows that
        a free direction moves.
    axes : (3, 3) array
        Columns: the ellipsoid's axes in ``seen_from``, the longest first.
    half_lengths_mm : (3,) array
        The ellipsoid's half axes at the level, millimetres.
    radius_mm : float
        The true point is within this distance of the centre with probability ``level``, millimetres.
    measurement_mm : float or None
        The same radius for the noise of one new measurement alone, which is not in ``radius_mm``: of the sensor, and of
        A where the point is expressed on the other carrier. None where nothing is measured, and where the noise is not
        known.
    """

    point_m: Array
    frame: str
    seen_from: str
    level: float
    centre_m: Array
    covariance_m2: Array
    axes: Array
    half_lengths_mm: Array
    radius_mm: float
    measurement_mm: float | None

    def __str__(self) -> str:
        distance_m = float(np.linalg.norm(self.point_m))
        return point_sentence(self.frame, self.seen_from, distance_m, self.level, self.radius_mm, self.measurement_mm)


def point_sentence(
    frame: str, seen_from: str, distance_m: float, level: float, radius_mm: float, measurement_mm: float | None
) -> str:
    """How far off a point is, as one sentence."""
    what = f"A point {distance_m:.2f} m from {frame}, expressed in {seen_from},"
    if not np.isfinite(radius_mm):
        return f"{what} is not determined: the measurements leave a direction free that moves it."
    said = f"{what} is within {rounded(radius_mm)} mm of its true place with {100 * level:g} % probability"
    if measurement_mm is None:
        return f"{said}."
    return f"{said}; the noise of one new measurement adds up to {rounded(measurement_mm)} mm."


def checked_point(point: ArrayLike) -> Array:
    """A point (3,) in metres; a PoseError for anything else."""
    try:
        result = np.asarray(point, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise PoseError(f"the point is {brief(point)}; give three numbers, metres") from error
    if result.shape != (3,) or not (np.abs(result) <= LARGEST_M).all():
        raise PoseError(f"the point is {brief(point)}; give three finite numbers, metres, up to {LARGEST_M:g}")
    return result


def checked_level(level: float) -> float:
    """A probability between 0 and 1; an OptionError for anything else."""
    if not (is_real(level) and 0.0 < level < 1.0):
        raise OptionError(f"level={brief(level)}; give one between 0 and 1")
    return float(level)


def jacobian_of_point(R: Array, point: Array) -> Array:
    """J (3, 6) = R [-[p]x, I]: the movement of R p + t by a right perturbation [omega, v]."""
    return np.asarray(R @ np.hstack([-se3.hat(point), np.eye(3)]))


def ellipsoid(covariance: Array, level: float, degrees_of_freedom: float) -> tuple[Array, Array, float]:
    """Axes (3, 3), half lengths (3,) and the ball's radius, for a covariance (3, 3), in its unit of length.

    With finite degrees of freedom (the noise was estimated) the error is a multivariate t, and the ellipsoid is that of
    3 F(3, nu). The longest axis is first. Where rows are infinite, these axes come first and have infinite lengths.
    """
    free = ~np.isfinite(np.diagonal(covariance))
    inside = np.flatnonzero(~free)
    values, vectors = np.linalg.eigh(covariance[np.ix_(inside, inside)])
    order = np.argsort(values)[::-1]
    variances = np.concatenate([np.full(free.sum(), np.inf), np.maximum(values[order], 0.0)])
    axes = np.zeros((3, 3))
    axes[np.flatnonzero(free), np.arange(free.sum())] = 1.0
    axes[np.ix_(inside, np.arange(free.sum(), 3))] = vectors[:, order]
    infinite = np.isinf(degrees_of_freedom)
    square = chdtri(3, 1.0 - level) if infinite else 3.0 * fdtri(3, degrees_of_freedom, level)
    return axes, np.sqrt(square * variances), ball_radius(variances, level, degrees_of_freedom)


def ball_radius(variances: Array, level: float, degrees_of_freedom: float = np.inf) -> float:
    """The radius of the ball about the centre that holds a normal (or t) vector with this probability.

    In polar coordinates z = rho u of the whitened error, u is uniform on the sphere and independent of rho^2, which is
    chi-square with 3 degrees of freedom (or 3 F(3, nu)). So P(|e| <= r) is the mean over u of P(rho^2 <= r^2 / u'Vu).
    """
    if not np.isfinite(variances).all():
        return float("inf")
    largest = float(variances.max())
    if largest <= 0.0:
        return 0.0
    x, wx = np.polynomial.legendre.leggauss(NODES[0])
    y, wy = np.polynomial.legendre.leggauss(NODES[1])
    cosine, azimuth = 0.5 * (x + 1.0), 0.25 * np.pi * (y + 1.0)  # one octant; the others are alike
    weight = 0.25 * wx[:, None] * wy
    sine = np.sqrt(1.0 - cosine**2)
    direction = np.stack(
        [
            np.broadcast_to(cosine[:, None], weight.shape),
            sine[:, None] * np.cos(azimuth),
            sine[:, None] * np.sin(azimuth),
        ]
    )
    spread = np.einsum("i,ixy->xy", np.sort(variances)[::-1] / largest, direction**2)

    def lacking(square: float) -> float:
        ratio = square / spread
        known = chdtr(3, ratio) if np.isinf(degrees_of_freedom) else fdtr(3, degrees_of_freedom, ratio / 3.0)
        return float((weight * known).sum()) - level

    end = 1.0
    while lacking(end) < 0.0:
        end *= 4.0
    from scipy.optimize import brentq  # here, since its import takes as long as a calibration of few poses

    return float(np.sqrt(largest * brentq(lacking, 0.0, end, xtol=1e-12)))
