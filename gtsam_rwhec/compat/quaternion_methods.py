"""Rotation first, translation second: Tsai & Lenz 1989, Park & Martin 1994, Horaud & Dornaika 1995.

They use all pairs of stations, as OpenCV does. A pair's rotations enter by signs of quaternions, logarithms or
thresholds, so they are computed pair by pair, in blocks. Translations need sums over stations only.
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.compat.inputs import PARALLEL
from gtsam_rwhec.compat.pair_translations import translation_features, translation_of
from gtsam_rwhec.compat.stations import Stations, pair_blocks
from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import ROTATION, to_rotations
from gtsam_rwhec.solver.rotations import project

#: Tsai's method uses motions of at least this 2 sin(angle / 2), by both sensors (from tests of OpenCV 4, to 1e-14).
TSAI_LEAST = 0.3
#: Such a motion has at most this 2 sin(angle / 2).
TSAI_MOST = 1.7


def tsai(stations: Stations) -> tuple[Array, Array]:
    """Tsai & Lenz 1989: Skew(P_A + P_B) P' = P_B - P_A by least squares (eq. 12), P = 2 sin(angle/2) axis.

    Only motions of 17 to 116 degrees are used, as by OpenCV 4. Raises UnderdeterminedError when fewer than two motions
    are in this range (OpenCV then returns the identity), or when they all rotate about one axis.
    """
    count = len(stations.u)
    features = translation_features(stations)
    feature_sums, used = np.zeros_like(features), 0
    outer, sums = np.zeros((3, 3)), np.zeros(3)
    for block in pair_blocks(stations):
        vectors = 2.0 * np.stack([block.a[:3], block.b[:3]])
        lengths = np.sqrt((vectors**2).sum(axis=1))
        inside = (lengths > TSAI_LEAST) & (lengths < TSAI_MOST)
        use = inside[0] & inside[1] & (block.weight > 0.0)
        used += int(use.sum())
        feature_sums[block.first : block.last] = use.astype(float) @ features[: block.last]
        a, b = vectors[0][:, use], vectors[1][:, use]
        plus = a + b
        outer += plus @ plus.T
        sums += np.cross(b - a, plus, axis=0).sum(axis=1)  # Skew(s)'(b - a) = (b - a) x s
    if used < 2:
        raise UnderdeterminedError(
            f"Tsai's method uses motions with 2 sin(angle/2) between {TSAI_LEAST} and {TSAI_MOST} (17 to 116 degrees) "
            f"by both sensors; {used} of the {count * (count - 1) // 2} motions are in this range, and two are needed; "
            "add poses that turn further, or use another method"
        )
    normal = np.trace(outer) * np.eye(3) - outer  # Skew(s)'Skew(s) = |s|^2 I - s s'
    if np.linalg.eigvalsh(normal)[0] <= PARALLEL * np.trace(outer):
        raise UnderdeterminedError(
            f"Tsai's method uses motions of 17 to 116 degrees, and these {used} motions all rotate about one axis; add "
            "poses that turn about another axis, or use another method"
        )
    x = np.linalg.solve(normal, sums)
    R = to_rotations(np.append(x, 1.0))
    return R, translation_of(stations, R, feature_sums)


def park(stations: Stations) -> tuple[Array, Array]:
    """Park & Martin 1994: R = (M'M)^(-1/2) M' with M the sum of log(R_B) log(R_A)' (their eq. 27)."""
    M = np.zeros((3, 3))
    for block in pair_blocks(stations):
        M += _moment(block.a[:3], _log_factor(block.a) * _log_factor(block.b) * block.weight, block.b[:3])
    R = project(M[None])[0]  # M here is the sum of log(R_A) log(R_B)', and R the rotation nearest to it
    return R, translation_of(stations, R)


def horaud(stations: Stations) -> tuple[Array, Array]:
    """Horaud & Dornaika 1995: q minimises the sum of |v_A q - q v_B|^2 (eq. 31), v the quaternions' vector parts.

    Vector parts have length sin(angle/2), so the axes of larger motions weigh more, as in OpenCV.
    """
    M = np.zeros((3, 3))
    for block in pair_blocks(stations):
        M += _moment(block.a[:3], block.weight, block.b[:3])
    # |v_A q - q v_B|^2 = |v_A|^2 + |v_B|^2 - 2 v_A . (R v_B): the quaternion of the nearest rotation (Horn 1987).
    N = np.einsum("cdij,ij->cd", ROTATION, M)
    R = to_rotations(np.linalg.eigh(N)[1][:, -1])
    return R, translation_of(stations, R)


def _moment(a: Array, weight: Array, b: Array) -> Array:
    return (a * weight).reshape(3, -1) @ b.reshape(3, -1).T


def _log_factor(q: Array) -> Array:
    """The factor from a quaternion's vector part to the rotation vector, for nonnegative scalar parts."""
    length = np.sqrt((q[:3] ** 2).sum(axis=0))
    safe = np.maximum(length, 1e-150)
    return np.where(length > 1e-8, 2.0 * np.arctan2(length, q[3]) / safe, 2.0)
