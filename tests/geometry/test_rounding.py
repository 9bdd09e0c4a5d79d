"""Sums and products of doubles without rounding, against fractions."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gtsam_rwhec.geometry.rounding import (
    UNIT,
    Doubled,
    difference,
    gamma,
    product,
    reciprocal,
    turned,
    two_product,
    two_sum,
)

numbers = st.floats(-1e100, 1e100).filter(lambda x: x == 0.0 or abs(x) > 1e-100)


def exactly(x: Doubled) -> list[Fraction]:
    return [Fraction(hi) + Fraction(lo) for hi, lo in zip(np.ravel(x.hi), np.ravel(x.lo), strict=True)]


@given(numbers, numbers)
def test_sums_and_products_lose_nothing(a: float, b: float) -> None:
    s, rest = two_sum(np.array(a), np.array(b))
    assert Fraction(float(s)) + Fraction(float(rest)) == Fraction(a) + Fraction(b)
    p, rest = two_product(np.array(a), np.array(b))
    assert Fraction(float(p)) + Fraction(float(rest)) == Fraction(a) * Fraction(b)


def test_longer_sums_and_products_keep_a_hundred_bits() -> None:
    generator = np.random.default_rng(0)
    R, v, w = generator.standard_normal((5, 3, 3)), 1e6 * generator.standard_normal((5, 3)), np.full((5, 3), 1e6)
    result = exactly(turned(R, difference(v, w)))
    for n in range(5):
        for i in range(3):
            terms = [Fraction(R[n, i, j]) * (Fraction(v[n, j]) - Fraction(w[n, j])) for j in range(3)]
            assert abs(result[3 * n + i] - sum(terms)) <= Fraction(1, 2**98) * sum(abs(t) for t in terms)
    doubled = product(R, R).plus(Doubled.of(R)).minus(product(R, R))
    assert all(
        abs(value - Fraction(r)) <= Fraction(1, 2**98) * 10
        for value, r in zip(exactly(doubled), R.ravel(), strict=True)
    )


def test_reciprocals() -> None:
    a = np.array([3.0, 0.1, 1e-15, 7e14])
    for value, x in zip(exactly(reciprocal(a)), a, strict=True):
        assert abs(value * Fraction(x) - 1) <= Fraction(1, 2**100)


def test_gamma_covers_a_sum_in_any_order() -> None:
    assert gamma(10) >= 10 * UNIT
    with pytest.raises(OverflowError, match="too many"):
        gamma(10**16)
