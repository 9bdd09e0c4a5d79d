"""The DQ paper's approximations (Section 3.2, Appendix A), and its optimum from an algebraic curve (Appendix B).

Each method finds q. Then q' is the best for that q (eq. 20, ``best_dual``).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.polynomial.polynomial import polydiv
from scipy.optimize import brentq

from gtsam_rwhec.errors import NotConvergedWarning, OptionError, UnderdeterminedError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods.dq_saddle import SINGULAR, Z_pseudo, best_dual, bracket, is_singular
from gtsam_rwhec.methods.dual_quaternion_cost import DualQuaternionCost, to_transform
from gtsam_rwhec.methods.hand_eye_request import Request, free_directions, free_of_rotations_alone
from gtsam_rwhec.methods.method import Outcome

#: DQItr has converged when mu changes by less than this share of Appendix C's range of mu.
STILL = 1e-13
#: DQItr stops after this many iterations.
ITERATIONS = 200
#: Lambda_0 has a rounding error of this part of tr S.
ROUNDING = 1e-13


def dq2steps(request: Request) -> Outcome[Array]:
    """DQ2Steps (Section 3.2.2, Algorithm 2): the rotation that fits the rotations best, then the translation.

    Raises UnderdeterminedError when the axes are parallel or nothing rotates: the rotations alone then do not suffice.
    """
    values, vectors = request.cost.spectrum
    if not values[1] > SINGULAR * values[3]:
        turned = "no motion rotates" if not values[3] > 0.0 else "all motions rotate about parallel axes"
        raise UnderdeterminedError(
            f"{turned}, and 'dq2steps' takes the rotation from the rotations alone; use method='dqopt', which uses "
            "the translations too, or add motions about another axis"
        )
    found = outcome_of(request, vectors[:, 0])  # eq. 19
    return replace(found, free_directions=free_of_rotations_alone(request) or found.free_directions)


def dqconvrlx(request: Request) -> Outcome[Array]:
    """DQConvRlx (Section 3.2.3, Algorithm 3): solved without the constraint q . q' = 0, then projected onto it.

    ``lower_bound`` is lambda_0 (below eq. 22): the gap is at most ``relaxation_gap``.
    """
    relaxed = relaxed_cost(request.cost)
    bound = float(relaxed.values[0]) - ROUNDING * float(np.trace(request.cost.S))
    return replace(outcome_of(request, relaxed.vectors[:, 0]), lower_bound=max(bound, 0.0))


def dq2ndord(request: Request) -> Outcome[Array]:
    """DQ2ndOrd (Section 3.2.4, Algorithm 4): the second order in mu about the relaxation (eqs. 23 and 34)."""
    return dq_nth_order(request, 2)


def dq_nth_order(request: Request, order: int) -> Outcome[Array]:
    """The expansion in mu to any order (Appendix A): q(mu) of eq. 32 at the root of d lambda / d mu nearest mu = 0.

    Lambda and q have the order ``order``, >= 1; order 2 is ``dq2ndord``. The series converges for |mu| up to where Z's
    two smallest eigenvalues meet in the complex plane. Higher orders help only within that range.
    """
    if order < 1:
        raise OptionError(f"order={order}: the expansion in mu starts at order 1")
    relaxed = relaxed_cost(request.cost)
    if is_singular(request.cost):
        return outcome_of(request, relaxed.vectors[:, 0])  # mu = 0 is exact (``Z_pseudo``)
    lambdas, coefficients = expansion(relaxed, max(order, 2))
    mu = _stationary(lambdas)
    in_eigenvectors = sum(c * mu**k for k, c in enumerate(coefficients[: order + 1]))
    return outcome_of(request, relaxed.vectors @ in_eigenvectors)


def dq2ndord_lambda(request: Request) -> Outcome[Array]:
    """The second order in Delta lambda = lambda - lambda_0 (Section 3.2.4, Appendix A, eqs. 35 and 36, corrected)."""
    relaxed = relaxed_cost(request.cost)
    q = None if is_singular(request.cost) else lambda_expansion(relaxed)
    return outcome_of(request, relaxed.vectors[:, 0] if q is None else relaxed.vectors @ q)


def dqitr(request: Request) -> Outcome[Array]:
    """DQItr: mu <- q(mu)'Z1 q(mu) / (2 q(mu)'Z2 q(mu)) (eq. 24) until mu converges.

    With M singular (no noise) the paper finds the iteration unstable. There mu = 0 is exact, and nothing is iterated.
    Warns by NotConvergedWarning when mu still changes after 200 iterations: the iteration may move away from the fixed
    point. ``dqopt`` always converges.
    """
    cost = request.cost
    if is_singular(cost):
        return outcome_of(request, relaxed_cost(cost).vectors[:, 0])
    Z1, Z2 = cost.Z1, cost.Z2
    low, high = bracket(Z1, Z2)
    mu = 0.0
    for _ in range(ITERATIONS):
        q = np.linalg.eigh(cost.Z(mu))[1][:, 0]
        before, mu = mu, float(0.5 * (q @ Z1 @ q) / (q @ Z2 @ q))
        if abs(mu - before) <= STILL * (high - low):
            break
    else:
        warnings.warn(
            f"'dqitr' has not converged after {ITERATIONS} iterations (mu changed from {before:.6g} to {mu:.6g}); "
            "its answer may be wrong: use method='dqopt'",
            NotConvergedWarning,
            stacklevel=4,
        )
    return outcome_of(request, q)


@dataclass(frozen=True)
class RelaxedCost:
    """Eq. 21 without the constraint: lambda_a (4,) and q_a (4, 4) of Z0, and Z1 and Z2 in these eigenvectors.

    Entry [a, b] of Z1 or Z2 is q_a'Z q_b, the paper's Z^ab.
    """

    values: Array
    vectors: Array
    Z1: Array
    Z2: Array


def relaxed_cost(cost: DualQuaternionCost) -> RelaxedCost:
    """Solve Z0 q = lambda q (eq. 21); with a singular M, by its pseudo-inverse and with Z1 = Z2 = 0."""
    if is_singular(cost):
        return RelaxedCost(*np.linalg.eigh(Z_pseudo(cost)), np.zeros((4, 4)), np.zeros((4, 4)))
    values, vectors = np.linalg.eigh(cost.Z0)
    return RelaxedCost(values, vectors, vectors.T @ cost.Z1 @ vectors, vectors.T @ cost.Z2 @ vectors)


def relaxation_gap(relaxed: RelaxedCost) -> float:
    """lambda^c - lambda_0 (eq. 22): lambda_0 <= lambda* <= lambda^c, the cost of DQConvRlx."""
    if not relaxed.Z2[0, 0] > 0.0:
        return 0.0
    return float(0.25 * relaxed.Z1[0, 0] ** 2 / relaxed.Z2[0, 0])


def expansion(relaxed: RelaxedCost, order: int) -> tuple[list[float], list[Array]]:
    """lambda_k and c_k (4,) of lambda(mu) = sum lambda_k mu^k, q(mu) = sum mu^k sum_a c_ka q_a (eqs. 31 to 33).

    Eq. 33 as printed does not solve eq. 12: the middle line's second term must be Z2 q_{k-2}, as in the third line, in
    place of Z2 q_{k-1} (checked against Z(mu)'s own eigenvalues: tests/methods/test_dq_approximations.py).
    """
    gaps = relaxed.values[0] - relaxed.values[1:]  # lambda_0a
    lambdas = [float(relaxed.values[0])]
    c = [np.array([1.0, 0.0, 0.0, 0.0])]
    for k in range(1, order + 1):
        driven = relaxed.Z1 @ c[k - 1]
        if k > 1:
            driven = driven - relaxed.Z2 @ c[k - 2]
        lambdas.append(float(driven[0]) - sum(lambdas[k - n] * float(c[n][0]) for n in range(1, k)))
        rest = driven[1:] - sum((lambdas[k - n] * c[n][1:] for n in range(1, k)), np.zeros(3))
        along = -0.5 * sum(float(c[k - n] @ c[n]) for n in range(1, k))
        c.append(np.concatenate([[along], rest / gaps]))
    return lambdas, c


def _stationary(lambdas: list[float]) -> float:
    """The mu where the truncated series has d lambda / d mu = 0, nearest to eq. 34's, which is second order."""
    second = -0.5 * lambdas[1] / lambdas[2]  # eq. 34; lambda_2 < 0, since lambda_0(mu) is concave
    if len(lambdas) == 3:
        return second
    roots = np.roots([k * lambdas[k] for k in range(len(lambdas) - 1, 0, -1)])
    real = roots.real[np.abs(roots.imag) < 1e-6 * np.abs(roots)]
    return float(real[np.abs(real - second).argmin()]) if real.size else second


def lambda_expansion(relaxed: RelaxedCost) -> Array | None:
    """Coefficients (4,) of q in Z0's eigenvectors, to second order in D = Delta lambda; None if mu = 0 solves eq. 14.

    They are not normalised. mu = mu_1 D + mu_2 D^2 and q = q_0 + q_1 D + q_2 D^2 solve (Z0 + mu Z1 - mu^2 Z2) q =
    (lambda_0 + D) q order by order. As printed, eq. 35 has the wrong sign of mu_1^2 Z2, in mu_2 and in q_2 (Z2 enters
    eq. 12 with a minus). Eq. 36 has the wrong sign of the Z2 terms of q.(mu Z2 - Z1/2).q = 0. Delta lambda's formula
    divides by 2 in place of 2 c_2. With the signs below the residual of eq. 12 is of third order; as printed, of second
    (tests/methods/test_dq_approximations.py).
    """
    Z1, Z2 = relaxed.Z1, relaxed.Z2
    gaps = relaxed.values[0] - relaxed.values[1:]
    if abs(Z1[0, 0]) * abs(Z1[0, 0]) <= 1e-30 * abs(Z2[0, 0]) * abs(relaxed.values[3]):
        return None  # lambda does not change with mu: it has no expansion in lambda, and eq. 14 gives mu = 0
    mu1 = 1.0 / Z1[0, 0]
    q1 = np.concatenate([[0.0], mu1 * Z1[1:, 0] / gaps])
    mu2 = -(mu1 * Z1[0] @ q1 - mu1**2 * Z2[0, 0]) / Z1[0, 0]
    driven = Z1[1:] @ (mu1 * q1) + mu2 * Z1[1:, 0] - mu1**2 * Z2[1:, 0] - q1[1:]
    q2 = np.concatenate([[-0.5 * float(q1 @ q1)], driven / gaps])
    # q'(Z1 / 2 - mu Z2) q = 0 (eq. 14) to second order: c0 + c1 D + c2 D^2.
    c0 = 0.5 * Z1[0, 0]
    c1 = Z1[0] @ q1 - mu1 * Z2[0, 0]
    c2 = Z1[0] @ q2 + 0.5 * q1 @ Z1 @ q1 - Z2[0] @ (2.0 * mu1 * q1) - mu2 * Z2[0, 0]
    discriminant = c1 * c1 - 4.0 * c0 * c2
    # The root that goes to -c0 / c1 as c2 goes to 0, without cancellation.
    change = -2.0 * c0 / (c1 + math.copysign(math.sqrt(discriminant), c1)) if discriminant >= 0.0 else -c0 / c1
    q: Array = np.array([1.0, 0.0, 0.0, 0.0]) + change * (q1 + change * q2)
    return q


def outcome_of(request: Request, q: Array) -> Outcome[Array]:
    """The pose of q (4,), of any length, with the best q' (eq. 20).

    Algorithm 4 as printed normalises by q^2; a unit quaternion needs |q|.
    """
    q = q / math.sqrt(float(q @ q))
    relaxed = relaxed_cost(request.cost)
    free = free_directions(request, q, relaxed.values, relaxed.vectors)
    return Outcome(to_transform(q, best_dual(request.cost, q)), free_directions=free)


#: The searches end at this many times the gap of eq. 22, which is an upper bound up to rounding.
BEYOND = 1.25
#: A remainder below this share of its dividend is rounding error: two roots are equal.
MET = 1e-15
#: The resultant's search starts at this share of eq. 22's gap. At 0 one root is mu = 0, and the roots' mean fails.
NOT_ZERO = 1e-3
#: Sturm's interval is halved this many times, to below the rounding of a double.
BISECTIONS = 60


@dataclass(frozen=True)
class Curve:
    """p(lambda, mu) in x = mu / ``mu_scale`` and y = (lambda - lambda_0) / gap.

    Entry [m, n] of the coefficients (5, 9) belongs to y^m x^n; 25 are not zero: n <= 8 - 2 m. ``mu_scale`` is mu
    of eq. 14 for the relaxation's q, and the gap is that of eq. 22.
    """

    coefficients: Array
    mu_scale: float

    def in_x(self, y: float) -> Array:
        """Coefficients (9,) of the polynomial in x at one y, x^0 first, scaled so that the largest is one."""
        p: Array = y ** np.arange(5) @ self.coefficients
        scaled: Array = p / np.abs(p).max()
        return scaled


def curve(relaxed: RelaxedCost) -> Curve | None:
    """The curve's coefficients (eq. 15); None where the gap of eq. 22 is rounding error, and mu = 0 is the answer."""
    gap = relaxation_gap(relaxed)
    if not gap > 1e-15 * max(abs(float(relaxed.values[0])), 1e-15 * abs(float(relaxed.values[3]))):
        return None
    mu = 0.5 * float(relaxed.Z1[0, 0] / relaxed.Z2[0, 0])  # eq. 14
    # Each entry of Z - lambda is a polynomial in (y, x). Rows are scaled to size one, which only scales p. A polynomial
    # is stored by powers of y in steps of nine: no power of x is above 8, so products are convolutions.
    entries = np.zeros((4, 4, 2, 9))
    entries[:, :, 0, 0] = np.diag(relaxed.values - relaxed.values[0])
    entries[:, :, 0, 1] = mu * relaxed.Z1
    entries[:, :, 0, 2] = -(mu**2) * relaxed.Z2
    entries[range(4), range(4), 1, 0] = -gap
    entries /= np.abs(entries).max(axis=(1, 2, 3))[:, None, None, None]
    return Curve(_determinant(entries.reshape(4, 4, 18)), mu)


def _determinant(entries: Array) -> Array:
    """The determinant (5, 9) of a 4 x 4 matrix of polynomials, by the minors of its upper and lower two rows."""
    total = np.zeros(69)
    for i, j in combinations(range(4), 2):
        k, m = (c for c in range(4) if c not in (i, j))
        upper = np.convolve(entries[0, i], entries[1, j]) - np.convolve(entries[0, j], entries[1, i])
        lower = np.convolve(entries[2, k], entries[3, m]) - np.convolve(entries[2, m], entries[3, k])
        total += (-1.0) ** (i + j + 1) * np.convolve(upper, lower)
    return total[:45].reshape(5, 9)


def resultant(p: Array) -> float:
    """The resultant of p (9,) and its derivative, up to a positive factor: the determinant of their Sylvester matrix.

    x is scaled so that the geometric mean of the roots is one. Without this, roots of very different size leave the
    determinant (15, 15) with no correct digit, and often with the wrong sign.
    """
    p = p * (abs(p[0] / p[8]) ** 0.125) ** np.arange(9)
    p = p / np.abs(p).max()
    derivative = p[1:] * np.arange(1, 9)
    derivative /= np.abs(derivative).max()
    matrix = np.zeros((15, 15))
    for row in range(7):
        matrix[row, row : row + 9] = p
    for row in range(8):
        matrix[7 + row, row : row + 8] = derivative
    sign, logarithm = np.linalg.slogdet(matrix)
    return float(sign * np.exp(0.1 * logarithm))  # monotonic: only the root is of interest


def real_roots(p: Array) -> int:
    """The number of real roots of p (9,), by Sturm's theorem: sign changes at -infinity less those at infinity.

    The paper's "P_1 = P_0" is a misprint: P_1 is the derivative of P_0.
    """
    sequence = [p, p[1:] * np.arange(1, 9)]
    while len(sequence[-1]) > 1:
        above, divisor = sequence[-2:]
        remainder = -polydiv(above, divisor)[1]
        size = float(np.abs(remainder).max())
        if size <= MET * float(np.abs(above).max()):
            break
        sequence.append(remainder / size)
    leading = np.array([s[-1] for s in sequence])
    at_minus_infinity = leading * (-1.0) ** np.array([len(s) - 1 for s in sequence])
    changes = [int(np.count_nonzero(np.diff(np.sign(signs)))) for signs in (at_minus_infinity, leading)]
    return changes[0] - changes[1]


def by_resultant(of: Curve) -> float:
    """The smallest y at which the resultant changes its sign."""

    def f(y: float) -> float:
        return resultant(of.in_x(y))

    if f(NOT_ZERO) * f(BEYOND) < 0.0:
        return float(brentq(f, NOT_ZERO, BEYOND, xtol=1e-15, rtol=1e-14))
    warnings.warn(
        "'dqoptpoly_resultant' finds no change of the resultant's sign: two roots are too close for double precision; "
        "its answer is the relaxation's: use method='dqopt'",
        NotConvergedWarning,
        stacklevel=6,
    )
    return 1.0  # eq. 22's bound


def by_sturm(of: Curve) -> float:
    """The y at which two of the eight real roots meet and vanish."""
    low, high = 0.0, BEYOND
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if real_roots(of.in_x(middle)) >= 8:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def double_root(of: Curve, y: float) -> float:
    """The mu at which two roots meet: the root of dp/dmu at which p is nearest zero.

    p itself has a double root there and would lose half the digits; the root of its derivative is simple.
    """
    p = of.in_x(y)
    x = np.roots((p[1:] * np.arange(1, 9))[::-1]).real
    powers = x[:, None] ** np.arange(9)
    return float(x[(np.abs(powers @ p) / (np.abs(powers) @ np.abs(p))).argmin()]) * of.mu_scale


def dqoptpoly_resultant(request: Request) -> Outcome[Array]:
    """DQOptPoly by the resultant; UnderdeterminedError with a singular M: the curve's coefficients are not finite."""
    return _solve(request, by_resultant, "dqoptpoly_resultant")


def dqoptpoly_sturm(request: Request) -> Outcome[Array]:
    """DQOptPoly by counting real roots; UnderdeterminedError with a singular M, as for the resultant."""
    return _solve(request, by_sturm, "dqoptpoly_sturm")


def _solve(request: Request, search: Callable[[Curve], float], name: str) -> Outcome[Array]:
    if is_singular(request.cost):
        raise UnderdeterminedError(
            f"M = alpha^2 sum A'A is singular (no noise, no rotation, or parallel axes), and {name!r} needs "
            "its inverse; use method='dqopt', which needs no inverse"
        )
    relaxed = relaxed_cost(request.cost)
    of = curve(relaxed)
    if of is None:
        return outcome_of(request, relaxed.vectors[:, 0])
    mu = double_root(of, search(of))
    q = np.linalg.eigh(np.diag(relaxed.values) + mu * (relaxed.Z1 - mu * relaxed.Z2))[1][:, 0]
    return outcome_of(request, relaxed.vectors @ q)
