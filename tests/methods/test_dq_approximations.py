"""."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
from simulated import distance, hand_held, planar

from gtsam_rwhec.errors import OptionError, UnderdeterminedError
from gtsam_rwhec.methods import cost_of, motions_of
from gtsam_rwhec.methods.dq_approximations import (
    Curve,
    RelaxedCost,
    by_resultant,
    by_sturm,
    curve,
    double_root,
    dq_nth_order,
    expansion,
    lambda_expansion,
    real_roots,
    relaxation_gap,
    relaxed_cost,
    resultant,
)
from gtsam_rwhec.methods.dq_saddle import minimum
from gtsam_rwhec.methods.hand_eye import solve_hand_eye
from gtsam_rwhec.methods.hand_eye_request import Request

APPROXIMATE = ["dq2steps", "dqconvrlx", "dq2ndord", "dq2ndord_lambda", "dqitr"]


@pytest.fixture(scope="module")
def relaxed() -> RelaxedCost:
    s = hand_held(12, 3, 0.2, 0.3)
    return relaxed_cost(cost_of(motions_of(s.C, s.H)))


def Z(relaxed: RelaxedCost, mu: float) -> np.ndarray:
    return np.diag(relaxed.values) + mu * relaxed.Z1 - mu**2 * relaxed.Z2


def test_the_recursion_gives_the_eigenvalue_and_its_vector(relaxed: RelaxedCost) -> None:
    """Eq. 33 with its middle term corrected; the error of order k shrinks as mu^(k+1)."""
    step = 1e-3 * np.abs(relaxed.values).max() / np.abs(relaxed.Z1).max()
    for order in (1, 2, 3, 4, 5):
        lambdas, c = expansion(relaxed, order)
        errors = []
        for mu in (8 * step, 4 * step):
            values, vectors = np.linalg.eigh(Z(relaxed, mu))
            q = sum(c[k] * mu**k for k in range(order + 1))
            errors.append(
                (
                    abs(sum(lambdas[k] * mu**k for k in range(order + 1)) - values[0]),
                    np.abs(q - vectors[:, 0] * np.sign(vectors[0, 0])).max(),
                )
            )
        for large, small in zip(*errors, strict=True):
            assert small < large * 0.5 ** (order + 1) * 1.3 + 1e-13


def _lambda_series(relaxed: RelaxedCost, sign: float) -> tuple[float, float, np.ndarray, np.ndarray]:
    """mu_1, mu_2, q_1, q_2 of eq. 35 with ``sign`` before Z2: +1 as printed, -1 corrected."""
    Z1, Z2 = relaxed.Z1, relaxed.Z2
    gap = relaxed.values[0] - relaxed.values[1:]
    mu1 = 1.0 / Z1[0, 0]
    q1 = np.append(0.0, mu1 * Z1[1:, 0] / gap)
    mu2 = -(mu1 * Z1[0] @ q1 + sign * mu1**2 * Z2[0, 0]) / Z1[0, 0]
    q2 = np.append(-0.5 * q1 @ q1, (Z1[1:] @ (mu1 * q1) + mu2 * Z1[1:, 0] + sign * mu1**2 * Z2[1:, 0] - q1[1:]) / gap)
    return mu1, mu2, q1, q2


@pytest.mark.parametrize(("sign", "order"), [(-1.0, 3), (1.0, 2)])
def test_eq_35_solves_eq_12_to_second_order_only_with_the_other_sign_of_Z2(
    relaxed: RelaxedCost, sign: float, order: int
) -> None:
    mu1, mu2, q1, q2 = _lambda_series(relaxed, sign)
    size = 1e-3 / max(abs(mu2 / mu1), np.abs(q1).max(), np.sqrt(np.abs(q2).max()))
    residuals = []
    for change in (size, size / 2):
        mu = mu1 * change + mu2 * change**2
        q = np.array([1.0, 0, 0, 0]) + q1 * change + q2 * change**2
        residuals.append(np.linalg.norm(Z(relaxed, mu) @ q - (relaxed.values[0] + change) * q))
    assert np.log2(residuals[0] / residuals[1]) == pytest.approx(order, abs=0.1)


def test_the_lambda_expansion_meets_the_constraint_better_than_the_relaxation(relaxed: RelaxedCost) -> None:
    def violation(q: np.ndarray) -> float:
        """How far the best mu of q (eq. 14) is from making q an eigenvector (eq. 12)."""
        q = q / np.linalg.norm(q)
        Zq = Z(relaxed, 0.5 * (q @ relaxed.Z1 @ q) / (q @ relaxed.Z2 @ q)) @ q
        return float(np.linalg.norm(Zq - (q @ Zq) * q))

    q = lambda_expansion(relaxed)
    assert q is not None
    assert violation(q) < 0.2 * violation(np.array([1.0, 0, 0, 0]))


@pytest.mark.parametrize("make", [hand_held, planar])
@pytest.mark.parametrize("seed", range(4))
def test_costs_are_ordered_as_the_paper_has_them(make, seed: int) -> None:
    s = make(100, seed, 0.03, 0.03)
    costs = {name: solve_hand_eye(s.C, s.H, method=name).cost for name in ["dqopt", *APPROXIMATE]}
    best = costs["dqopt"]
    for name in APPROXIMATE:
        assert costs[name] >= best * (1 - 1e-12)
    assert costs["dqitr"] == pytest.approx(best, rel=1e-9)
    assert costs["dq2ndord"] - best <= costs["dqconvrlx"] - best + 1e-12 * best
    assert costs["dqconvrlx"] <= costs["dq2steps"]
    assert costs["dq2ndord"] == pytest.approx(best, rel=1e-5)
    assert costs["dqconvrlx"] == pytest.approx(best, rel=1e-2)


def test_the_relaxations_gap_is_eq_22() -> None:
    s = hand_held(30, 5, 0.1, 0.2)
    r = solve_hand_eye(s.C, s.H, method="dqconvrlx")
    best = solve_hand_eye(s.C, s.H)
    relaxed = relaxed_cost(cost_of(motions_of(s.C, s.H)))
    assert r.gap == pytest.approx(relaxation_gap(relaxed), rel=1e-4)
    assert r.lower_bound <= best.cost <= r.cost
    assert not r.is_optimal
    assert best.is_optimal


def test_higher_orders_come_closer() -> None:
    s = hand_held(12, 3, 0.2, 0.3)
    motions = motions_of(s.C, s.H)
    request = Request(motions, cost_of(motions), 1.0, None, None, None, "known", None)
    best = solve_hand_eye(s.C, s.H).X.matrix()
    errors = [np.abs(dq_nth_order(request, order).X - best).max() for order in range(1, 8)]
    assert errors[1] < 0.3 * errors[0]
    assert errors[6] < 0.05 * errors[1]
    assert pytest.approx(solve_hand_eye(s.C, s.H, method="dq2ndord").X.matrix()) == dq_nth_order(request, 2).X
    with pytest.raises(OptionError, match="order=0"):
        dq_nth_order(request, 0)


@pytest.mark.parametrize("method", APPROXIMATE)
def test_without_noise_all_are_exact(method: str) -> None:
    s = hand_held(20, 6, 0.0, 0.0)
    assert max(distance(solve_hand_eye(s.C, s.H, method=method).X, s.X)) < 1e-11


POLYNOMIAL = ["dqoptpoly_resultant", "dqoptpoly_sturm"]


def curve_and_relaxation(make, seed: int, noise: float) -> tuple[Curve, RelaxedCost, float, float]:
    """The curve, the relaxation, and DQOpt's y = (lambda* - lambda_0) / scale and mu*."""
    s = make(100, seed, noise, noise)
    cost = cost_of(motions_of(s.C, s.H))
    found, relaxed = minimum(cost), relaxed_cost(cost)
    of = curve(relaxed)
    assert of is not None
    return of, relaxed, (found.values[0] - relaxed.values[0]) / relaxation_gap(relaxed), found.mu


def test_eight_real_roots_below_the_optimum_and_six_above() -> None:
    """Figure 2 (b): the count jumps exactly at lambda*."""
    for seed in range(10):
        of, _, y, _ = curve_and_relaxation(planar, seed, 0.1)
        assert real_roots(of.in_x(0.9 * y)) == real_roots(of.in_x(y * (1 - 1e-9))) == 8
        assert real_roots(of.in_x(y * (1 + 1e-9))) == 6
        assert real_roots(of.in_x(0.5 * y)) == np.count_nonzero(np.abs(np.roots(of.in_x(0.5 * y)[::-1]).imag) < 1e-9)
        signs = [np.sign(resultant(of.in_x(y * f))) for f in (0.5, 1 - 1e-9, 1 + 1e-9, 1.2)]
        assert signs[0] == signs[1] == -signs[2] == -signs[3]


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
