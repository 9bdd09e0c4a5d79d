"""Residuals of raw measurements for given coefficients, right to about 2^-70 of their largest term.

A measurement's twelve residuals are linear in the entries of its two poses: nine of the rotation equation, three of the
translation equation. Features and coefficients are split into a high slice, whose products and their sums are exact in
double precision in any order, and a low slice, whose products are so small that their rounding does not count (Ozaki,
Ogita, Oishi and Rump 2012). So large terms cancel exactly, BLAS computes the products, and no long double of the
platform is needed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import fsum

import numpy as np

from gtsam_rwhec.geometry.poses import ROTATION_TOLERANCE, Array
from gtsam_rwhec.geometry.rounding import Doubled, gamma
from gtsam_rwhec.problem.measurements import Measurements
from gtsam_rwhec.solver.parts import SMALL, Shared

#: This many measurements are evaluated at once: the slices of a block stay in the processor's cache.
BLOCK = 1024
#: A stack of small batches has about this many measurements: for small batches the calls take longer than the
#: arithmetic.
STACK = 4096
#: Batches in one stack have at least this part of its longest batch, so that little is padding.
FULL = 0.6
#: Bits of a feature's high slice.
FEATURE_BITS = 24
#: Bits of a coefficient's high slice. Products of 52 bits leave one bit for the rounding of the slices.
COEFFICIENT_BITS = 28
#: The low slices' products round by less than this part of the largest sum of terms.
LOW_PART = 2.0**-70
#: Operations of a residual's last sum, its weight, and its square.
_FEW = 12


@dataclass(frozen=True)
class Coefficients:
    """The residuals of E pairs as linear functions of the features, in D directions.

    ``front``, ``back`` (E, 12, 12 D) belong to the features [R | t], row by row, of the first and the second pose;
    ``one`` (E, 12 D) is constant. Twelve numbers a direction: the rotation residual row by row, then the translation
    residual.
    """

    front: Doubled
    back: Doubled
    one: Doubled


@dataclass(frozen=True)
class Stack:
    """Measurements of k batches, padded to the longest: A, B (k, m, 12), weight, kappa (k, m), pairs (k,)."""

    pairs: np.ndarray
    A: Array
    B: Array
    weight: Array
    kappa: Array


@dataclass(frozen=True)
class Measured:
    """All measurements of a part, batch by batch with the index of the pair, and the gauge's points a, c (E, 3).

    With ``is_swapped``, B is the front pose and A the back pose (the inverse equation).
    """

    batches: list[tuple[int, Measurements]]
    a: Array
    c: Array
    is_swapped: bool
    shared: Sequence[Shared] = ()  #: measurements of many pairs

    @property
    def count(self) -> int:
        """The number of measurements."""
        of_shared = (int(each.many.counts[each.pair >= 0].sum()) for each in self.shared)
        return sum(len(raw.A) for _, raw in self.batches) + sum(of_shared)


@dataclass(frozen=True)
class Sums:
    """Weighted sums over the measurements of each pair, each with a bound on its rounding.

    ``products``: of products of residuals in two directions; (E, 1, 1, 12) for one direction, and for several the sum
    over pairs and residuals, (1, D, D, 1). ``front``, ``back`` (E, 12, 12 D) and
    ``one`` (E, 12 D): of features times residuals, with the translations of A about the gauge.
    """

    products: Array
    products_error: Array
    front: Array
    front_error: Array
    back: Array
    back_error: Array
    one: Array
    one_error: Array


def stacks_of(measured: Measured) -> Iterator[Stack]:
    """The measurements in stacks."""
    yield from small_stacks(measured)
    for pair, raw in measured.batches:
        if len(raw.A) <= SMALL:
            continue
        for first in range(0, len(raw.A), BLOCK):
            part = slice(first, first + BLOCK)
            weight = 1.0 / raw.sigma[None, part] ** 2
            yield Stack(
                np.array([pair]), _rows(raw.A[part])[None], _rows(raw.B[part])[None], weight, raw.kappa[None, part]
            )


def small_stacks(measured: Measured) -> Iterator[Stack]:
    """The small batches of measurements, in stacks of batches of similar length."""
    for shared in measured.shared:
        many = shared.many
        for group in many.groups(np.flatnonzero(shared.pair >= 0)):
            places, valid = many.padded(group)
            of_A, of_B = (_rows(poses)[places] for poses in (many.A, many.B))
            of_A[~valid] = of_B[~valid] = 0.0
            sigmas, kappas = (each if each.ndim == 0 else each[places] for each in (many.sigma, many.kappa))
            yield Stack(shared.pair[group], of_A, of_B, valid / sigmas**2, valid * kappas)
    small = sorted((b for b in measured.batches if len(b[1].A) <= SMALL), key=lambda b: len(b[1].A), reverse=True)
    while small:
        longest = len(small[0][1].A)
        count = 1
        while count < len(small) and count * longest < STACK and len(small[count][1].A) >= FULL * longest:
            count += 1
        taken, small = small[:count], small[count:]
        filled = np.arange(longest) < np.array([len(raw.A) for _, raw in taken])[:, None]
        A: Array = np.zeros((count, longest, 12))
        B: Array = np.zeros((count, longest, 12))
        weight: Array = np.zeros((count, longest))
        kappa: Array = np.zeros((count, longest))
        A[filled] = _rows(np.concatenate([raw.A for _, raw in taken]))
        B[filled] = _rows(np.concatenate([raw.B for _, raw in taken]))
        weight[filled] = 1.0 / np.concatenate([raw.sigma for _, raw in taken]) ** 2
        kappa[filled] = np.concatenate([raw.kappa for _, raw in taken])
        yield Stack(np.array([pair for pair, _ in taken]), A, B, weight, kappa)


def _rows(T: Array) -> Array:
    """The first three rows of transforms (n, 4, 4), as (n, 12)."""
    return T.reshape(len(T), 16)[:, :12]


def weighted_sums(measured: Measured, coefficients: Coefficients) -> Sums:
    """Sum the products of residuals, and of features with residuals, over all measurements of each pair."""
    pairs = len(measured.a)
    outputs = coefficients.one.hi.shape[1]
    D = outputs // 12
    products: dict[int, list[Array]] = {}
    # In several directions only the sum over pairs and residuals counts: one product of matrices makes it.
    shape = (pairs, 1, 1, 12) if D == 1 else (1, D, D, 1)
    products_error = np.zeros(shape)
    tables: list[Array] = [np.zeros((pairs, 12, outputs)), np.zeros((pairs, 12, outputs)), np.zeros((pairs, outputs))]
    errors, sizes = ([np.zeros_like(table) for table in tables] for _ in range(2))
    for stack in stacks_of(measured):
        front, back = (stack.B, stack.A) if measured.is_swapped else (stack.A, stack.B)
        r, low = _residuals(stack.pairs, front, back, coefficients)
        A, off = _centred(stack, measured)
        front, back = (stack.B, A) if measured.is_swapped else (A, stack.B)
        k, m = stack.weight.shape
        is_once = len(np.unique(stack.pairs)) == k  # a pair may have several batches in a stack
        weights = np.empty((k, m, 12))
        weights[:, :, :9], weights[:, :, 9:] = stack.kappa[:, :, None], stack.weight[:, :, None]
        of_directions = r.reshape(k, m, D, 12)
        weighted = of_directions * weights[:, :, None, :]
        own = np.einsum("kmdo,kmdo->kdo", weighted, of_directions)
        flat = weighted.reshape(k, m, outputs)
        unit = gamma(m + _FEW)
        total = np.repeat(weights.sum(axis=1)[:, None, :], D, axis=1)  # (k, D, 12)
        # |r| has an error of low: by Cauchy and Schwarz each root of a sum of squares is off by sqrt(total) low.
        slack = np.sqrt(total) * low.reshape(k, D, 12)
        root = np.sqrt(np.maximum(own, 0.0)) * (1.0 + unit) + slack
        if D == 1:
            square, places = own[:, :, None], stack.pairs
            error = (unit * root * root + 2.0 * slack * root)[:, :, None]
        else:
            square, error = _together(weighted, of_directions, root, slack)
            places = np.zeros(1, dtype=int)
        one = flat.sum(axis=1)
        one_error = (np.sqrt(total) * (unit * root + slack)).reshape(k, outputs)
        front_reach, back_reach = np.abs(front).max(axis=1), np.abs(back).max(axis=1)
        of_size = (np.sqrt(total) * root).reshape(k, 1, outputs) * off[:, :, None]
        np.add.at(products_error, places, error)
        for pair, of_pair in zip(places.tolist(), square, strict=True):
            products.setdefault(pair, []).append(of_pair)
        new = (np.matmul(front.transpose(0, 2, 1), flat), np.matmul(back.transpose(0, 2, 1), flat), one)
        reaches = [front_reach[:, :, None] * one_error[:, None], back_reach[:, :, None] * one_error[:, None], one_error]
        reaches[int(measured.is_swapped)] += of_size
        for table, bound, size, value, reach in zip(tables, errors, sizes, new, reaches, strict=True):
            for total_of_pairs, of_stack in ((table, value), (bound, reach), (size, np.abs(value))):
                if is_once:
                    total_of_pairs[stack.pairs] += of_stack
                else:
                    np.add.at(total_of_pairs, stack.pairs, of_stack)
    # Blocks of one pair are added exactly, so a million measurements have no larger rounding error than one block.
    summed = np.zeros(shape)
    for pair, parts in products.items():
        if len(parts) == 1:
            summed[pair] = parts[0]
        else:
            columns = np.array(parts).reshape(len(parts), -1).T
            summed[pair] = np.reshape([fsum(column) for column in columns], shape[1:])
    blocks = gamma(2 + max((len(parts) for parts in products.values()), default=1))
    for bound, size in zip(errors, sizes, strict=True):
        bound += blocks * size
        bound *= 1.0 + 1e-9
    products_error += gamma(2) * np.abs(summed)
    products_error *= 1.0 + 1e-9
    return Sums(summed, products_error, tables[0], errors[0], tables[1], errors[1], tables[2], errors[2])


def _together(weighted: Array, residuals: Array, root: Array, slack: Array) -> tuple[Array, Array]:
    """Products of directions summed over a stack's measurements and residuals, and a bound on them: (1, D, D, 1) each.

    weighted, residuals (k, m, D, 12); root, slack (k, D, 12): the root of each sum of squares, and a bound on its
    error.
    """
    D = residuals.shape[2]
    left, right = (each.transpose(2, 0, 1, 3).reshape(D, -1) for each in (weighted, residuals))
    roots, slacks = (each.transpose(1, 0, 2).reshape(D, -1) for each in (root, slack))
    crossed = slacks @ roots.T
    error = gamma(left.shape[1] + _FEW) * (roots @ roots.T) + crossed + crossed.T
    return (left @ right.T).reshape(1, D, D, 1), error.reshape(1, D, D, 1)


def _centred(stack: Stack, measured: Measured) -> tuple[Array, Array]:
    """A with its translations about the gauge, t_A + R_A c - a, and a bound (k, 12) on their rounding."""
    k, m = stack.weight.shape
    A, a, c = stack.A.copy(), measured.a[stack.pairs], measured.c[stack.pairs]
    rows = A.reshape(k, m, 3, 4)
    rows[..., 3] += np.matmul(rows[..., :3], c[:, None, :, None])[..., 0] - a[:, None, :]
    rows[stack.weight == 0.0] = 0.0  # padding
    off = np.zeros((k, 3, 4))
    off[:, :, 3] = np.abs(stack.A.reshape(k, m, 3, 4)[..., 3]).max(axis=1) + np.abs(c).sum(axis=1)[:, None] + np.abs(a)
    return A, 8.0 * gamma(1) * off.reshape(k, 12)


def _residuals(
    pairs: np.ndarray, front_rows: Array, back_rows: Array, coefficients: Coefficients
) -> tuple[Array, Array]:
    """Residuals (k, m, 12 D), to their last digit and an absolute error of at most the second array (k, 12 D)."""
    front, back, one = (
        Doubled(c.hi[pairs], c.lo[pairs]) for c in (coefficients.front, coefficients.back, coefficients.one)
    )
    front_unit, back_unit = _feature_units(front_rows), _feature_units(back_rows)
    total = (front_unit[:, :, None] * np.abs(front.hi)).sum(axis=1)
    total += (back_unit[:, :, None] * np.abs(back.hi)).sum(axis=1) + np.abs(one.hi)
    top: Array = _power_above(total * (1.0 + 1e-9))
    result: Array = np.zeros((*front_rows.shape[:2], total.shape[1]))
    low = np.zeros_like(result)
    for x, unit, c in ((front_rows, front_unit, front), (back_rows, back_unit, back)):
        grid = top[:, None, :] * 2.0**-COEFFICIENT_BITS / unit[:, :, None]
        c_high = np.rint(c.hi / grid) * grid
        c_low = (c.hi - c_high) + c.lo
        step = (1.5 * 2.0 ** (52 - FEATURE_BITS) * unit)[:, None, :]  # its last bit is the slice's
        x_high = (x + step) - step
        result += np.matmul(x_high, c_high)
        low += np.matmul(x_high, c_low)
        low += np.matmul(x - x_high, c.hi)
    of_one = top * 2.0 ** -(FEATURE_BITS + COEFFICIENT_BITS)
    one_high = np.rint(one.hi / of_one) * of_one
    result += one_high[:, None, :]
    low += ((one.hi - one_high) + one.lo)[:, None, :]
    result += low
    return result, top * LOW_PART


def _feature_units(x: Array) -> Array:
    """A power of two (k, 12) that no feature of a batch exceeds."""
    return _power_above(np.abs(x).max(axis=1))


def _power_above(values: Array) -> Array:
    """For each value the smallest power of two that is not below it; 1 for zero."""
    mantissa, exponent = np.frexp(values)
    powers: Array = np.where(values > 0.0, np.ldexp(1.0, exponent - (mantissa == 0.5)), 1.0)
    return powers


#: With fewer measurements the exact sums are quick enough.
MANY = 10_000
#: Plain sums are used if the cost's relative error is below this: a hundredth of a percent of the tolerance.
KNOWN = 1e-10
#: A residual sums 24 products, a constant, and the low parts of its coefficients.
OPERATIONS = 30
#: Operations of a centred translation, and of weights and squares.
_FEW_MORE = 16
#: The square of an entry of a rotation that was not refused is at most this.
_OF_ROTATION = 1.0 + ROTATION_TOLERANCE
#: Where the translation is among a pose's twelve features.
_T = slice(3, 12, 4)


def plain_sums(measured: Measured, coefficients: Coefficients) -> Sums | None:
    """The sums for one direction; None for few measurements, or if sums in doubles are not accurate enough.

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
    """Pairs (k,) and the sums over one batch of each pair; small batches come many at once."""
    of_A, of_B = of_A_and_B
    for stack in small_stacks(measured):
        at = stack.pairs
        yield at, _BatchSums.of_stack(stack, of_A[at], of_B[at], one[at], measured.a[at], measured.c[at])
    for pair, raw in measured.batches:
        if len(raw.A) > SMALL:
            own = _BatchSums.of(raw, of_A[pair], of_B[pair], one[pair], measured.a[pair], measured.c[pair])
            yield np.array([pair]), own


def _wide(of_A: Array, of_B: Array, one: Array, a: Array, c: Array) -> tuple[Array, Array, Array]:
    """Matrices from A, from B and from 1 to the columns [12 residuals, t_A + R_A c - a, t_A, t_B, 1] of k pairs."""
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
        """One pass over a batch, with few products of wide matrices: operations on narrow ones take as long."""
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
        """The sums over small batches of k pairs; padding has weight zero."""
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
        """The sums from the weighted products of all columns, (k, 22, 22) for each kind of weight."""
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
        unit = gamma(min(BLOCK, self.count) + -(-self.count // BLOCK) + _FEW_MORE)
        root = np.sqrt(self.square) * up + slack
        error = unit * root * root + 2.0 * slack * root
        off = unit * root + slack
        by_A, A_error = self.by_A.copy(), A_size * off[:, None, :]
        reach = np.abs(c).sum(axis=1)[:, None] + np.abs(a)
        of_centring = 8.0 * gamma(1) * (of_A_t + reach[:, :, None] * of_ones[:, None, :])
        by_A[:, _T] = self.by_t
        A_error[:, _T] = of_t * off[:, None, :] + of_centring * root[:, None, :]
        return self.square, error, (by_A, A_error), (self.by_B, B_size * off[:, None, :]), (self.one, of_ones * off)
