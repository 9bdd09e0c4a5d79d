"""Moments of a pair's measurements, which are all that the cost needs, and the 25 x 25 forms that they give.

Moments are sums over the measurements, so they add: batches, logs and the results of several machines may be merged in
any order. They are sums about a reference (``Gauge``): with a distant world origin, products of uncentred translations
would lose the digits of the answer.

Each measurement has one column of 25 features::

    f = [vec R_A (9), t_A (3), vec R_B (9), t_B (3), 1]          (vec stacks columns)

``translation = sum f f' / sigma^2`` holds everything that eqs. 35-41 of the RWHEC paper need, for Problem 3 and for the
inverse equation (one scale per target). ``rotation = sum kappa vec(R_A) vec(R_B)'`` holds all that L(G^rho) needs.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gtsam_rwhec.geometry.poses import LARGEST_M, Array

R_A, T_A, R_B, T_B, ONE = slice(0, 9), slice(9, 12), slice(12, 21), slice(21, 24), 24
#: This is the order of the features for the inverse equation, B X^-1 = Y^-1 A, in which A and B change places.
SWAPPED = np.r_[12:24, 0:12, 24]
#: This many measurements are summed at once; a block of this size stays in the processor's cache.
BLOCK = 2048
#: A congruence with a 25 x 25 matrix rounds each entry at most this many times.
SHIFT_OPERATIONS = 54
I3 = np.eye(3)


@dataclass(frozen=True)
class Gauge:
    """The reference points of the moments: A -> T(-sensor_carrier) A T(target_carrier), in metres.

    X becomes T(-target_carrier) X and Y becomes T(-sensor_carrier) Y; the answer is shifted back exactly.
    """

    sensor_carrier: Array = field(default_factory=lambda: np.zeros(3))
    target_carrier: Array = field(default_factory=lambda: np.zeros(3))

    @staticmethod
    def of(A: Array, motion: np.ndarray) -> Gauge:
        """The reference that makes the translations of ``A`` (N, 4, 4) small: min |R_A c + t_A - a|^2 over a, c.

        Where ``motion`` (N,) is true, both ends are the sensor's carrier (AX = XB), and c = a. The solution has the
        minimum norm, so a component that the motions do not determine is zero. Numbers too large for poses give the
        gauge zero; ``Problem.add`` refuses them later.
        """
        if not np.abs(A).max() <= LARGEST_M:
            return Gauge()
        R, t = A[:, :3, :3], A[:, :3, 3]
        rows = np.zeros((len(A), 3, 6))
        rows[:, :, :3] = I3 - np.where(motion[:, None, None], R, 0.0)
        rows[:, :, 3:] = -np.where(motion[:, None, None], 0.0, R)
        solution = np.linalg.lstsq(rows.reshape(-1, 6), t.ravel(), rcond=1e-9)[0]
        return Gauge(solution[:3], solution[3:])

    @staticmethod
    def target_origin(A: Array, sensor_carrier: Array) -> Array:
        """The best reference point of the target carrier (3,) for a given one of the sensor carrier."""
        if not np.abs(A).max() <= LARGEST_M:
            return np.zeros(3)
        origin: Array = np.einsum("nji,nj->ni", A[:, :3, :3], sensor_carrier - A[:, :3, 3]).mean(axis=0)
        return origin

    def moved_by(self, a: Array, c: Array) -> Gauge:
        """The gauge after a further shift."""
        return Gauge(self.sensor_carrier + a, self.target_carrier + c)


@dataclass(frozen=True)
class Moments:
    """Sums over the `count` measurements of one pair.

    `kappa` is the sum of the rotation weights, `translation` (25, 25) is sum f f' / sigma^2, `rotation` (9, 9) is
    sum kappa vec(R_A) vec(R_B)'; the rotations of `projected` measurements were projected to SO(3).

    With m = ``magnitude`` (25,), e = ``feature_error`` (25,) and g = gamma(``operations``), an entry (i, j) of
    ``translation`` differs from that of the measurements in exact arithmetic by at most
    g m_i m_j + m_i e_j + e_i m_j + e_i e_j, and ``rotation`` by at most 3 g kappa, in the Frobenius norm. No entry of
    R'R - I is larger than ``deviation``.
    """

    count: int
    kappa: float
    translation: Array
    rotation: Array
    magnitude: Array
    feature_error: Array
    operations: int
    deviation: float
    projected: int


def shift_of(a: Array, c: Array) -> Array:
    """The matrix of t_A' = t_A + R_A c - a, which is linear in the features; moments change by a congruence with it."""
    shift = np.eye(25)
    for i in range(3):
        shift[T_A, R_A][:, 3 * i : 3 * i + 3] = c[i] * I3
    shift[T_A, ONE] = -a
    return shift
