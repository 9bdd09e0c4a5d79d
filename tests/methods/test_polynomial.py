from __future__ import annotations

import mpmath
import numpy as np
import pytest
from simulated import hand_held, planar

from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.methods import cost_of, motions_of
from gtsam_rwhec.methods.dq_approximations import (
    Curve,
    RelaxedCost,
    by_resultant,
    by_sturm,
    curve,
    double_root,
    real_roots,
    relaxed_cost,
    resultant,
)
from gtsam_rwhec.methods.dq_saddle import minimum
from gtsam_rwhec.methods.hand_eye import solve_hand_eye

POLYNOMIAL = ["dqoptpoly_resultant", "dqoptpoly_sturm"]


def curve_and_relaxation(make, seed: int, noise: float) -> tuple[Curve, RelaxedCost, float, float]:
    """The curve, the relaxation, and DQOpt's y = (lambda* - lambda_0) / scale and mu*."""
    s = make(100, seed, noise, noise)
    cost = cost_of(motions_of(s.C, s.H))
    found, relaxed = minimum(cost), relaxed_cost(cost)
    of = curve(relaxed)
    assert of is not None
    return of, relaxed, (found.values[0] - relaxed.values[0]) / of.lambda_scale, found.mu


def test_the_curve_is_the_determinant() -> None:
    of, relaxed, _, _ = curve_and_relaxation(hand_held, 0, 0.1)
    assert np.count_nonzero(of.coefficients) == 24  # of 25; lambda is counted from lambda_0, a root at mu = 0
    rows, columns = np.nonzero(of.coefficients)
    assert (columns <= 8 - 2 * rows).all()
    rng = np.random.default_rng(0)
    figures = []
    for x, y in rng.normal(size=(10, 2)):
        mu, shift = x * of.mu_scale, y * of.lambda_scale
        Z = np.diag(relaxed.values - relaxed.values[0] - shift) + mu * relaxed.Z1 - mu**2 * relaxed.Z2
        figures.append(y ** np.arange(5) @ of.coefficients @ x ** np.arange(9) / np.linalg.det(Z))
    assert figures == pytest.approx(np.full(10, figures[0]), rel=1e-9)


def test_eight_real_roots_below_the_optimum_and_six_above() -> None:
    """Figure 2 (b): the count jumps exactly at lambda*."""
    for seed in range(10):
        of, _, y, _ = curve_and_relaxation(planar, seed, 0.1)
        assert real_roots(of.in_x(0.9 * y)) == real_roots(of.in_x(y * (1 - 1e-9))) == 8
        assert real_roots(of.in_x(y * (1 + 1e-9))) == 6
        assert real_roots(of.in_x(0.5 * y)) == np.count_nonzero(np.abs(np.roots(of.in_x(0.5 * y)[::-1]).imag) < 1e-9)
        signs = [np.sign(resultant(of.in_x(y * f))) for f in (0.5, 1 - 1e-9, 1 + 1e-9, 1.2)]
        assert signs[0] == signs[1] == -signs[2] == -signs[3]


def test_sturm_counts_known_roots() -> None:
    rng = np.random.default_rng(1)
    for pairs in range(5):
        roots = np.concatenate(
            [rng.normal(size=8 - 2 * pairs), *[[c, c.conjugate()] for c in rng.normal(size=pairs) + 1j]]
        )
        assert real_roots(np.poly(roots).real[::-1]) == 8 - 2 * pairs


@pytest.mark.parametrize("method", POLYNOMIAL)
@pytest.mark.parametrize("make", [hand_held, planar])
@pytest.mark.parametrize("noise", [1e-4, 1e-2, 0.1])
def test_same_cost_as_dqopt(method: str, make, noise: float) -> None:
    for seed in range(4):
        s = make(60, seed, noise, noise)
        best = solve_hand_eye(s.C, s.H)
        r = solve_hand_eye(s.C, s.H, method=method)
        assert best.cost * (1 - 1e-12) <= r.cost <= best.cost * (1 + 1e-9)
        assert r.X.equals(best.X, 1e-6 * max(noise, 1e-2))


@pytest.mark.parametrize("search", [by_resultant, by_sturm])
@pytest.mark.parametrize(("noise", "digits"), [(1e-3, 8.0), (1e-2, 10.0), (1e-1, 12.0)])
def test_digits_that_double_precision_leaves(search, noise: float, digits: float) -> None:
    """Of lambda* - lambda_0, against the same 25 coefficients in 60 digits: the resultant keeps 14, Sturm 7 to 13.

    lambda* has more, the difference being a small part of it.
    """
    worst = 20.0
    for seed in range(6):
        of, *_ = curve_and_relaxation(hand_held, seed, noise)
        worst = min(worst, -np.log10(abs(search(of) / exact_y(of) - 1.0) + 1e-17))
    assert worst >= (14.0 if search is by_resultant else digits)


def exact_y(of: Curve) -> float:
    """The y of the double root near x = 1, by Newton's method in 60 digits on p = dp/dx = 0."""
    with mpmath.workdps(60):
        c = [[mpmath.mpf(float(entry)) for entry in row] for row in of.coefficients]

        def p(x, y, dx: int = 0):
            return mpmath.fsum(
                c[m][n] * y**m * mpmath.ff(n, dx) * x ** (n - dx) for m in range(5) for n in range(dx, 9)
            )

        start = (double_root(of, by_sturm(of)) / of.mu_scale, by_sturm(of))
        _, y = mpmath.findroot(lambda x, y: [p(x, y), p(x, y, 1)], start)
        return float(y)


@pytest.mark.parametrize("method", POLYNOMIAL)
def test_without_noise_it_is_refused(method: str) -> None:
    s = hand_held(20, 0, 0.0, 0.0)
    with pytest.raises(
        UnderdeterminedError, match=f"is singular .* and '{method}' needs its inverse; use method='dqopt'"
    ):
        solve_hand_eye(s.C, s.H, method=method)
