"""DQOptPoly (DQ paper, Section 3.1.2 and Appendix B): the optimum from the algebraic curve p(lambda, mu) = 0.

p(lambda, mu) = det(Z(mu) - lambda) (eq. 15) has 25 coefficients. As a polynomial in mu it has eight real roots for
lambda from lambda_0 of the relaxation up to lambda*, where the two around mu = 0 meet, and six beyond. Two searches for
lambda* in one variable: the sign of the resultant of p and dp/dmu, and the number of real roots by Sturm's theorem.

The paper starts at lambda = 0. Here lambda is counted from lambda_0, Z is written in the relaxation's eigenvectors, mu
and lambda are scaled by what eqs. 14 and 22 expect of them: the same curve, with digits left in double precision.
Of lambda* - lambda_0 the resultant then keeps 14 of 16 digits, Sturm's sequence 7 (rotation noise of 1e-4 rad) to 13
(0.1 rad): tests/handeye/test_polynomial.py. DQOpt needs none of this.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from gtsam_rwhec.errors import NotConvergedWarning, UnderdeterminedError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.handeye.approximate import RelaxedCost, outcome_of, relaxation_gap, relaxed_cost
from gtsam_rwhec.handeye.request import Request
from gtsam_rwhec.handeye.saddle import is_singular
from gtsam_rwhec.methods.estimate import Outcome

#: lambda* is looked for up to this many times eq. 22's gap, an upper bound that rounding may have touched.
BEYOND = 1.25
#: A remainder below this part of what it was formed from is rounding: two roots have met.
ROUNDING = 1e-15
NOT_ZERO = 1e-3
BISECTIONS = 60


@dataclass(frozen=True)
class Curve:
    """p(lambda, mu) in x = mu / ``mu_scale`` and y = (lambda - lambda_0) / ``lambda_scale``.

    Attributes
    ----------
    coefficients : (5, 9) array
        Entry [m, n] is that of y^m x^n; 25 are not zero: n <= 8 - 2 m.
    mu_scale, lambda_scale : float
        Eq. 14 for the relaxation's q, and the gap of eq. 22.
    """

    coefficients: Array
    mu_scale: float
    lambda_scale: float

    def in_x(self, y: float) -> Array:
        """Coefficients (9,) of the polynomial in x for one y, of x^0 first, the largest of size one."""
        p: Array = y ** np.arange(5) @ self.coefficients
        scaled: Array = p / np.abs(p).max()
        return scaled


def curve(relaxed: RelaxedCost) -> Curve | None:
    """The curve's coefficients (eq. 15); None where the gap of eq. 22 is rounding, and mu = 0 the answer."""
    gap = relaxation_gap(relaxed)
    if not gap > 1e-15 * max(abs(float(relaxed.values[0])), 1e-15 * abs(float(relaxed.values[3]))):
        return None
    mu = 0.5 * float(relaxed.Z1[0, 0] / relaxed.Z2[0, 0])  # eq. 14
    # Each entry of Z - lambda is a polynomial (2, 3) in (y, x); rows scaled to size one, which scales p alone.
    entries = np.zeros((4, 4, 2, 3))
    entries[:, :, 0, 0] = np.diag(relaxed.values - relaxed.values[0])
    entries[:, :, 0, 1] = mu * relaxed.Z1
    entries[:, :, 0, 2] = -(mu**2) * relaxed.Z2
    entries[range(4), range(4), 1, 0] = -gap
    entries /= np.abs(entries).max(axis=(1, 2, 3))[:, None, None, None]
    return Curve(_determinant(entries), mu, gap)


def _determinant(entries: Array) -> Array:
    """The determinant (5, 9) of a 4 x 4 matrix of polynomials, by the minors of its upper and lower two rows."""
    total = np.zeros((5, 9))
    pairs = [(i, j) for i in range(4) for j in range(i + 1, 4)]
    for i, j in pairs:
        k, m = (c for c in range(4) if c not in (i, j))
        upper = _product(entries[0, i], entries[1, j]) - _product(entries[0, j], entries[1, i])
        lower = _product(entries[2, k], entries[3, m]) - _product(entries[2, m], entries[3, k])
        total += (-1.0) ** (i + j + 1) * _product(upper, lower)
    return total


def _product(p: Array, q: Array) -> Array:
    """The product of two polynomials in two variables."""
    result = np.zeros((p.shape[0] + q.shape[0] - 1, p.shape[1] + q.shape[1] - 1))
    for i, j in np.ndindex(p.shape):
        result[i : i + q.shape[0], j : j + q.shape[1]] += p[i, j] * q
    return result


def resultant(p: Array) -> float:
    """The resultant of p (9,) and its derivative up to a positive factor: the determinant of their Sylvester matrix.

    x is scaled so that the roots' geometric mean is one: without that the determinant (15, 15) of roots of very
    different size has no correct digit, not even its sign.
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
    """How many real roots p (9,) has, by Sturm's theorem: sign changes of the sequence at -infinity less at infinity.

    The paper's "P_1 = P_0" is a misprint: P_1 is the derivative of P_0.
    """
    sequence = [p, p[1:] * np.arange(1, 9)]
    while len(sequence[-1]) > 1:
        above, divisor = sequence[-2:]
        remainder = above.copy()
        for top in range(len(above) - 1, len(divisor) - 2, -1):  # long division
            low = top - len(divisor) + 1
            remainder[low : top + 1] -= remainder[top] / divisor[-1] * divisor
        remainder = -remainder[: len(divisor) - 1]
        size = float(np.abs(remainder).max())
        if size <= ROUNDING * float(np.abs(above).max()):
            break
        sequence.append(remainder / size)
    leading = np.array([s[-1] for s in sequence])
    at_minus_infinity = leading * (-1.0) ** np.array([len(s) - 1 for s in sequence])
    changes = [int(np.count_nonzero(np.diff(np.sign(signs)))) for signs in (at_minus_infinity, leading)]
    return changes[0] - changes[1]


def by_resultant(of: Curve) -> float:
    """The y at which the resultant first changes its sign."""

    def f(y: float) -> float:
        return resultant(of.in_x(y))

    # At y = 0 one root is mu = 0, whose geometric mean with the rest says nothing.
    if f(NOT_ZERO) * f(BEYOND) < 0.0:
        return float(brentq(f, NOT_ZERO, BEYOND, xtol=1e-15, rtol=1e-14))
    warnings.warn(
        "'dqoptpoly_resultant' sees no change of the resultant's sign: the roots are closer than double precision "
        "tells; the answer is the relaxation's. Use method='dqopt'",
        NotConvergedWarning,
        stacklevel=5,
    )
    return 1.0  # eq. 22's bound


def by_sturm(of: Curve) -> float:
    """The y at which two of the eight real roots are lost."""
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

    p itself has a double root there, of which half the digits are lost; that of its derivative is simple.
    """
    p = of.in_x(y)
    x = np.roots((p[1:] * np.arange(1, 9))[::-1]).real
    powers = x[:, None] ** np.arange(9)
    return float(x[(np.abs(powers @ p) / (np.abs(powers) @ np.abs(p))).argmin()]) * of.mu_scale


def dqoptpoly_resultant(request: Request) -> Outcome[Array]:
    """DQOptPoly by the resultant.

    Raises
    ------
    UnderdeterminedError
        With M singular: the curve's coefficients are not finite.
    """
    return _solve(request, by_resultant, "dqoptpoly_resultant")


def dqoptpoly_sturm(request: Request) -> Outcome[Array]:
    """DQOptPoly by counting real roots.

    Raises
    ------
    UnderdeterminedError
        With M singular: the curve's coefficients are not finite.
    """
    return _solve(request, by_sturm, "dqoptpoly_sturm")


def _solve(request: Request, search: Callable[[Curve], float], name: str) -> Outcome[Array]:
    if is_singular(request.cost):
        raise UnderdeterminedError(
            f"M = alpha^2 sum A'A is singular (no noise, no rotation, or parallel axes), and {name!r} needs "
            "its inverse; use method='dqopt', which solves this case too"
        )
    relaxed = relaxed_cost(request.cost)
    of = curve(relaxed)
    if of is None:
        return outcome_of(request, relaxed.vectors[:, 0])
    mu = double_root(of, search(of))
    q = np.linalg.eigh(np.diag(relaxed.values) + mu * (relaxed.Z1 - mu * relaxed.Z2))[1][:, 0]
    return outcome_of(request, relaxed.vectors @ q)
