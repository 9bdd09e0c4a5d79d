"""The carriers' motion about each stamp, from the poses themselves: what a time offset moves A along.

A cubic in the tangent space of each pose, A(t + d) = A(t) Expmap(c_1 d + c_2 d^2 + c_3 d^3), fitted to the poses within
half a second. Differences of neighbouring poses would be noise at a camera's rate, and noise in a velocity pulls the
offset towards zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import CountError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.trajectories.trajectory import Trajectory

#: Poses this far from a stamp, in time, tell the motion there.
WINDOW_S = 0.5
#: Of a path that was logged fast, this many poses about a stamp.
NEAREST = 32
#: Poses further apart than this say little of the motion in between.
LONGEST_GAP_S = 1.0
#: Entries (rad and m) of two poses of one stamp differ by no more than this, or the poses are of two carriers.
SAME_POSE = 1e-6


@dataclass(frozen=True)
class LocalPaths:
    """The motion about each of N stamps.

    Attributes
    ----------
    coefficients : (N, 3, 6) array
        c_1 (rad/s, m/s), c_2, c_3.
    leverage : (N,) array
        Variance of c_1 over that of a pose's noise, 1/s^2.
    scatter : (6,) array
        Variance of the poses about the cubics, rad^2 and m^2.
    """

    coefficients: Array
    leverage: Array
    scatter: Array

    def motion(self, offset_s: float) -> Array:
        """Expmap(c_1 d + c_2 d^2 + c_3 d^3), (N, 4, 4)."""
        powers = float(np.clip(offset_s, -WINDOW_S, WINDOW_S)) ** np.arange(1, 4)  # nothing is known beyond
        return se3.expmap(np.einsum("k,nki->ni", powers, self.coefficients))

    def twists(self, offset_s: float = 0.0) -> Array:
        """Velocity (N, 6) at the stamps plus an offset, [omega rad/s, v m/s], in the moved carrier's own axes."""
        if offset_s == 0.0:
            return self.coefficients[:, 0]
        h = 1e-4
        return se3.logmap(se3.inverse(self.motion(offset_s - h)) @ self.motion(offset_s + h)) / (2.0 * h)

    def selected(self, mask: np.ndarray) -> LocalPaths:
        """Of the stamps marked or indexed."""
        return LocalPaths(self.coefficients[mask], self.leverage[mask], self.scatter)

    @staticmethod
    def of(A: Array, stamps_ns: np.ndarray, where: str) -> LocalPaths:
        """Fit them.

        Parameters
        ----------
        A : (N, 4, 4) array
            T_sensorcarrier_targetcarrier, in any order; a stamp may be there several times, with one pose.
        stamps_ns : (N,) integers
        where : str
            For messages.

        Raises
        ------
        CountError
            For fewer than two stamps, two poses at one stamp, or a pose without any neighbour within a second.
        """
        stamps, first, place = np.unique(stamps_ns, return_index=True, return_inverse=True)
        poses = A[first]
        off = np.abs(A - poses[place]).max(axis=(1, 2))
        if off.max() > SAME_POSE:
            raise CountError(
                f"{where}: two carrier poses have the stamp {stamps_ns[int(off.argmax())]} ns; a time offset needs one "
                "for each stamp"
            )
        if len(stamps) < 2:
            raise CountError(f"{where}: a time offset needs at least two stamps; there is {len(stamps)}")
        seconds = (stamps - stamps[0]) * 1e-9
        coefficients, leverage = np.zeros((len(stamps), 3, 6)), np.zeros(len(stamps))
        squares, degrees_of_freedom = np.zeros(6), 0
        for i in range(len(stamps)):
            near = _neighbours(seconds, i)
            if len(near) < 2:
                raise CountError(
                    f"{where}: the measurement at {stamps[i]} ns has no other within {LONGEST_GAP_S:g} s, so nothing "
                    "tells how fast the carrier moved there; leave it out, or estimate no time offset for its sensor"
                )
            tau = seconds[near] - seconds[i]
            xi = se3.logmap(se3.inverse(poses[i : i + 1]) @ poses[near])
            # A constant takes up the noise of the pose itself, where there are poses enough.
            degree = min(3, len(near) - 1)
            Z = tau[:, None] ** np.arange(0 if len(near) > 2 else 1, degree + 1)
            solution, _, _, _ = np.linalg.lstsq(Z, xi, rcond=None)
            start = 1 if len(near) > 2 else 0
            coefficients[i, : len(solution) - start] = solution[start:]
            leverage[i] = np.linalg.pinv(Z.T @ Z)[start, start]
            squares += ((xi - Z @ solution) ** 2).sum(axis=0)
            degrees_of_freedom += len(near) - Z.shape[1]
        return LocalPaths(coefficients[place], leverage[place], squares / max(degrees_of_freedom, 1))

    @staticmethod
    def along(path: Trajectory, stamps_ns: np.ndarray) -> LocalPaths:
        """Fit them to a path that was logged faster than anything was measured: to the poses next to each stamp.

        Parameters
        ----------
        path : Trajectory
            T_sensorcarrier_targetcarrier over time.
        stamps_ns : (N,) integers

        Raises
        ------
        CountError
            For a stamp that has fewer than four of the path's poses within half a second.
        """
        stamps, place = np.unique(stamps_ns, return_inverse=True)
        here, _ = path.at(stamps)
        first = np.searchsorted(path.stamps_ns, stamps) - NEAREST // 2
        rows = np.clip(first, 0, max(len(path.T) - NEAREST, 0))[:, None] + np.arange(min(NEAREST, len(path.T)))
        tau = (path.stamps_ns[rows] - stamps[:, None]) * 1e-9
        near = np.abs(tau) <= WINDOW_S
        if (near.sum(axis=1) < 4).any():
            i = int(np.argmin(near.sum(axis=1)))
            raise CountError(
                f"{path.where}: {near[i].sum()} poses within {WINDOW_S:g} s of the measurement at {stamps[i]} ns; a "
                "time offset needs four and more, to tell how fast the carrier moved"
            )
        xi = se3.logmap((se3.inverse(here)[:, None] @ path.T[rows]).reshape(-1, 4, 4)).reshape(*tau.shape, 6)
        # Columns scaled by the window: third powers of milliseconds are nothing.
        Z = np.where(near[..., None], (tau[..., None] / WINDOW_S) ** np.arange(4), 0.0)
        inverse = np.linalg.pinv(Z)
        solution = inverse @ np.where(near[..., None], xi, 0.0)
        left = np.where(near[..., None], xi - Z @ solution, 0.0)
        degrees_of_freedom = max(int((near.sum(axis=1) - 4).sum()), 1)
        powers = WINDOW_S ** np.arange(1, 4)
        leverage = (inverse[:, 1] ** 2).sum(axis=1) / WINDOW_S**2
        return LocalPaths(
            (solution[:, 1:] / powers[:, None])[place], leverage[place], (left**2).sum(axis=(0, 1)) / degrees_of_freedom
        )


def _neighbours(seconds: Array, i: int) -> np.ndarray:
    """Indices of the poses about the i-th, itself too: half a second either way, two at least, across no long gap."""
    low = high = i
    while low > 0 and seconds[low] - seconds[low - 1] <= LONGEST_GAP_S:
        if seconds[i] - seconds[low - 1] > WINDOW_S and i - low >= 2:
            break
        low -= 1
    while high < len(seconds) - 1 and seconds[high + 1] - seconds[high] <= LONGEST_GAP_S:
        if seconds[high + 1] - seconds[i] > WINDOW_S and high - i >= 2:
            break
        high += 1
    return np.arange(low, high + 1)
