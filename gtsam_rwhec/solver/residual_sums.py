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

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.rounding import Doubled, gamma
from gtsam_rwhec.problem.measurements import Measurements
from gtsam_rwhec.solver.block_matrix import sum_into
from gtsam_rwhec.solver.directed_pairs import DirectedPair
from gtsam_rwhec.solver.parts import SMALL, Shared

#: This many measurements are evaluated exactly at once: the slices of a block stay in the processor's cache.
BLOCK = 1024
#: A stack of small batches has about this many measurements, and a block in plain doubles: for fewer the calls take
#: longer than the arithmetic.
STACK = 4096
#: Batches in one stack have at least this part of its longest batch, so that little is padding.
FULL = 0.6
#: Bits of a feature's high slice.
FEATURE_BITS = 24
#: Bits of a coefficient's high slice. Products of 52 bits leave one bit for the rounding of the slices.
COEFFICIENT_BITS = 28
#: The low slices' products round by less than this part of the largest sum of terms.
LOW_PART = 2.0**-70
#: Sums of three products of doubled numbers round by less than this part of the largest.
DOUBLED = 2.0**-95
#: Operations of a residual's last sum, its weight, and its square.
_FEW = 12
#: The kind of weight of each residual, kappa or 1 / sigma^2.
_KINDS = np.repeat(np.eye(2), (9, 3), axis=1)
#: Where the translation is among a pose's twelve features.
_T = slice(3, 12, 4)
#: Operations of a residual in plain doubles: 24 products, a constant, and the low parts of its coefficients.
OPERATIONS = 30
#: From this many measurements on, sums of plain doubles are tried first: the exact ones take longer.
MANY = 10_000
#: Plain sums are used if the cost's relative error is below this: a hundredth of a percent of the tolerance.
KNOWN = 1e-10


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
    directed: tuple[DirectedPair, slice] | None = None  #: whose weights they have, where these differ by direction


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
    directed: Sequence[tuple[int, DirectedPair]] = ()  #: those that weigh by direction

    @property
    def count(self) -> int:
        """The number of measurements."""
        of_shared = (int(each.many.counts[each.pair >= 0].sum()) for each in self.shared)
        of_batches = [len(raw.A) for _, raw in self.batches] + [each.count for _, each in self.directed]
        return sum(of_batches) + sum(of_shared)


@dataclass(frozen=True)
class Sums:
    """Weighted sums over the measurements of each pair, each with a bound on its rounding.

    ``products``: of products of residuals in two directions; (E, 1, 1, 12) for one direction, and for several the sum
    over pairs and residuals, (1, D, D, 1). ``by_features``: of features times residuals, for the features [R | t] of
    the front and of the back pose, with the translations of A about the gauge, (E, 12, 12 D) each, and for one
    (E, 12 D).
    """

    products: Array
    products_error: Array
    by_features: list[Array]
    by_features_error: list[Array]


def stacks_of(measured: Measured, block: int = BLOCK) -> Iterator[Stack]:
    """The measurements in stacks, those of long batches in blocks."""
    yield from small_stacks(measured)
    for pair, directed in measured.directed:
        for first in range(0, directed.count, block):
            part = slice(first, min(first + block, directed.count))
            A, B = (_rows(poses[part])[None] for poses in (directed.A, directed.B))
            one = np.ones(A.shape[:2])
            yield Stack(np.array([pair]), A, B, one, one, (directed, part))
    for pair, raw in measured.batches:
        if len(raw.A) <= SMALL:
            continue
        for first in range(0, len(raw.A), block):
            part = slice(first, first + block)
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

        def padded(values: Array, filled: np.ndarray = filled) -> Array:
            result = np.zeros((*filled.shape, *values.shape[1:]))
            result[filled] = values
            return result

        A, B, sigma, kappa = (
            np.concatenate([getattr(raw, name) for _, raw in taken]) for name in ("A", "B", "sigma", "kappa")
        )
        pairs = np.array([pair for pair, _ in taken])
        yield Stack(pairs, padded(_rows(A)), padded(_rows(B)), padded(1.0 / sigma**2), padded(kappa))


def _rows(T: Array) -> Array:
    """The first three rows of transforms (n, 4, 4), as (n, 12)."""
    return T.reshape(len(T), 16)[:, :12]


def cost_sums(measured: Measured, coefficients: Coefficients) -> Sums:
    """The sums for one direction, in plain doubles where there are many measurements and these are accurate enough."""
    if measured.count >= MANY:
        plain = weighted_sums(measured, coefficients, exact=False)
        if plain.products_error.sum() <= KNOWN * plain.products.sum():
            return plain
    return weighted_sums(measured, coefficients)


def weighted_sums(measured: Measured, coefficients: Coefficients, *, exact: bool = True) -> Sums:
    """Sum the products of residuals, and of features with residuals, over all measurements of each pair.

    Without ``exact`` the residuals are rounded as doubles are, and their bounds are larger.
    """
    pairs, outputs = coefficients.one.hi.shape
    D = outputs // 12
    # In several directions only the sum over pairs and residuals counts: one product of matrices makes it.
    shapes = (pairs, 1, 1, 12) if D == 1 else (1, D, D, 1), (pairs, 12, outputs), (pairs, 12, outputs), (pairs, outputs)
    tables, errors, sizes = ([np.zeros(shape) for shape in shapes] for _ in range(3))
    number = 0
    for stack in stacks_of(measured, BLOCK if exact else STACK):
        number += 1
        of_A_and_B = slice(None, None, -1 if measured.is_swapped else 1)
        front, back = (stack.A, stack.B)[of_A_and_B]
        (r, rest), low = _residuals(stack.pairs, front, back, coefficients, exact=exact)
        A, off = _centred(stack, measured)
        k, m = stack.weight.shape
        if stack.directed is None:
            r = r if rest is None else r + rest
            weights: Array = np.stack([stack.kappa, stack.weight], axis=2) @ _KINDS
        else:
            directed, part = stack.directed
            rounded: Array = (low + DOUBLED * _reach(r)) * (1.0 + 1e-9)
            low = np.reshape(directed.reach(part, rounded.reshape(k, D, 12)), (k, outputs))
            r, weights = directed.turned(part, r, rest), directed.weights(part)[None]
        residuals = r.reshape(k, m, D, 12)
        weighted = residuals * weights[:, :, None, :]
        flat: Array = weighted.reshape(k, m, outputs)
        unit = gamma(m + _FEW)
        of_ones = np.sqrt(np.ones(m) @ weights)[:, None, :]
        # |r| has an error of low: by Cauchy and Schwarz each root of a sum of squares is off by sqrt(total) low.
        slack = of_ones * low.reshape(k, D, 12)
        own = np.einsum("kmdo,kmdo->kdo", weighted, residuals)
        root = np.sqrt(np.maximum(own, 0.0)) * (1.0 + unit) + slack
        if D == 1:
            square, places = own[:, :, None], stack.pairs
            error = (unit * root * root + 2.0 * slack * root)[:, :, None]
        else:
            square, error = _together(weighted, residuals, root, slack)
            places = np.zeros(1, dtype=int)
        in_rows, rows_error = of_ones * root, of_ones * (unit * root + slack)
        if stack.directed is not None:
            flat = directed.turned_back(part, flat)
            grown: Array = (rows_error + gamma(_FEW + 12) * in_rows) * (1.0 + 1e-9)
            rows_error, in_rows = directed.reach_back(part, grown), directed.reach_back(part, in_rows)
        one_size, one_error = in_rows.reshape(k, 1, outputs), rows_error.reshape(k, 1, outputs)
        of_poses, of_errors = [], []
        for poses, rounding in ((A, off), (stack.B, np.zeros((k, 12))))[of_A_and_B]:
            of_poses.append(np.matmul(poses.transpose(0, 2, 1), flat))
            reach = _reach(poses)[:, :, None] * one_error
            of_errors.append(reach + rounding[:, :, None] * one_size)
        values, bounds = (square, *of_poses, np.ones(m) @ flat), (error, *of_errors, one_error[:, 0])
        rows = places, *[stack.pairs] * 3
        for at, table, bound, size, value, of_value in zip(rows, tables, errors, sizes, values, bounds, strict=True):
            for whole, of_stack in ((table, value), (bound, of_value), (size, np.abs(value))):
                sum_into(whole, at, of_stack)
    for bound, size in zip(errors, sizes, strict=True):
        bound += gamma(number + 2) * size
        bound *= 1.0 + 1e-9
    return Sums(tables[0], errors[0], tables[1:], errors[1:])


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
    k = len(stack.pairs)
    A, a, c = stack.A.copy(), measured.a[stack.pairs], measured.c[stack.pairs]
    turned = np.zeros((k, 12, 3))
    for i in range(3):
        turned[:, 4 * i : 4 * i + 3, i] = c
    is_filled = stack.weight[:, :, None] > 0.0  # and no padding
    A[:, :, _T] += (np.matmul(stack.A, turned) - a[:, None, :]) * is_filled
    off = np.zeros((k, 12))
    off[:, _T] = _reach(stack.A[:, :, _T]) + np.abs(c).sum(axis=1)[:, None] + np.abs(a)
    return A, 8.0 * gamma(1) * off


def _residuals(
    pairs: np.ndarray, front_rows: Array, back_rows: Array, coefficients: Coefficients, *, exact: bool
) -> tuple[tuple[Array, Array | None], Array]:
    """Residuals (k, m, 12 D) as sums of two doubles, right to an absolute error of at most the last array (k, 12 D)."""
    front, back, one = (
        Doubled(c.hi[pairs], c.lo[pairs]) for c in (coefficients.front, coefficients.back, coefficients.one)
    )
    front_unit, back_unit = _feature_units(front_rows), _feature_units(back_rows)
    total = (front_unit[:, :, None] * np.abs(front.hi)).sum(axis=1)
    total += (back_unit[:, :, None] * np.abs(back.hi)).sum(axis=1) + np.abs(one.hi)
    total *= 1.0 + 1e-9
    if not exact:
        plain = np.matmul(front_rows, front.hi) + np.matmul(back_rows, back.hi) + one.hi[:, None, :]
        return (plain, None), gamma(OPERATIONS) * total
    top: Array = _power_above(total)
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
    return (result, low), top * LOW_PART


def _feature_units(x: Array) -> Array:
    """A power of two (k, 12) that no feature of a batch exceeds."""
    return _power_above(_reach(x))


def _reach(x: Array) -> Array:
    """The largest absolute value of each feature, (k, f) of (k, m, f): quick along contiguous numbers."""
    result: Array = np.abs(np.ascontiguousarray(x.transpose(0, 2, 1))).max(axis=2)
    return result


def _power_above(values: Array) -> Array:
    """For each value the smallest power of two that is not below it; 1 for zero."""
    mantissa, exponent = np.frexp(values)
    return np.where(values > 0.0, np.ldexp(1.0, exponent - (mantissa == 0.5)), 1.0)
