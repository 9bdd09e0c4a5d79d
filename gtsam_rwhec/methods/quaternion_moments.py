"""Lasserre's relaxation of order two for a cost quadratic in rotations, over their unit quaternions.

vec R is linear in the ten products q_a q_b (``PRODUCTS``), so x'Q'x is a polynomial of degree four in the quaternions
of one or two rotations, even in each of them. With y = [1, products of q_1, products of q_2] it is y'Cy, and the
relaxation is over moments: the integrals of the monomials by a measure on pairs of unit quaternions.

    minimise <C, M(y y')>   subject to   M(y y') >= 0,   M(z z') >= 0 for z = q_1 (x) q_2,
                                         moments of m |q_k|^2 = those of m,   moment of 1 = 1

The flips q_k -> -q_k change nothing, so moments of odd degree vanish. The moment matrix of order two then falls into
these two blocks and the blocks q_k q_k', which are positive semidefinite by the first block and |q_k| = 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import clarabel
import numpy as np
import scipy.sparse
from scipy.linalg import block_diag

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import ROTATION, to_rotations
from gtsam_rwhec.solver.relaxation import solve_conic, triangle, unstacked
from gtsam_rwhec.solver.rotations import project, unvec

#: Order of a quaternion's entries, scalar first. The solver's last digits, and so its bound, depend on the order.
_ENTRIES = (3, 0, 1, 2)
#: (a, b) of the ten products q_a q_b.
PRODUCTS = [(_ENTRIES[i], _ENTRIES[j]) for i in range(4) for j in range(i, 4)]
#: The interior-point solver stops at this relative gap and infeasibility.
TOLERANCE = 1e-11
#: The interior-point solver takes at most this many steps, and so does the descent after it.
STEPS = 200


def products_to_rotation() -> Array:
    """(9, 10): vec R = L [q_a q_b]."""
    return np.array([(1.0 + (a != b)) * ROTATION[a, b].T.ravel() for a, b in PRODUCTS]).T


@dataclass(frozen=True)
class MomentSolution:
    """Starts (list of (n, 3, 3) rotations), a lower bound on the cost, and whether a single point has these moments.

    ``eigenvalue_ratio`` is the second eigenvalue of M(y y') over the first: zero if only one answer is optimal and
    the relaxation is tight.
    """

    starts: list[Array]
    lower_bound: float
    eigenvalue_ratio: float


@dataclass(frozen=True)
class _MomentPlaces:
    """The index of the moment in each entry of M(y y') and M(z z'), and the equations of the moments."""

    even: np.ndarray
    odd: np.ndarray
    equations: scipy.sparse.csc_matrix


@cache
def _moment_places(frames: int) -> _MomentPlaces:
    """The places for one or two quaternions."""
    place: dict[tuple[int, ...], int] = {}

    def index(exponents: np.ndarray) -> int:
        return place.setdefault(tuple(int(e) for e in exponents), len(place))

    unit = np.eye(4 * frames, dtype=int)
    y = [np.zeros(4 * frames, dtype=int)]
    y += [unit[4 * k + a] + unit[4 * k + b] for k in range(frames) for a, b in PRODUCTS]
    even = np.array([[index(p + q) for q in y] for p in y])
    z = [unit[a] + unit[4 + b] for a in _ENTRIES for b in _ENTRIES] if frames == 2 else []
    odd = np.array([[index(p + q) for q in z] for p in z], dtype=int).reshape(len(z), len(z))
    rows = [np.eye(len(place))[even[0, 0]]]
    for k in range(frames):
        for m in y:
            row = np.zeros(len(place))
            for a in range(4):
                row[index(m + 2 * unit[4 * k + a])] += 1.0
            row[index(m)] -= 1.0
            rows.append(row)
    return _MomentPlaces(even, odd, scipy.sparse.csc_matrix(np.array(rows)))


def solve_moments(Q: Array) -> MomentSolution:
    """Solve the relaxation of x'Q'x, x = [vec R_1, (vec R_2,) 1], Q' (10, 10) or (19, 19)."""
    frames = (len(Q) - 1) // 9
    moments = _moment_places(frames)
    to_x = np.roll(block_diag(*[products_to_rotation()] * frames, np.eye(1)), 1, axis=1)  # y has its 1 first
    C = to_x.T @ Q @ to_x
    scale = float(np.abs(C).max()) or 1.0
    equations, count = moments.equations, moments.equations.shape[1]
    cost = np.zeros(count)
    np.add.at(cost, moments.even, C / scale)
    blocks = [block for block in (moments.even, moments.odd) if block.size]
    cones = [clarabel.ZeroConeT(equations.shape[0]), *[clarabel.PSDTriangleConeT(len(block)) for block in blocks]]
    A = scipy.sparse.vstack([equations, *[-_triangle(block, count) for block in blocks]], format="csc")
    b = np.zeros(A.shape[0])
    b[0] = 1.0
    mu, z, _ = solve_conic(cost, A, b, cones, TOLERANCE, STEPS)
    values = np.linalg.eigvalsh(mu[moments.even])
    return MomentSolution(
        _rounded(mu[moments.even], frames),
        scale * _lower_bound(cost, A, z, equations.shape[0], blocks),
        float(max(values[-2], 0.0) / values[-1]),
    )


def _triangle(block: np.ndarray, count: int) -> scipy.sparse.csc_matrix:
    """The linear map from the moments to the stacked entries of a block."""
    i, j, weight = triangle(len(block))
    return scipy.sparse.csc_matrix((weight, (np.arange(len(i)), block[i, j])), (len(i), count))


def _lower_bound(cost: Array, A: scipy.sparse.csc_matrix, z: Array, equations: int, blocks: list[np.ndarray]) -> float:
    """A lower bound that holds (up to rounding) for any multipliers z: -z_0, less what the solver's tolerance leaves.

    For the moments mu of any unit quaternions, cost' mu is -z_0 + sum <Z, M> + r' mu with r = cost + A' z. No moment
    exceeds 1. The trace of M(y y') is at most 1 + n, the trace of M(z z') is 1. The smallest change of z that makes r
    vanish comes first.
    """
    z = z - np.linalg.lstsq(A.T.toarray(), cost + A.T @ z, rcond=None)[0]
    bound = -float(z[0]) - float(np.abs(cost + A.T @ z).sum())
    start = equations
    for block, trace in zip(blocks, (1.0 + (len(blocks[0]) - 1) // 10, 1.0), strict=False):
        bound += trace * min(0.0, float(np.linalg.eigvalsh(unstacked(z[start:], len(block)))[0]))
        start += len(block) * (len(block) + 1) // 2
    return bound


def _rounded(M: Array, frames: int) -> list[Array]:
    """Rotations from the second moments of each quaternion, and from the rotation matrices that these moments mean."""
    by_quaternion = np.empty((frames, 3, 3))
    for k in range(frames):
        second = np.zeros((4, 4))
        for (a, b), moment in zip(PRODUCTS, M[0, 1 + 10 * k : 11 + 10 * k], strict=True):
            second[a, b] = second[b, a] = moment
        by_quaternion[k] = to_rotations(np.linalg.eigh(second)[1][:, -1])
    products = M[0, 1:].reshape(frames, 10)
    by_matrix = project(unvec(products @ products_to_rotation().T))
    return [by_quaternion, by_matrix]
