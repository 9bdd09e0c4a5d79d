"""Weighted sums of residuals in plain double precision, with bounds, for many measurements.

`exact_residuals` gives residuals to their last digit and costs several times as much as reading the measurements. Where
residuals are noise, far above the rounding of their terms, doubles tell the sums to a dozen digits. The bounds say
whether they do. With Cauchy and Schwarz they need no more than sums of squares: an error e of residuals r and features
f changes sum w f r by at most sqrt(sum w f^2) sqrt(sum w e^2).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import ROTATION_TOLERANCE, Array
from gtsam_rwhec.geometry.rounding import gamma
from gtsam_rwhec.problem.measurements import Measurements
from gtsam_rwhec.solver.exact_residuals import BLOCK, Coefficients, Measured, Stack, Sums, small_stacks
from gtsam_rwhec.solver.given import SMALL

#: With fewer measurements the exact sums are quick enough.
MANY = 10_000
#: Sums are taken as they are where the cost is known up to this part of it: a hundredth of a percent of the tolerance.
KNOWN = 1e-10
#: A residual sums 24 products, a constant, and the low parts of its coefficients.
OPERATIONS = 30
#: Operations of a centred translation, and of weights and squares.
_FEW = 16
#: The square of an entry of a rotation that was not refused is at most this.
_OF_ROTATION = 1.0 + ROTATION_TOLERANCE
#: Where the translation is among a pose's twelve features.
_T = slice(3, 12, 4)


def plain_sums(measured: Measured, coefficients: Coefficients) -> Sums | None:
    """The sums for one direction; None where there are few measurements, or doubles do not tell the cost well enough.

    The result is that of `exact_residuals.weighted_sums`, with larger bounds.
    """
    if coefficients.one.hi.shape[1] != 12 or measured.count < MANY:
        return None
    pairs = len(measured.a)
    products, products_error = np.zeros((pairs, 12)), np.zeros((pairs, 12))
    tables: list[Array] = [np.zeros((pairs, 12, 12)), np.zeros((pairs, 12, 12)), np.zeros((pairs, 12))]
    errors, sizes = ([np.zeros_like(table) for table in tables] for _ in range(2))
    front, back, one = (each.hi for each in (coefficients.front, coefficients.back, coefficients.one))
    counts = np.zeros(pairs, dtype=int)
    for at, own in _sums_of(measured, (back, front) if measured.is_swapped else (front, back), one):
        of_A, of_B = (back[at], front[at]) if measured.is_swapped else (front[at], back[at])
        square, error, by_A, by_B, by_one = own.bounded(of_A, of_B, one[at], measured.a[at], measured.c[at])
        np.add.at(products, at, square)
        np.add.at(products_error, at, error)
        by_front, by_back = (by_B, by_A) if measured.is_swapped else (by_A, by_B)
        np.add.at(counts, at, 1)
        for table, bound, size, (value, reach) in zip(tables, errors, sizes, (by_front, by_back, by_one), strict=True):
            np.add.at(table, at, value)
            np.add.at(bound, at, reach)
            np.add.at(size, at, np.abs(value))
    batches = gamma(int(counts.max(initial=0)) + 2)
    for bound, size in zip(errors, sizes, strict=True):
        bound += batches * size
        bound *= 1.0 + 1e-9
    products_error += batches * products
    products_error *= 1.0 + 1e-9
    if not products_error.sum() <= KNOWN * products.sum():
        return None
    shape = (pairs, 1, 1, 12)
    return Sums(
        products.reshape(shape),
        products_error.reshape(shape),
        tables[0],
        errors[0],
        tables[1],
        errors[1],
        tables[2],
        errors[2],
    )


def _sums_of(
    measured: Measured, of_A_and_B: tuple[Array, Array], one: Array
) -> Iterator[tuple[np.ndarray, _BatchSums]]:
    """Pairs (k,) and the sums over a batch of each: of small batches many at once."""
    of_A, of_B = of_A_and_B
    for stack in small_stacks(measured):
        at = stack.pairs
        yield at, _BatchSums.of_stack(stack, of_A[at], of_B[at], one[at], measured.a[at], measured.c[at])
    for pair, raw in measured.batches:
        if len(raw.A) > SMALL:
            own = _BatchSums.of(raw, of_A[pair], of_B[pair], one[pair], measured.a[pair], measured.c[pair])
            yield np.array([pair]), own


def _wide(of_A: Array, of_B: Array, one: Array, a: Array, c: Array) -> tuple[Array, Array, Array]:
    """What makes the columns [12 residuals, t_A + R_A c - a, t_A, t_B, 1] of k pairs from A, from B, and constants."""
    k = len(one)
    wide_A, wide_B, constant = np.zeros((k, 12, 22)), np.zeros((k, 12, 22)), np.zeros((k, 22))
    wide_A[:, :, :12], wide_B[:, :, :12], constant[:, :12] = of_A, of_B, one
    for i in range(3):
        wide_A[:, 4 * i : 4 * i + 3, 12 + i] = c
        wide_A[:, 4 * i + 3, 12 + i] = wide_A[:, 4 * i + 3, 15 + i] = wide_B[:, 4 * i + 3, 18 + i] = 1.0
    constant[:, 12:15], constant[:, 21] = -a, 1.0
    return wide_A, wide_B, constant


@dataclass(frozen=True)
class _BatchSums:
    """Sums over a batch of each of k pairs: squares of translations and residuals, features times residuals, weights.

    Columns of residuals have two kinds of weights, nine times kappa and three times 1 / sigma^2; so every translation
    has two sums of squares.
    """

    count: int  #: of the longest batch
    square: Array  #: (k, 12)
    total: Array  #: (k, 12), of the weights
    one: Array  #: (k, 12)
    by_A: Array  #: (k, 12, 12)
    by_B: Array  #: (k, 12, 12)
    by_t: Array  #: (k, 3, 12)
    #: (k, 9, 12): squares of the translations of A about the gauge, of A, and of B, by the weights of the residuals.
    translations: Array

    @staticmethod
    def of(raw: Measurements, of_A: Array, of_B: Array, one: Array, a: Array, c: Array) -> _BatchSums:
        """One pass over a batch: few products of wide matrices, as other operations take as long for three columns."""
        n = len(raw.A)
        A, B = raw.A.reshape(n, 16)[:, :12], raw.B.reshape(n, 16)[:, :12]
        is_uniform = raw.sigma.strides == (0,) and raw.kappa.strides == (0,)
        (wide_A,), (wide_B,), (constant,) = _wide(of_A[None], of_B[None], one[None], a[None], c[None])
        by_A, by_B = np.zeros((12, 12)), np.zeros((12, 12))
        of_kappa, of_weight = np.zeros((22, 22)), np.zeros((22, 22))
        size = min(BLOCK, n)
        columns_of_all, second_of_all = np.empty((size, 22)), np.empty((size, 22))
        for first in range(0, n, BLOCK):
            block = slice(first, min(first + BLOCK, n))
            k = block.stop - first
            columns, second = columns_of_all[:k], second_of_all[:k]
            np.matmul(A[block], wide_A, out=columns)
            columns += np.matmul(B[block], wide_B, out=second)
            columns += constant
            flat = columns[:, :12]
            if is_uniform:
                of_kappa[:, :21] += columns.T @ columns[:, :21]  # a product of a matrix with itself is slower
            else:
                kappa, weight = raw.kappa[block, None], 1.0 / raw.sigma[block, None] ** 2
                of_kappa += columns.T @ (columns * kappa)
                of_weight += columns.T @ (columns * weight)
                flat = np.concatenate([columns[:, :9] * kappa, columns[:, 9:12] * weight], axis=1)
            by_A += A[block].T @ flat
            by_B += B[block].T @ flat
        if is_uniform:
            of_kappa[21, 21] = n
            weights = np.repeat([float(raw.kappa[0]), 1.0 / float(raw.sigma[0]) ** 2], [9, 3])
            of_weight = of_kappa * weights[-1]
            of_kappa *= weights[0]
            by_A *= weights
            by_B *= weights
        return _BatchSums._of_products(n, of_kappa[None], of_weight[None], by_A[None], by_B[None])

    @staticmethod
    def of_stack(stack: Stack, of_A: Array, of_B: Array, one: Array, a: Array, c: Array) -> _BatchSums:
        """The sums over small batches of k pairs; what pads them has no weight."""
        wide_A, wide_B, constant = _wide(of_A, of_B, one, a, c)
        columns = np.matmul(stack.A, wide_A) + np.matmul(stack.B, wide_B) + constant[:, None, :]
        turned = columns.transpose(0, 2, 1)
        weighted = columns * stack.kappa[:, :, None], columns * stack.weight[:, :, None]
        flat = np.concatenate([weighted[0][:, :, :9], weighted[1][:, :, 9:12]], axis=2)
        return _BatchSums._of_products(
            columns.shape[1],
            np.matmul(turned, weighted[0]),
            np.matmul(turned, weighted[1]),
            np.matmul(stack.A.transpose(0, 2, 1), flat),
            np.matmul(stack.B.transpose(0, 2, 1), flat),
        )

    @staticmethod
    def _of_products(count: int, of_kappa: Array, of_weight: Array, by_A: Array, by_B: Array) -> _BatchSums:
        """From the weighted products of all columns, (k, 22, 22) for each kind of weight."""
        by_residual = np.concatenate([of_kappa[:, :, :9], of_weight[:, :, 9:12]], axis=2)
        squares = (
            np.repeat(np.einsum("kii->ki", each)[:, 12:, None], columns, axis=2)
            for each, columns in ((of_kappa, 9), (of_weight, 3))
        )
        of_features = np.concatenate(list(squares), axis=2)
        return _BatchSums(
            count,
            np.einsum("kii->ki", by_residual[:, :12]).copy(),
            of_features[:, 9],
            by_residual[:, 21],
            by_A,
            by_B,
            by_residual[:, 12:15],
            of_features[:, :9],
        )

    def bounded(
        self, of_A: Array, of_B: Array, one: Array, a: Array, c: Array
    ) -> tuple[Array, Array, tuple[Array, Array], tuple[Array, Array], tuple[Array, Array]]:
        """The squares (k, 12), by A and by B (k, 12, 12) and by one (k, 12), each followed by a bound on its error."""
        up = 1.0 + 1e-9
        of_ones: Array = np.sqrt(self.total) * up
        k = len(of_ones)
        of_t, of_A_t, of_B_t = (np.sqrt(self.translations).reshape(k, 3, 3, 12) * up).transpose(1, 0, 2, 3)
        A_size, B_size = np.empty((k, 12, 12)), np.empty((k, 12, 12))
        A_size[...] = B_size[...] = np.sqrt(_OF_ROTATION) * up * of_ones[:, None, :]
        A_size[:, _T], B_size[:, _T] = of_A_t, of_B_t
        # The root of the weighted sum of squares of the residuals' own errors.
        terms = np.abs(one) * of_ones
        terms += np.einsum("kfo,kfo->ko", np.abs(of_A), A_size)
        terms += np.einsum("kfo,kfo->ko", np.abs(of_B), B_size)
        slack = gamma(OPERATIONS) * up * terms
        unit = gamma(min(BLOCK, self.count) + -(-self.count // BLOCK) + _FEW)
        root = np.sqrt(self.square) * up + slack
        error = unit * root * root + 2.0 * slack * root
        off = unit * root + slack
        by_A, A_error = self.by_A.copy(), A_size * off[:, None, :]
        reach = np.abs(c).sum(axis=1)[:, None] + np.abs(a)
        of_centring = 8.0 * gamma(1) * (of_A_t + reach[:, :, None] * of_ones[:, None, :])
        by_A[:, _T] = self.by_t
        A_error[:, _T] = of_t * off[:, None, :] + of_centring * root[:, None, :]
        return self.square, error, (by_A, A_error), (self.by_B, B_size * off[:, None, :]), (self.one, of_ones * off)
