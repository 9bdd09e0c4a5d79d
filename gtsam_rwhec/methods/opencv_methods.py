"""OpenCV's hand-eye methods over all pairs of stations, in linear time, and its two for A X = Z B.

The motion from station i to a later station j is A = G_j^-1 G_i and B = C_j C_i^-1 with A X = X B. G is the gripper's
pose in the base, C the target's pose in the camera, X the camera's pose in the gripper. Terms that are bilinear in the
two stations are summed in linear time: the sum over i < j of f_i g_j needs g_j and the running sum of f. Other terms
(signs of quaternions, logarithms, thresholds) are computed for blocks of pairs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from rwhec_factors.se3 import so3_nearest

from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import ROTATION, conjugate, dual_parts, left, of_rotations, to_rotations
from gtsam_rwhec.methods.dq_descent import squared, unit_combination
from gtsam_rwhec.methods.dq_saddle import minimum
from gtsam_rwhec.methods.dual_quaternion_cost import MotionMoments, gram, to_transform
from gtsam_rwhec.methods.linear_systems import solve_scaled
from gtsam_rwhec.methods.motions import UNCERTAIN

#: Rotation of the axes below this share of the largest possible one is rounding error.
PARALLEL = 1e-13
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


def station_features(stations: Stations) -> Array:
    """Features (N, 241) of each station, whose sums give ``pair_form``: 1, x = (u, rows of [R_G | t_G]), and x x'."""
    count = len(stations.u)
    E = np.concatenate([stations.R_G, stations.t_G[:, :, None]], axis=2).reshape(count, 12)
    x = np.concatenate([stations.u, E], axis=1)
    return np.concatenate([np.ones((count, 1)), x, np.einsum("na,nb->nab", x, x).reshape(count, 225)], axis=1)


def pair_form(stations: Stations, sums: Array | None = None) -> Array:
    """The sum of |(R_A - I) t - (R t_B - t_A)|^2 over pairs, as a form (13, 13) of (vec R, t, 1); vec takes rows.

    With E = [R_G | t_G], a pair's residual, turned by R_G,j, is R_G,j R t_B + (E_j - E_i) (t, 1), and
    t_B = R_C,j (u_j - u_i). So the form is made of the sums over i of (x_j - x_i)(x_j - x_i)' with x = (u, E).
    ``sums`` (N, 241) are the ``station_features`` summed over the earlier stations of each station's pairs; all
    earlier stations by default.
    """
    features = station_features(stations)
    sums = all_earlier(features) if sums is None else sums
    (ones, X, XX), x = np.split(sums, [1, 16], axis=1), features[:, 1:16]
    own, crossed = features[:, 16:].reshape(-1, 15, 15), np.einsum("na,nb->nab", x, X)
    M = ones[:, :, None] * own - crossed - crossed.transpose(0, 2, 1) + XX.reshape(-1, 15, 15)
    of_E = M[:, 3:, 3:].sum(axis=0).reshape(3, 4, 3, 4)
    form = np.empty((13, 13))
    form[:9, :9] = np.kron(np.eye(3), np.einsum("nab,nbc,ndc->ad", stations.R_C, M[:, :3, :3], stations.R_C))
    mixed = stations.R_C @ M[:, :3, 3:]
    form[:9, 9:] = np.einsum("nac,ndak->cdk", stations.R_G, mixed.reshape(-1, 3, 3, 4)).reshape(9, 4)
    form[9:, :9] = form[:9, 9:].T
    form[9:, 9:] = np.einsum("akal->kl", of_E)
    return form


def translation_of(stations: Stations, R: Array, sums: Array | None = None) -> Array:
    """The t (3,) that minimises ``pair_form`` for a rotation (Tsai & Lenz 1989, eq. 15)."""
    of_t = pair_form(stations, sums)[9:12]
    return -np.linalg.solve(of_t[:, 9:12], of_t[:, :9] @ R.ravel() + of_t[:, 12])


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
    features = station_features(stations)
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
    R = so3_nearest(M[None])[0]  # M here is the sum of log(R_A) log(R_B)', and R the rotation nearest to it
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


#: An eigenvalue below this of the scaled normal equations is rounding error.
SINGULAR = 1e-15
#: The message if the poses do not determine all entries of the rotation.
LENGTH_UNKNOWN = (
    "{} linear system finds the rotation's length from the translations, and these do not determine it: the gripper "
    "only turned, or hardly moved; move the gripper, or use another method"
)


def andreff(stations: Stations) -> tuple[Array, Array]:
    """Least squares of (I - R_A (x) R_B) vec(R) = 0 and (I (x) t_B') vec(R) + (I - R_A) t = t_A (their eq. 11).

    vec takes rows. R is the nearest rotation. As in OpenCV 4, t stays the linear system's. With
    D_j = R_G,j' (x) R_C,j the product R_A (x) R_B is D_j D_i', and D_j is orthogonal: the first equation has the
    squares of (D_j - D_i)' vec(R). Raises UnderdeterminedError when the translations do not determine the rotation's
    length.
    """
    form, count = pair_form(stations), len(stations.u)
    D = np.einsum("nba,ncd->acbd", stations.R_G, stations.R_C).reshape(9, 9)  # summed over the stations
    form[:9, :9] += count**2 * np.eye(9) - D @ D.T
    x = solve_scaled(form[:12, :12], -form[:12, 12], LENGTH_UNKNOWN.format("Andreff's"), SINGULAR)
    return so3_nearest(x[:9].reshape(1, 3, 3))[0], x[9:]


def daniilidis(stations: Stations) -> tuple[Array, Array]:
    """The two smallest right singular vectors of T (his eq. 31), combined so that |q| = 1 and q.q' = 0 (eqs. 33-35)."""
    total = np.zeros((12, 12))
    for a, b, dual_a, dual_b, weight in screws(stations):
        z = np.concatenate([a[:3] + b[:3], a[:3] - b[:3], dual_a[:3] + dual_b[:3], dual_a[:3] - dual_b[:3]])
        total += (z * weight).reshape(12, -1) @ z.reshape(12, -1).T
    basis = np.linalg.eigh(squared(total))[1][:, :2]
    X = to_transform(*unit_combination(basis[:4], basis[4:]))
    return X[:3, :3], X[:3, 3]


def screws(stations: Stations) -> Iterator[tuple[Array, Array, Array, Array, Array]]:
    """Dual quaternions of A and B of all pairs, block by block: q_A, q_B, q'_A, q'_B (4, J, I) and weights (J, I)."""
    q_G, q_C = of_rotations(stations.R_G), of_rotations(stations.R_C)
    d_G, d_C = dual_parts(q_G, stations.t_G), dual_parts(q_C, stations.t_C)
    # Q_G,j* (x) Q_G,i and Q_C,j (x) Q_C,i*: the dual part of a product is q p' + q' p, here one product of 8 columns.
    left_G = np.concatenate([left(conjugate(q_G)), left(conjugate(d_G))], axis=2)
    right_G = np.concatenate([d_G, q_G], axis=1).T
    left_C = np.concatenate([left(q_C), left(d_C)], axis=2)
    right_C = np.concatenate([conjugate(d_C), conjugate(q_C)], axis=1).T
    for block in pair_blocks(stations):
        j, i = slice(block.first, block.last), slice(block.last)
        dual_a = products(left_G[j], right_G[:, i]) * block.signs[0]
        dual_b = products(left_C[j], right_C[:, i]) * block.signs[1]
        yield block.a, block.b, dual_a, dual_b, block.weight


#: This many solutions follow the first one, each with alpha from the residuals of the solution before.
ROUNDS = 3


def dqopt(stations: Stations) -> tuple[Array, Array]:
    """DQOpt (Algorithm 1), with alpha the ratio of the rotation's residual to the translation's residual.

    Motions near half a turn are left out, because the signs of their quaternions are uncertain; other motions of the
    same stations remain. Raises UnderdeterminedError when fewer than two motions remain.
    """
    total, used = np.zeros((14, 14)), 0
    for a, b, dual_a, dual_b, weight in screws(stations):
        kept = (weight > 0.0) & (a[3] + b[3] >= UNCERTAIN)
        sides = (a[:3] + b[:3], a - b, dual_a[:3] + dual_b[:3], dual_a - dual_b)  # Motions.rows
        rows = np.concatenate([side[:, kept] for side in sides])
        total, used = total + gram(rows), used + rows.shape[1]
    if used < 2:
        raise UnderdeterminedError(
            f"{used} motions between the poses are far enough from half a turn, and two are needed; add poses that "
            "turn less"
        )
    moments = MotionMoments.of(total, used)
    # The first alpha: a translation as long as the motions' weighs as much as a rotation of about a radian.
    alpha = np.sqrt(used / max(float(np.trace(moments.BB)), np.finfo(float).tiny))
    found = minimum(moments.cost(alpha))
    for _ in range(ROUNDS):
        q, p = found.q, found.q_dual
        rotation = float(q @ moments.AA @ q)
        translation = float(q @ moments.BB @ q + 2.0 * (q @ moments.BA @ p) + p @ moments.AA @ p)
        floor = 1e-14 * used
        if rotation <= floor or translation * alpha**2 <= floor:
            break  # exact poses: nothing to weigh
        alpha = np.sqrt(rotation / translation)
        found = minimum(moments.cost(alpha))
    X = to_transform(found.q, found.q_dual)
    return X[:3, :3], X[:3, 3]


RobotWorld = tuple[Array, Array, Array, Array]


class PoseMeans(NamedTuple):
    """Means over the poses of products of (R_A, t_A, 1) and (R_B, t_A, t_B, 1).

    Entry [a, b, c, d] of R_A_R_B is the mean of R_A[a, b] R_B[c, d], entry [a, b, c] of R_A_t_A that of
    R_A[a, b] t_A[c].
    """

    R_A_R_B: Array
    R_A_t_A: Array
    R_A_t_B: Array
    t_A_t_B: Array
    t_B_t_B: Array
    R_A: Array
    t_A: Array
    t_B: Array


def pose_means(R_A: Array, t_A: Array, R_B: Array, t_B: Array) -> PoseMeans:
    """Compute the means by one matrix product."""
    count = len(R_A)
    F = np.empty((count, 25))
    F[:, :9], F[:, 9:12], F[:, 12:15] = R_A.reshape(count, 9), t_A, t_B
    F[:, 15], F[:, 16:] = 1.0, R_B.reshape(count, 9)
    G = (F[:, :16].T @ F) / count
    of_R_A = G[:9].reshape(3, 3, 25)
    return PoseMeans(
        R_A_R_B=of_R_A[:, :, 16:].reshape(3, 3, 3, 3),
        R_A_t_A=of_R_A[:, :, 9:12],
        R_A_t_B=of_R_A[:, :, 12:15],
        t_A_t_B=G[9:12, 12:15],
        t_B_t_B=G[12:15, 12:15],
        R_A=of_R_A[:, :, 15],
        t_A=G[9:12, 15],
        t_B=G[12:15, 15],
    )


def shah(R_A: Array, t_A: Array, R_B: Array, t_B: Array) -> RobotWorld:
    """R_X, t_X, R_Z, t_Z of A X = Z B by Shah 2013.

    Rotations are the largest singular pair of the sum of R_B (x) R_A; translations are found by least squares.
    """
    m = pose_means(R_A, t_A, R_B, t_B)
    U, _, Vt = np.linalg.svd(m.R_A_R_B.transpose(2, 0, 3, 1).reshape(9, 9))  # R_A R_X R_B' = R_Z, vec by columns
    R_X, R_Z = _rotations_of_vec(np.array([Vt[0], U[:, 0]]))
    # Least squares of t_Z - R_A t_X = t_A - R_Z t_B =: d, t_Z = mean d + mean R_A t_X eliminated.
    mean = m.t_A - R_Z @ m.t_B
    turned = np.einsum("aba->b", m.R_A_t_A) - np.einsum("ac,abc->b", R_Z, m.R_A_t_B)  # mean of R_A' d
    t_X = np.linalg.solve(np.eye(3) - m.R_A.T @ m.R_A, m.R_A.T @ mean - turned)
    return R_X, t_X, R_Z, mean + m.R_A @ t_X


def li(R_A: Array, t_A: Array, R_B: Array, t_B: Array) -> RobotWorld:
    """R_X, t_X, R_Z, t_Z of A X = Z B by Li, Wang & Wu 2010 (Kronecker form): one linear least squares for all.

    (R_A (x) I) vec(R_X) - (I (x) R_B') vec(R_Z) = 0 and (I (x) t_B') vec(R_Z) - R_A t_X + t_Z = t_A, vec by rows.
    The nearest rotations follow. The translations stay as in the linear system, as observed of OpenCV 4. Raises
    UnderdeterminedError when the translations do not determine the rotations' length.
    """
    m = pose_means(R_A, t_A, R_B, t_B)
    # vec(R_X) is eliminated: its block is the identity, since R_A is orthogonal, and R_X = mean of R_A' R_Z R_B.
    K = m.R_A_R_B.transpose(1, 3, 0, 2).reshape(9, 9)
    normal = np.zeros((15, 15))  # vec(R_Z), t_X, t_Z
    normal[:9, :9] = np.eye(9) - K.T @ K
    of_R_Z = normal[:9].reshape(3, 3, 15)
    for row in range(3):
        of_R_Z[row, :, 3 * row : 3 * row + 3] += m.t_B_t_B
        of_R_Z[row, :, 12 + row] = m.t_B
    of_R_Z[:, :, 9:12] = -m.R_A_t_B.transpose(0, 2, 1)
    normal[9:12, 12:] = -m.R_A.T
    normal[range(9, 15), range(9, 15)] = 1.0
    right = np.concatenate([m.t_A_t_B.ravel(), -np.einsum("aba->b", m.R_A_t_A), m.t_A])
    normal = np.triu(normal) + np.triu(normal, 1).T
    z = solve_scaled(normal, right, LENGTH_UNKNOWN.format("Li's"), SINGULAR)
    R_X, R_Z = so3_nearest(np.stack([K @ z[:9], z[:9]]).reshape(2, 3, 3))
    return R_X, z[9:12], R_Z, z[12:]


def _rotations_of_vec(vectors: Array) -> Array:
    """The rotations (2, 3, 3) of singular vectors (2, 9), which are multiples, of either sign, of rotations."""
    U, s, Wt = np.linalg.svd(vectors.reshape(2, 3, 3).transpose(0, 2, 1))
    if s.min() < 1e-6:
        raise UnderdeterminedError(
            "the largest singular pair of the sum of R_B (x) R_A is not a pair of rotations; add poses that turn about "
            "two different axes"
        )
    R = U @ Wt
    rotations: Array = R * np.sign(np.linalg.det(R))[:, None, None]
    return rotations
