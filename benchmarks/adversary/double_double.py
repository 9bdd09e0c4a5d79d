"""Arithmetic with pairs of doubles, 106 bits: arrays of numbers hi + lo with |lo| at most half an ulp of hi.

Products and sums of two doubles are split exactly (Dekel 1971, Knuth 1969); what is dropped is below 2^-100 of the
terms' magnitudes. Nothing here depends on the width of the platform's long double.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

#: Splits a double into two of 26 bits.
SPLITTER = 2.0**27 + 1.0
#: Relative to the sum of the terms' magnitudes, what a sum of products of pairs may be off by.
UNIT = 2.0**-98


class Pairs(NamedTuple):
    """An array of numbers hi + lo."""

    hi: np.ndarray
    lo: np.ndarray

    @staticmethod
    def of(values: np.ndarray | float) -> Pairs:
        hi = np.asarray(values, dtype=np.float64)
        return Pairs(hi, np.zeros_like(hi))

    def at(self, index: object) -> Pairs:
        return Pairs(self.hi[index], self.lo[index])

    def long(self) -> np.ndarray:
        return self.hi.astype(np.longdouble) + self.lo


def two_sum(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    s = a + b
    v = s - a
    return s, (a - (s - v)) + (b - v)


def two_product(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    p = a * b
    t = SPLITTER * a
    a1 = t - (t - a)
    a2 = a - a1
    t = SPLITTER * b
    b1 = t - (t - b)
    b2 = b - b1
    return p, ((a1 * b1 - p) + a1 * b2 + a2 * b1) + a2 * b2


def normal(hi: np.ndarray, lo: np.ndarray) -> Pairs:
    """The same numbers with lo below half an ulp; |lo| <= |hi| before."""
    s = hi + lo
    return Pairs(s, lo - (s - hi))


def added(a: Pairs, b: Pairs) -> Pairs:
    s, e = two_sum(a.hi, b.hi)
    t, f = two_sum(a.lo, b.lo)
    s, e = normal(s, e + t)
    return normal(s, e + f)


def negative(a: Pairs) -> Pairs:
    return Pairs(-a.hi, -a.lo)


def multiplied(a: Pairs, b: Pairs) -> Pairs:
    p, e = two_product(a.hi, b.hi)
    return normal(p, e + (a.hi * b.lo + a.lo * b.hi))


def reciprocal(a: Pairs) -> Pairs:
    q = 1.0 / a.hi
    p, e = two_product(q, a.hi)
    rest = ((1.0 - p) - e) - q * a.lo
    return normal(q, rest / a.hi)


def divided(a: Pairs, b: Pairs) -> Pairs:
    q = a.hi / b.hi
    rest = added(a, negative(multiplied(Pairs.of(q), b)))
    return normal(q, rest.hi / b.hi)


def summed(hi: np.ndarray, lo: np.ndarray, axis: int = -1) -> Pairs:
    """Sums along an axis, two by two."""
    if axis != -1:
        hi, lo = np.moveaxis(hi, axis, -1), np.moveaxis(lo, axis, -1)
    if hi.shape[-1] == 0:
        return Pairs.of(np.zeros(hi.shape[:-1]))
    while hi.shape[-1] > 1:
        half = hi.shape[-1] // 2
        s, e = two_sum(hi[..., :half], hi[..., half : 2 * half])
        e = e + (lo[..., :half] + lo[..., half : 2 * half])
        if hi.shape[-1] % 2:
            s = np.concatenate([s, hi[..., -1:]], axis=-1)
            e = np.concatenate([e, lo[..., -1:]], axis=-1)
        hi, lo = s, e
    return normal(hi[..., 0], lo[..., 0])


def dot(a: np.ndarray, b: Pairs, axis: int = -1) -> Pairs:
    """Sums of products of doubles and pairs along an axis."""
    p, e = two_product(a, b.hi)
    return summed(p, e + a * b.lo, axis)
