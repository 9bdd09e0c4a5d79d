"""A carrier's path as smooth pieces: poses and velocities at any time, with less noise than the poses that were logged.

About each knot the path is a cubic in the tangent space of a logged pose, T_k Expmap(c_0 + c_1 d + c_2 d^2 + c_3 d^3),
fitted by least squares to the poses in a window (Fan and Gijbels, Local Polynomial Modelling and Its Applications,
Section 3.1). Linear interpolation between two noisy poses has a noise that depends on the place between them, and its
slope shares this noise. Both pull a time offset towards places where the noise is small. The middle of a symmetric
window does neither: there the errors of a pose and of its velocity are uncorrelated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import StampError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.trajectories.trajectory import Trajectory

#: The longest half window, s.
LONGEST_S = 0.4
#: The shortest half window holds about this many poses on each side.
FEWEST_A_SIDE = 3.5
#: A window is too long if its poses scatter by this factor (of standard deviations) more than in the shortest window.
LACK_OF_FIT = 1.05
#: Knots are this part of the half window apart.
KNOT_STEP = 0.25
#: This many knots tell whether a window is too long.
TRIAL_KNOTS = 200
#: At most this many poses in a window are used; they are taken evenly.
MOST_IN_WINDOW = 400
#: This many poses are compared with their knots at once, so that memory stays bounded.
POSES_AT_ONCE = 200_000


@dataclass(frozen=True)
class SmoothPath:
    """A smooth path T_a_b over time.

    Attributes
    ----------
    knots_ns : (K,) integers
        Stamps of the knots.
    T : (K, 4, 4) array
        Poses that the tangent spaces belong to, metres.
    coefficients : (K, 4, 6) array
        c_0 (rad, m), c_1 (rad/s, m/s), c_2, c_3.
    velocity_variance : (K, 6) array
        Variance of c_1, from the poses' scatter.
    scatter : (6,) array
        Variance of a logged pose about the path, rad^2 and m^2.
    degrees_of_freedom : float
        Of the scatter.
    half_window_s : float
        Half of the window's length.
    """

    knots_ns: np.ndarray
    T: Array
    coefficients: Array
    velocity_variance: Array
    scatter: Array
    degrees_of_freedom: float
    half_window_s: float

    @staticmethod
    def of(path: Trajectory, longest_s: float = LONGEST_S) -> SmoothPath:
        """The smooth path of logged poses; the window is as long as it can be without a lack of fit.

        Raises
        ------
        StampError
            The path has fewer than eight poses.
        """
        if len(path.T) < 8:
            raise StampError(
                f"{path.where}: {len(path.T)} poses are too few for a velocity, which needs eight; log poses faster"
            )
        period_s = float(np.median(np.diff(path.stamps_ns))) * 1e-9
        half_s = FEWEST_A_SIDE * period_s
        trial = _fitted(path, half_s, TRIAL_KNOTS)
        # The scatter itself is known to sqrt(2 / degrees of freedom); three of these are no lack of fit.
        most = LACK_OF_FIT**2 * (1.0 + 3.0 * np.sqrt(2.0 / trial.degrees_of_freedom)) * trial.scatter + 1e-24
        while half_s < longest_s:
            longer = min(1.6 * half_s, longest_s)
            if (_fitted(path, longer, TRIAL_KNOTS).scatter > most).any():
                break
            half_s = longer
        return _fitted(path, half_s)

    def at(self, stamps_ns: np.ndarray) -> tuple[Array, Array, Array]:
        """Poses (M, 4, 4), velocities (M, 6) in the moved frame's own axes, and velocities' variances (M, 6)."""
        nearest, d = self._nearest(stamps_ns)
        h = 1e-4
        before, here, after = (self._poses(nearest, x) for x in (d - h, d, d + h))
        velocity = se3.logmap(se3.inverse(before) @ after) / (2.0 * h)
        return here, velocity, self.velocity_variance[nearest]

    def poses(self, stamps_ns: np.ndarray) -> Array:
        """Poses (M, 4, 4) alone."""
        return self._poses(*self._nearest(stamps_ns))

    def _nearest(self, stamps_ns: np.ndarray) -> tuple[np.ndarray, Array]:
        """The knot nearest to each stamp, and the time from there, s."""
        stamps = np.asarray(stamps_ns, dtype=np.int64)
        nearest = np.searchsorted((self.knots_ns[1:] + self.knots_ns[:-1]) // 2, stamps)
        return nearest, (stamps - self.knots_ns[nearest]) * 1e-9

    def _poses(self, knot: np.ndarray, d: Array) -> Array:
        c, d = self.coefficients[knot], d[:, None]
        poses: Array = self.T[knot] @ se3.expmap(c[:, 0] + d * (c[:, 1] + d * (c[:, 2] + d * c[:, 3])))
        return poses


def _fitted(path: Trajectory, half_s: float, most_knots: int | None = None) -> SmoothPath:
    """The cubics with one window length, at all knots, or at some of them."""
    stamps = path.stamps_ns
    # Knots are at logged stamps, about a quarter of the half window apart, and at both ends of each gap.
    cell = ((stamps - stamps[0]) // max(round(KNOT_STEP * half_s * 1e9), 1)).astype(np.int64)
    new = np.r_[True, np.diff(cell) > 0]
    new |= np.r_[new[1:] & (np.diff(cell) > 1), True]
    at = np.flatnonzero(new)
    if most_knots is not None and len(at) > most_knots:
        at = at[np.linspace(0, len(at) - 1, most_knots).astype(int)]
    window_ns = round(half_s * 1e9)
    low = np.searchsorted(stamps, stamps[at] - window_ns)
    high = np.searchsorted(stamps, stamps[at] + window_ns, side="right")
    low, high = np.minimum(low, np.maximum(at - 2, 0)), np.maximum(high, np.minimum(at + 3, len(stamps)))
    stride = np.maximum((high - low) // MOST_IN_WINDOW, 1)
    width = int(((high - low - 1) // stride + 1).max())
    coefficients, leverage = np.zeros((len(at), 4, 6)), np.zeros(len(at))
    squares, degrees_of_freedom = np.zeros((len(at), 6)), np.zeros(len(at))
    block = max(1, POSES_AT_ONCE // width)
    for i in range(0, len(at), block):
        own = slice(i, i + block)
        rows = low[own, None] + stride[own, None] * np.arange(width)
        near = rows < high[own, None]
        rows = np.minimum(rows, len(stamps) - 1)
        tau = (stamps[rows] - stamps[at[own], None]) * 1e-9 / half_s
        anchor = se3.inverse(path.T[at[own]])[:, None]
        xi = se3.logmap((anchor @ path.T[rows]).reshape(-1, 4, 4)).reshape(*tau.shape, 6)
        order = np.minimum(near.sum(axis=1) - 1, 4)[:, None, None]
        Z = np.where(near[..., None] & (np.arange(4) < order), tau[..., None] ** np.arange(4), 0.0)
        inverse = np.linalg.pinv(Z)
        solution = inverse @ xi
        coefficients[own] = solution / half_s ** np.arange(4)[:, None]
        leverage[own] = (inverse[:, 1] ** 2).sum(axis=1) / half_s**2
        squares[own] = (np.where(near[..., None], xi - Z @ solution, 0.0) ** 2).sum(axis=1)
        degrees_of_freedom[own] = near.sum(axis=1) - order[:, 0, 0]
    free = max(float(degrees_of_freedom.sum()), 1.0)
    scatter = squares.sum(axis=0) / free
    return SmoothPath(stamps[at], path.T[at], coefficients, leverage[:, None] * scatter, scatter, free, half_s)
