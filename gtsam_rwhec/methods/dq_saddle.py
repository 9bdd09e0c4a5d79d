"""The minimum of the DQ paper's cost as the saddle of its two multipliers (Sections 3.1.2 and 3.2.1), and lower bounds.

lambda_0(mu), the smallest eigenvalue of Z(mu) (eq. 12), is concave. It is the Lagrangian's minimum, so for *every* mu
no pose costs less. At its maximum q . q' = 0, and a pose has this cost. Newton's method starts at mu = 0, and its first
step is eq. 34.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods.dual_quaternion_cost import DualQuaternionCost, times_vectors

#: Eigenvalues of M below this part of its largest are rounding error: M is singular.
SINGULAR = 1e-14
#: The search ends when a step gains less than this part of lambda_0. This is far below the rounding error of lambda_0.
GAIN = 1e-17
#: The search takes at most this many steps.
STEPS = 200


@dataclass(frozen=True)
class Minimum:
    """The saddle of the Lagrangian's two multipliers, and the pose q, q_dual (4,) there, xyzw: |q| = 1, q . q_dual = 0.

    mu is the multiplier of q . q' = 0. ``values`` (4,) are the eigenvalues of Z(mu), ascending, ``vectors`` (4, 4) its
    eigenvectors. values[0] is the cost, up to rounding.
    """

    q: Array
    q_dual: Array
    mu: float
    values: Array
    vectors: Array


def is_singular(cost: DualQuaternionCost) -> bool:
    """Whether an eigenvalue of M is only rounding (no noise, no rotation, or parallel axes)."""
    values, _ = cost.spectrum
    return not float(values[0]) > SINGULAR * float(values[3])


def minimum(cost: DualQuaternionCost) -> Minimum:
    """Minimise the cost over all unit dual quaternions.

    With a singular M, a step along M's null space meets the constraint at no cost. The minimum is then the
    relaxation's, at mu = 0 (``Z_pseudo``).
    """
    if is_singular(cost):
        values, vectors = np.linalg.eigh(Z_pseudo(cost))
        q, mu = vectors[:, 0], 0.0
    else:
        mu, values, vectors, q = search(cost.Z0, cost.Z1, cost.Z2)
    return Minimum(q, best_dual(cost, q), mu, values, vectors)


def Z_pseudo(cost: DualQuaternionCost) -> Array:
    """S - W M^+ W' (4, 4): Z0 (eq. 13) without M's null space.

    A vector n with A n = 0 has W n = 0 too. So q' + c n costs as much as q', and some c meets q . q' = 0 unless
    q . n = 0.
    """
    values, vectors = cost.spectrum
    used = values > SINGULAR * max(float(values[3]), 0.0)
    half = cost.W @ (vectors[:, used] / np.sqrt(values[used]))
    return cost.S - half @ half.T


def search(Z0: Array, Z1: Array, Z2: Array) -> tuple[float, Array, Array, Array]:
    """Maximise lambda_0(mu) over mu: mu*, eigenvalues (4,) and eigenvectors (4, 4) of Z(mu*), and q (4,).

    q is the eigenvector of the smallest eigenvalue. Where the two smallest are equal, it is the vector of their plane
    with q . q' = 0.
    """
    mu, low, high = 0.0, -math.inf, math.inf
    for step in range(STEPS):
        values, vectors = np.linalg.eigh(Z0 + mu * (Z1 - mu * Z2))
        q = vectors[:, 0]
        derivative = Z1 - 2.0 * mu * Z2
        g0, g1, g2, g3 = (q @ derivative @ vectors).tolist()  # g0 = d lambda_0 / d mu = -2 f_0 (eq. 18)
        l0, l1, l2, l3 = values.tolist()
        rounding = 4e-16 * max(abs(l0), abs(l3))
        if l1 - l0 <= rounding:  # two curves meet
            break
        second = float(q @ Z2 @ q) + g1 * g1 / (l1 - l0) + g2 * g2 / (l2 - l0) + g3 * g3 / (l3 - l0)
        change = 0.5 * g0 / second
        if abs(g0 * change) <= GAIN * abs(l0) + 1e-32 * l3:  # the gain of a Newton step
            return mu, values, vectors, q
        low, high = (mu, high) if g0 > 0.0 else (low, mu)
        target = mu + change
        if not low < target < high or step % 4 == 3:
            if low == -math.inf or high == math.inf:
                least, most = bracket(Z1, Z2)
                low, high = max(low, least), min(high, most)
            if not low < target < high or step > 8:
                target = 0.5 * (low + high)
        if target in (low, high, mu):
            break
        mu = target
    # lambda_0 has a kink at its maximum: two eigenvalues meet (rotations or translations without noise). Their plane
    # has a vector with q . q' = 0, since f_0 changes its sign at the kink.
    plane = vectors[:, :2]
    F = plane.T @ (mu * Z2 - 0.5 * Z1) @ plane
    (f0, f1), turn = np.linalg.eigh(F)
    if f0 < 0.0 < f1:
        q = plane @ (turn @ np.sqrt(np.array([f1, -f0]) / (f1 - f0)))
    return mu, values, vectors, q


def bracket(Z1: Array, Z2: Array) -> tuple[float, float]:
    """Bounds of mu* (Appendix C): eq. 14 is the Rayleigh quotient of K = L^-T Z1 L^-1 / 2 with Z2 = L'L."""
    lower = np.linalg.cholesky(Z2)  # Z2 = lower lower', so L = lower'
    inverse = np.linalg.inv(lower)
    least, *_, most = np.linalg.eigvalsh(0.5 * inverse @ Z1 @ inverse.T)
    margin = 1e-9 * (abs(least) + abs(most))
    return float(least - margin), float(most + margin)


def best_dual(cost: DualQuaternionCost, q: Array) -> Array:
    """The best q' for a given q, orthogonal to it: eq. 20, without M^-1."""
    return times_vectors(q) @ (0.5 * best_translation(cost, q))


def best_translation(cost: DualQuaternionCost, q: Array) -> Array:
    """The best t (3,) for a given q.

    q' = (t / 2, 0) (x) q, and the cost is quadratic in t. Its three equations can be regular where M is singular. Along
    directions on which the cost does not depend, t is zero.
    """
    V = times_vectors(q)  # q' = V t / 2
    G, g = V.T @ cost.M @ V, V.T @ (cost.W.T @ q)
    values, vectors = np.linalg.eigh(G)
    if not values[0] > SINGULAR * values[2]:
        values = np.where(values > max(SINGULAR * values[2], 1e-300), values, np.inf)
    t: Array = 2.0 * (vectors @ ((vectors.T @ g) / -values))
    return t


#: Rounding error that a Cholesky factorisation of a 9 x 9 matrix of unit diagonal can hide in double precision (Higham
#: 2002, Theorem 10.7: 9 gamma_10 = 1e-14), together with the rounding errors of the matrix's own entries.
HIDDEN = 1.2e-14


def proven(K: Array) -> bool:
    """Whether K (n, n), n <= 9, is proven to be positive semidefinite. K's diagonal is changed.

    If the Cholesky factorisation succeeds, a matrix near K is positive semidefinite. Its entries (i, j) differ from K's
    by up to ``HIDDEN`` sqrt(K_ii K_jj). So the diagonal is first multiplied by 1 - ``HIDDEN``.
    """
    np.fill_diagonal(K, K.diagonal() * (1.0 - HIDDEN))
    try:
        np.linalg.cholesky(K)
    except np.linalg.LinAlgError:
        return False
    return True


def proven_bound(form: Callable[[float], Array], value: float, step: float) -> float:
    """The first proven bound among value - step, value - 4 step, value - 16 step, ...; 0 if no positive one is proven.

    ``form`` gives, for a candidate bound, a new matrix (n, n), n <= 9. The bound holds when the matrix is positive
    semidefinite. ``value`` is the optimum, up to rounding, of a sum of squares, so 0 is always a bound.
    """
    lower = value - step
    while lower > 0.0:
        if proven(form(lower)):
            return lower
        step *= 4.0
        lower = value - step
    return 0.0
