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

from dataclasses import dataclass, field, replace

import numpy as np

from gtsam_rwhec.geometry.poses import LARGEST_M, Array, checked_rows
from gtsam_rwhec.geometry.rounding import UNIT

R_A, T_A, R_B, T_B, ONE = slice(0, 9), slice(9, 12), slice(12, 21), slice(21, 24), 24
#: This is the order of the features for the inverse equation, B X^-1 = Y^-1 A, in which A and B change places.
SWAPPED = np.r_[12:24, 0:12, 24]
#: This many measurements are summed at once; a block of this size stays in the processor's cache.
BLOCK = 2048
#: Rows of a block are longer than a power of two by this many numbers, so that they do not compete for the same cache
#: lines.
UNEVEN = 8
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
    """Sums over the `count` measurements of one pair; ``a + b`` is the moments of both.

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
    projected: int = 0

    @staticmethod
    def of(A: Array, B: Array, weight: Array, kappa: Array, gauge: Gauge, motion: bool, where: str) -> Moments:
        """Moments of N measurements, block by block; every pose is checked (``poses.checked_rows``).

        A, B are (N, 4, 4); weight is 1 / sigma^2 (1/m^2) and kappa, both () or (N,). ``motion`` says that both carriers
        are the sensor's (AX = XB); ``where`` is the name in messages.
        """
        translation = np.zeros((25, 25))
        rotation = np.zeros((9, 9))
        projected = 0
        a = gauge.sensor_carrier[:, None]
        c = gauge.sensor_carrier if motion else gauge.target_carrier
        features = np.empty((25, min(BLOCK, len(A)) + UNEVEN))
        reach, deviation = np.zeros(3), 0.0
        for first in range(0, len(A), BLOCK):
            part = slice(first, first + BLOCK)
            f = features[:, : min(BLOCK, len(A) - first)]
            of_A = checked_rows(A[part], first, f"A of {where}", f[:12])
            of_B = checked_rows(B[part], first, f"B of {where}", f[12:24])
            projected += of_A.projected + of_B.projected
            deviation = max(deviation, of_A.deviation, of_B.deviation)
            np.maximum(reach, np.maximum(f[T_A].max(axis=1), -f[T_A].min(axis=1)), out=reach)
            f[T_A] += c[0] * f[0:3] + c[1] * f[3:6] + c[2] * f[6:9] - a
            f[ONE] = 1.0
            # The last column is left out, as it equals the last row: the product of a matrix with itself is slower.
            if weight.ndim == 0:
                translation[:, :ONE] += weight * (f @ f[:ONE].T)
                translation[ONE, ONE] += weight * f.shape[1]
            else:
                translation[:, :ONE] += (f * weight[part]) @ f[:ONE].T
                translation[ONE, ONE] += weight[part].sum()
            if kappa.ndim == 0:
                rotation += kappa * (f[R_A] @ f[R_B].T)
            else:
                rotation += (f[R_A] * kappa[part]) @ f[R_B].T
        translation[:ONE, ONE] = translation[ONE, :ONE]
        total = float(kappa) * len(A) if kappa.ndim == 0 else float(kappa.sum())
        feature_error = np.zeros(25)
        # Three products and four sums make a centred translation.
        centring = 8.0 * UNIT * (reach + np.abs(c).sum() + np.abs(a[:, 0]))
        feature_error[T_A] = centring * np.sqrt(translation[ONE, ONE])
        return Moments(
            len(A),
            total,
            translation,
            rotation,
            np.sqrt(np.diagonal(translation)) * (1.0 + 1e-9),
            feature_error,
            # The weight and its products take up to six operations; then a block is summed, and the blocks.
            min(BLOCK, len(A)) + -(-len(A) // BLOCK) + 6,
            # The rounding of the test of R'R itself is added.
            deviation + 8.0 * UNIT,
            projected,
        )

    @staticmethod
    def none() -> Moments:
        """The moments of no measurement."""
        return Moments(0, 0.0, np.zeros((25, 25)), np.zeros((9, 9)), np.zeros(25), np.zeros(25), 0, 0.0)

    def __add__(self, other: Moments) -> Moments:
        return Moments(
            self.count + other.count,
            self.kappa + other.kappa,
            self.translation + other.translation,
            self.rotation + other.rotation,
            np.hypot(self.magnitude, other.magnitude),
            np.hypot(self.feature_error, other.feature_error),
            max(self.operations, other.operations) + 1,
            max(self.deviation, other.deviation),
            self.projected + other.projected,
        )

    def shifted(self, a: Array, c: Array) -> Moments:
        """The moments about a gauge moved by a (sensor carrier) and c (target carrier), exactly."""
        shift = shift_of(a, c)
        return replace(
            self,
            translation=shift @ self.translation @ shift.T,
            magnitude=np.abs(shift) @ self.magnitude,
            feature_error=np.abs(shift) @ self.feature_error,
            operations=self.operations + SHIFT_OPERATIONS,
        )


def shift_of(a: Array, c: Array) -> Array:
    """The matrix of t_A' = t_A + R_A c - a, which is linear in the features; moments change by a congruence with it."""
    shift = np.eye(25)
    for i in range(3):
        shift[T_A, R_A][:, 3 * i : 3 * i + 3] = c[i] * I3
    shift[T_A, ONE] = -a
    return shift
