"""The poses of a hand-eye problem, station by station, and the motions between all pairs of stations.

The motion from station i to a later station j is A = G_j^-1 G_i and B = C_j C_i^-1 with A X = X B. G is the gripper's
pose in the base, C the target's pose in the camera, X the camera's pose in the gripper. OpenCV uses this direction and
all pairs i < j: answers on noisy poses show it.

Terms that are bilinear in the two stations (translations, products of rotations) are summed in linear time: the sum
over i < j of f_i g_j needs g_j and the running sum of f. Other terms (signs of quaternions, logarithms, thresholds) are
computed for blocks of pairs, one matrix product for each block, so memory is linear too.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import conjugate, left, of_rotations

#: A block has at most about this many pairs: a dozen arrays of this size stay within the processor's cache.
BLOCK_PAIRS = 1 << 15


@dataclass(frozen=True)
class Stations:
    """Poses of N stations: R_G (N, 3, 3) and t_G (N, 3) of the gripper in the base, about the mean of t_G.

    R_C (N, 3, 3) is the target in the camera, and u (N, 3) is R_C' t_C (minus the camera's position in the target's
    frame), about its mean ``origin`` (3,).
    """

    R_G: Array
    t_G: Array
    R_C: Array
    u: Array
    origin: Array

    @property
    def t_C(self) -> Array:
        """(N, 3) translations of the target in the camera, about the mean ``origin``."""
        t: Array = np.einsum("nab,nb->na", self.R_C, self.u)
        return t


def stations_of(R_G: Array, t_G: Array, R_C: Array, t_C: Array) -> Stations:
    """Stations with translations relative to their mean: the origin changes no motion, only rounding errors."""
    u = np.einsum("nba,nb->na", R_C, t_C)
    origin = u.mean(axis=0)
    return Stations(R_G, t_G - t_G.mean(axis=0), R_C, u - origin, origin)


def all_earlier(features: Array) -> Array:
    """Each station's sum of the features over all earlier stations."""
    sums = np.zeros_like(features)
    np.cumsum(features[:-1], axis=0, out=sums[1:])
    return sums


@dataclass(frozen=True)
class PairBlock:
    """Rotations of a block of pairs, as quaternions with nonnegative scalar parts.

    The later stations are first, ..., last - 1. a and b (4, J, I) are the quaternions (xyzw) of A and of B between the
    later stations (J) and all stations before ``last`` (I), ``signs`` (J, I) the factors +-1 that make their scalar
    parts nonnegative. ``weight`` (J, I) is 1 for pairs of a station and an earlier station, else 0.
    """

    first: int
    last: int
    a: Array
    b: Array
    signs: tuple[Array, Array]
    weight: Array


def pair_blocks(stations: Stations) -> Iterator[PairBlock]:
    """All pairs, block by block; q_A = q_G,j* (x) q_G,i and q_B = q_C,j (x) q_C,i*, a matrix product a block."""
    q_G, q_C = of_rotations(stations.R_G), of_rotations(stations.R_C)
    left_G, left_C = left(conjugate(q_G)), left(q_C)
    right_G, right_C = q_G.T, conjugate(q_C).T
    step = max(1, BLOCK_PAIRS // len(q_G))
    for first in range(0, len(q_G), step):
        last = min(first + step, len(q_G))
        a = products(left_G[first:last], right_G[:, :last])
        b = products(left_C[first:last], right_C[:, :last])
        signs = (np.copysign(1.0, a[3]), np.copysign(1.0, b[3]))
        weight = (np.arange(last) < np.arange(first, last)[:, None]).astype(float)
        yield PairBlock(first, last, a * signs[0], b * signs[1], signs, weight)


def products(matrices: Array, columns: Array) -> Array:
    """The products of matrices (J, 4, k) with columns (k, I): (4, J, I)."""
    stacked = np.ascontiguousarray(matrices.transpose(1, 0, 2)).reshape(-1, matrices.shape[2])
    product: Array = stacked @ columns
    return product.reshape(4, len(matrices), -1)
