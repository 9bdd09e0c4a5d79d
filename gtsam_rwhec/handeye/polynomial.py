"""DQOptPoly (DQ paper, Section 3.1.2 and Appendix B): the optimum from the algebraic curve p(lambda, mu) = 0.

p(lambda, mu) = det(Z(mu) - lambda) (eq. 15) has 25 coefficients. As a polynomial in mu it has eight real roots for
lambda from the relaxation's lambda_0 up to lambda*. At lambda* the two roots around mu = 0 meet; above it there are
six. Two searches in one variable find lambda*. One looks at the sign of the resultant of p and dp/dmu, the other counts
the real roots (Sturm's theorem).

The paper starts at lambda = 0. Here lambda is counted from lambda_0, Z is written in the relaxation's eigenvectors, and
mu and lambda are scaled by the sizes that eqs. 14 and 22 expect. The curve is the same, and double precision keeps more
digits. The resultant keeps 14 of 16 digits of lambda* - lambda_0. Sturm's sequence keeps 7 (rotation noise of 1e-4 rad)
to 13 (0.1 rad): see tests/handeye/test_polynomial.py. DQOpt needs none of this.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.polynomial.polynomial import polydiv
from scipy.optimize import brentq

from gtsam_rwhec.errors import NotConvergedWarning, UnderdeterminedError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.handeye.approximate import RelaxedCost, outcome_of, relaxation_gap, relaxed_cost
from gtsam_rwhec.handeye.request import Request
from gtsam_rwhec.handeye.saddle import is_singular
from gtsam_rwhec.methods.estimate import Outcome

#: The searches end at this many times eq. 22's gap. The gap is an upper bound, up to rounding.
BEYOND = 1.25
#: A remainder below this part of its dividend is rounding error: two roots have met.
ROUNDING = 1e-15
#: The resultant's search starts at this part of eq. 22's gap: at 0 one root is mu = 0 and spoils the roots' mean.
NOT_ZERO = 1e-3
#: Sturm's interval is halved this many times, to below the rounding of a double.
BISECTIONS = 60


@dataclass(frozen=True)
class Curve:
    """p(lambda, mu) in x = mu / ``mu_scale`` and y = (lambda - lambda_0) / ``lambda_scale``.

    Entry [m, n] of the coefficients (5, 9) belongs to y^m x^n; 25 are not zero: n <= 8 - 2 m. The scales are mu of
    eq. 14 for the relaxation's q, and the gap of eq. 22.
    """

    coefficients: Array
    mu_scale: float
    lambda_scale: float

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
    return Curve(_determinant(entries.reshape(4, 4, 18)), mu, gap)


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
        if size <= ROUNDING * float(np.abs(above).max()):
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
