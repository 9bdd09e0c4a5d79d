"""Bounds on rounding, and sums and products of doubles without rounding (Dekker 1971; Knuth).

A `Doubled` number (hi, lo) stands for hi + lo, with lo less than rounding of hi. Sums and products of such numbers are
right to about 2^-102 of their largest term.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gtsam_rwhec.geometry.poses import Array

#: Unit roundoff of double precision.
UNIT = 2.0**-53
#: A bound times this factor covers the rounding errors of the few operations that compute it.
SAFETY = 1.0 + 1e-10
#: Veltkamp's constant splits a double into two halves of 26 bits.
_SPLITTER = 2.0**27 + 1.0


def gamma(terms: int, unit: float = UNIT) -> float:
    """gamma_n = n u / (1 - n u): the relative error of n rounded operations (Higham 2002, section 3.1)."""
    if terms * unit >= 0.5:
        raise OverflowError(f"{terms} terms are too many for a rounding bound with unit {unit:g}")
    return SAFETY * terms * unit / (1.0 - terms * unit)


def gammas(terms: Array) -> Array:
    """`gamma` of many numbers of operations."""
    largest = int(np.max(terms, initial=0))
    gamma(largest)  # refuses what is too many
    part = np.asarray(terms, dtype=np.float64) * UNIT
    return SAFETY * part / (1.0 - part)


class Doubled(NamedTuple):
    """Numbers hi + lo; both arrays have the same shape."""

    hi: Array
    lo: Array

    @staticmethod
    def of(value: Array) -> Doubled:
        """Doubles as they are."""
        return Doubled(value, np.zeros_like(value))

    @staticmethod
    def zeros(*shape: int) -> Doubled:
        """Zeros."""
        return Doubled(np.zeros(shape), np.zeros(shape))

    def plus(self, other: Doubled) -> Doubled:
        """The sum."""
        s, rest = two_sum(self.hi, other.hi)
        return Doubled(*_quick_two_sum(s, rest + self.lo + other.lo))

    def minus(self, other: Doubled) -> Doubled:
        """The difference."""
        return self.plus(Doubled(-other.hi, -other.lo))

    def times(self, factor: Array | float) -> Doubled:
        """The product with doubles."""
        p, rest = two_product(self.hi, np.asarray(factor))
        return Doubled(*_quick_two_sum(p, rest + self.lo * factor))

    def summed(self, axis: int) -> Doubled:
        """The sum along an axis, one after the other."""
        hi, lo = np.moveaxis(self.hi, axis, 0), np.moveaxis(self.lo, axis, 0)
        total = Doubled(hi[0], lo[0])
        for k in range(1, len(hi)):
            total = total.plus(Doubled(hi[k], lo[k]))
        return total

    @property
    def value(self) -> Array:
        """The nearest doubles."""
        return self.hi + self.lo


def two_sum(a: Array, b: Array) -> tuple[Array, Array]:
    """The rounded sum, and its exact rounding error."""
    s = a + b
    of_b = s - a
    return s, (a - (s - of_b)) + (b - of_b)


def two_product(a: Array, b: Array) -> tuple[Array, Array]:
    """The rounded product, and its exact rounding error."""
    p = a * b
    a_high, b_high = _high_half(a), _high_half(b)
    a_low, b_low = a - a_high, b - b_high
    return p, ((a_high * b_high - p) + a_high * b_low + a_low * b_high) + a_low * b_low


def difference(a: Array, b: Array) -> Doubled:
    """a - b of doubles."""
    return Doubled(*two_sum(np.asarray(a, dtype=np.float64), -np.asarray(b, dtype=np.float64)))


def product(a: Array, b: Array) -> Doubled:
    """a b of doubles."""
    return Doubled(*two_product(np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)))


def turned(R: Array, v: Doubled) -> Doubled:
    """R v for matrices of doubles (n, 3, 3) and vectors (n, 3)."""
    return Doubled(v.hi[:, None, :], v.lo[:, None, :]).times(R).summed(axis=2)


def reciprocal(a: Array) -> Doubled:
    """1 / a of doubles, by one Newton step."""
    first = 1.0 / np.asarray(a, dtype=np.float64)
    p, rest = two_product(first, np.asarray(a, dtype=np.float64))
    return Doubled(first, ((1.0 - p) - rest) * first)


def _quick_two_sum(a: Array, b: Array) -> tuple[Array, Array]:
    """`two_sum` for |a| >= |b|."""
    s = a + b
    return s, b - (s - a)


def _high_half(a: Array) -> Array:
    scaled = _SPLITTER * a
    return scaled - (scaled - a)
