"""Symmetric block-sparse matrices of a graph: a block for each frame and each coupling, and a dense tail.

Cholesky factorisation in the order of `elimination`. Frames that are eliminated together are stacks of small matrices,
so the loops run inside numpy and BLAS. Each entry of the factor is the textbook's sum, in some order of summation, so
the textbook's rounding bounds hold (`verified`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg
from scipy.sparse import csr_array

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.rounding import UNIT
from gtsam_rwhec.solver.elimination import Elimination, Group

#: At most this many numbers are processed at once: 8 MB.
AT_ONCE = 1_000_000
#: Up to this many numbers are summed one by one.
FEW_NUMBERS = 4096
#: At most this many indices are checked for repetition; a dense matrix up to this size is multiplied as one array.
FEW_ROWS = 64
#: `AT_ONCE` for frames with the same neighbours: these numbers fit in the processor's cache.
ALIKE_AT_ONCE = 100_000


@dataclass(frozen=True)
class BlockMatrix:
    """frames (n, m, m) and couplings (F, m, m) of an order's given couplings, tails (n, m, q), tail (q, q)."""

    order: Elimination
    frames: Array
    couplings: Array
    tails: Array
    tail: Array

    @property
    def size(self) -> int:
        """n m + q."""
        n, m, q = self.tails.shape
        return int(n * m + q)

    @property
    def diagonal(self) -> Array:
        """(n m + q,)."""
        return np.append(np.einsum("nii->ni", self.frames), np.diagonal(self.tail))

    @property
    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """The frames of each coupling."""
        return self.order.first[: self.order.given], self.order.second[: self.order.given]

    def plus(self, diagonal: Array) -> BlockMatrix:
        """The matrix with a diagonal (n m + q,) added."""
        n, m, _ = self.tails.shape
        frames, tail = self.frames.copy(), self.tail.copy()
        np.einsum("nii->ni", frames)[...] += diagonal[: n * m].reshape(n, m)
        np.einsum("ii->i", tail)[...] += diagonal[n * m :]
        return replace(self, frames=frames, tail=tail)

    def scaled(self, unit: Array) -> BlockMatrix:
        """diag(unit) A diag(unit)."""
        n, m, _ = self.tails.shape
        of_frames, of_tail = unit[: n * m].reshape(n, m), unit[n * m :]
        first, second = self.ends
        return replace(
            self,
            frames=self.frames * of_frames[:, :, None] * of_frames[:, None, :],
            couplings=self.couplings * of_frames[first][:, :, None] * of_frames[second][:, None, :],
            tails=self.tails * of_frames[:, :, None] * of_tail,
            tail=self.tail * of_tail[:, None] * of_tail,
        )

    def congruent(self, T: Array) -> BlockMatrix:
        """T_i' A_ij T_j for bases T (n, m, l) of the frames."""
        first, second = self.ends
        Tt = T.transpose(0, 2, 1)
        couplings = np.empty((len(first), T.shape[2], T.shape[2]))
        for at in self._portions():
            couplings[at] = Tt[first[at]] @ self.couplings[at] @ T[second[at]]
        return replace(self, frames=Tt @ self.frames @ T, couplings=couplings, tails=Tt @ self.tails)

    def _portions(self) -> Iterator[slice]:
        """Slices of the couplings, short enough that the arrays computed from one slice fit in memory."""
        step = max(1, AT_ONCE // max(self.frames.shape[1] ** 2, 1))
        return (slice(begin, begin + step) for begin in range(0, len(self.couplings), step))

    def times(self, v: Array) -> Array:
        """A v for v (n m + q,) or columns (n m + q, D), in the precision of v."""
        return self._product(v, absolute=False)

    def sizes(self, v: Array) -> Array:
        """|A| |v|."""
        return self._product(np.abs(v), absolute=True)

    def _product(self, v: Array, *, absolute: bool) -> Array:
        def of(blocks: Array) -> Array:
            return (np.abs(blocks) if absolute else blocks).astype(v.dtype, copy=False)

        if self.order.is_dense and self.size <= FEW_ROWS:
            return np.asarray(of(self._whole) @ v)
        n, m, q = self.tails.shape
        columns, D = (v[:, None], 1) if v.ndim == 1 else (v, v.shape[1])
        of_frames, of_tail, tails = columns[: n * m].reshape(n, m, D), columns[n * m :], of(self.tails)
        result = np.matmul(of(self.frames), of_frames) + tails @ of_tail
        # of no frames einsum gives nan in extended precision, and this zero
        last = of(self.tail) @ of_tail + tails.reshape(n * m, q).T @ columns[: n * m]
        first, second = self.ends
        for at in self._portions():
            blocks = of(self.couplings[at])
            sum_into(result, first[at], np.matmul(blocks, of_frames[second[at]]))
            sum_into(result, second[at], np.matmul(blocks.transpose(0, 2, 1), of_frames[first[at]]))
        return np.concatenate([result.reshape(n * m, D), last]).reshape(v.shape)

    @cached_property
    def _whole(self) -> Array:
        """`dense`, for products with several vectors."""
        return self.dense()

    def dense(self) -> Array:
        """As one array; for small matrices."""
        n, m, _ = self.tails.shape
        full = np.zeros((self.size, self.size))
        blocks = full[: n * m, : n * m].reshape(n, m, n, m).transpose(0, 2, 1, 3)
        at, (first, second) = np.arange(n), self.ends
        blocks[at, at] = self.frames
        blocks[first, second] = self.couplings
        blocks[second, first] = self.couplings.transpose(0, 2, 1)
        full[: n * m, n * m :] = self.tails.reshape(n * m, len(self.tail))
        full[n * m :, : n * m] = full[: n * m, n * m :].T
        full[n * m :, n * m :] = self.tail
        return full

    def factor(self) -> BlockFactor | None:
        """The Cholesky factor; None when a pivot is not a positive, finite number."""
        if self.order.is_dense:
            n, m, q = self.tails.shape
            rest = dense_factor(self.dense().T)
            return None if rest is None else BlockFactor(self.order, (n, m, q), [], [], rest)
        factorisation = _Factorisation(self)
        rest = factorisation.run(keep=True)
        if rest is None:
            return None
        return BlockFactor(self.order, factorisation.shape, factorisation.lower, factorisation.rows, rest)

    def has_factor(self) -> bool:
        """Whether the Cholesky factor exists; the factor itself is not kept."""
        return _Factorisation(self).run(keep=False) is not None


@dataclass(frozen=True)
class BlockFactor:
    """The Cholesky factor: for each group of the order the frames' factors and rows, and that of the dense rest."""

    order: Elimination
    shape: tuple[int, int, int]
    frames: list[Array]
    rows: list[Array]
    rest: Array

    @property
    def pivots(self) -> Array:
        """(n m + q,): the diagonal of the factor."""
        n, m, q = self.shape
        result = np.empty((n, m))
        for group, lower in zip(self.order.groups, self.frames, strict=True):
            result[group.frames] = np.einsum("kii->ki", lower)
        last = np.diagonal(self.rest)
        result[self.order.rest] = last[: len(last) - q].reshape(-1, m)
        return np.append(result.ravel(), last[len(last) - q :])

    def solve_vector(self, v: Array) -> Array:
        """Solve L L' x = v (n m + q,)."""
        return self.solve(v[:, None])[:, 0]

    def solve(self, v: Array) -> Array:
        """Solve L L' x = v (n m + q, c)."""
        if self.order.is_dense:
            return np.asarray(scipy.linalg.lapack.dpotrs(self.rest, v, lower=1)[0])
        n, m, q = self.shape
        c = v.shape[1]
        x = np.zeros((n + 1, m, c))
        x[:n] = v[: n * m].reshape(n, m, c)
        tail = v[n * m :].copy()
        for group, lower, rows in zip(self.order.groups, self.frames, self.rows, strict=True):
            y = forward_substitution(lower, x[group.frames])
            x[group.frames] = y
            passed = np.matmul(rows.transpose(0, 2, 1), y)
            k, d = group.neighbours.shape
            sum_into(x, group.neighbours.ravel(), passed[:, : d * m].reshape(k * d, m, c), -1.0)
            x[n] = 0.0
            tail -= passed[:, d * m :].sum(axis=0)
        rest = np.concatenate([x[self.order.rest].reshape(-1, c), tail])
        rest = scipy.linalg.lapack.dpotrs(self.rest, rest, lower=1)[0] if len(rest) else rest
        x[self.order.rest], tail = rest[: len(rest) - q].reshape(-1, m, c), rest[len(rest) - q :]
        for group, lower, rows in zip(
            reversed(self.order.groups), reversed(self.frames), reversed(self.rows), strict=True
        ):
            k, d = group.neighbours.shape
            known = np.concatenate([x[group.neighbours].reshape(k, d * m, c), np.broadcast_to(tail, (k, q, c))], axis=1)
            x[group.frames] = backward_substitution(lower, x[group.frames] - np.matmul(rows, known))
        return np.concatenate([x[:n].reshape(n * m, c), tail])


class _Factorisation:
    """The part of a matrix that is not eliminated yet, during the factorisation."""

    def __init__(self, matrix: BlockMatrix) -> None:
        self.matrix, self.order = matrix, matrix.order
        n, m, q = matrix.tails.shape
        self.shape = n, m, q
        self.lower: list[Array] = []
        self.rows: list[Array] = []
        # One extra row: sums for the index "no frame" go there.
        self.frames = np.concatenate([matrix.frames, np.zeros((1, m, m))])
        self.tails = np.concatenate([matrix.tails, np.zeros((1, m, q))])
        self.tail = matrix.tail.copy()
        self.changes = np.zeros((self.order.number_changed + 1, m, m))
        #: The place of each coupling among the changed ones; the last entry is for "no coupling".
        last = self.order.number_changed
        self.place = np.append(np.where(self.order.changed < len(self.order.changed), self.order.changed, last), last)

    def run(self, *, keep: bool) -> Array | None:
        """The factor of the dense rest; the other parts, where they are kept, are ``lower`` and ``rows``."""
        _, m, q = self.shape
        try:
            for group in self.order.groups:
                lower = np.linalg.cholesky(self.frames[group.frames])
                if not np.isfinite(np.einsum("kii->ki", lower)).all():
                    return None
                k, d = group.neighbours.shape
                of_group = np.empty((k if keep else 0, m, d * m + q))
                for at in _portions(group, m * d + q):
                    rows = forward_substitution(lower[at], self._couplings(group, at))
                    self._take_off(group, at, rows)
                    if keep:
                        of_group[at] = rows
                if keep:
                    self.lower.append(lower)
                    self.rows.append(of_group)
            rest = self._dense_rest()
            del self.changes, self.frames
        except np.linalg.LinAlgError:
            return None
        return dense_factor(rest)

    def _blocks(self, edges: np.ndarray) -> Array:
        """Couplings (k,) as they are now, (k, m, m); one past the last for none."""
        order = self.order
        result: Array = self.changes[self.place[edges]]
        given = np.flatnonzero(edges < order.given)
        result[given] += self.matrix.couplings[edges[given]]
        return result

    def _couplings(self, group: Group, at: slice) -> Array:
        """The off-diagonal rows (k, m, d m + q) of a group's frames."""
        _, m, q = self.shape
        edges, flipped = group.edges[at], group.flipped[at]
        k, d = edges.shape
        blocks = self._blocks(edges.ravel())
        turned = flipped.ravel()
        blocks[turned] = blocks[turned].transpose(0, 2, 1)
        result = np.empty((k, m, d * m + q))
        result[:, :, : d * m].reshape(k, m, d, m)[...] = blocks.reshape(k, d, m, m).transpose(0, 2, 1, 3)
        result[:, :, d * m :] = self.tails[group.frames[at]]
        return result

    def _take_off(self, group: Group, at: slice, rows: Array) -> None:
        """Subtract the update that the elimination of frames makes to the blocks of their neighbours."""
        _, m, q = self.shape
        neighbours = group.neighbours[at]
        d = neighbours.shape[1]
        if group.are_alike:
            neighbours = neighbours[:1]
            flat = rows.reshape(len(rows) * m, d * m + q)
            square = (flat.T @ flat)[None]
        else:
            square = np.matmul(rows.transpose(0, 2, 1), rows)
        k = len(square)
        blocks = square[:, : d * m, : d * m].reshape(k, d, m, d, m)
        each = np.arange(d)
        sum_into(self.frames, neighbours.ravel(), blocks[:, each, :, each].swapaxes(0, 1).reshape(k * d, m, m), -1.0)
        sum_into(self.tails, neighbours.ravel(), square[:, : d * m, d * m :].reshape(k * d, m, q), -1.0)
        self.tail -= square[:, d * m :, d * m :].sum(axis=0)
        a, b = np.triu_indices(d, 1)
        if len(a):
            edges = self.order.couplings_of(neighbours[:, a], neighbours[:, b])
            pairs = blocks[:, a, :, b].swapaxes(0, 1).reshape(-1, m, m)
            sum_into(self.changes, self.place[edges].ravel(), pairs, -1.0)

    def _dense_rest(self) -> Array:
        """The frames that are left, and the tail, as one array in Fortran's order: (r m + q, r m + q)."""
        _, m, q = self.shape
        order, rest = self.order, self.order.rest
        r = len(rest)
        full = np.zeros((r * m + q, r * m + q))
        place = np.full(order.n, -1)
        place[rest] = np.arange(r)
        inside = np.flatnonzero((place[order.first] >= 0) & (place[order.second] >= 0))
        blocks = full[: r * m, : r * m].reshape(r, m, r, m).transpose(0, 2, 1, 3)
        blocks[np.arange(r), np.arange(r)] = self.frames[rest]
        blocks[place[order.first[inside]], place[order.second[inside]]] = self._blocks(inside)
        full[: r * m, r * m :] = self.tails[rest].reshape(r * m, q)
        full[r * m :, r * m :] = self.tail
        return full.T  # only the lower triangle of this is read


def dense_factor(matrix: Array) -> Array | None:
    """The Cholesky factor of a matrix in Fortran's order, in its place; None where a pivot is not positive, finite."""
    factor, failed = scipy.linalg.lapack.dpotrf(matrix, lower=1, clean=1, overwrite_a=1)
    # LAPACK may let NaN and infinity pass as pivots; the diagonal then has them.
    return None if failed or not np.isfinite(np.diagonal(factor)).all() else np.asarray(factor)


def _portions(group: Group, width: int) -> Iterator[slice]:
    """Slices of a group's frames, short enough that the arrays computed from one slice fit in memory."""
    count, m = len(group.frames), 13
    step = ALIKE_AT_ONCE // (m * max(width, 1)) if group.are_alike else AT_ONCE // max(width * width, 1)
    step = max(1, step)
    return (slice(begin, begin + step) for begin in range(0, count, step))


def sum_into(result: Array, index: np.ndarray, values: Array, factor: float = 1.0) -> None:
    """Add ``factor`` times each of the values (k, ...) to the row of ``result`` that ``index`` (k,) names.

    Rows may be named more than once.
    """
    k = len(index)
    if k <= FEW_ROWS and len(set(index.tolist())) == k:
        result[index] += factor * values if factor != 1.0 else values
        return
    if values.size <= FEW_NUMBERS:
        np.add.at(result, index, factor * values if factor != 1.0 else values)
        return
    order = np.argsort(index, kind="stable")
    sorted_index = index[order]
    begin = np.flatnonzero(np.append(True, sorted_index[1:] != sorted_index[:-1]))
    rows = sorted_index[begin]
    sums = csr_array((np.full(k, factor), order, np.append(begin, k)), shape=(len(rows), k)) @ values.reshape(k, -1)
    result[rows] += sums.reshape(len(rows), *values.shape[1:])


#: Added to a bound, to cover underflow: underflow loses less than this.
_TINY = 1e-290


def cholesky_allowance(matrix: BlockMatrix, diagonal: Array) -> Array:
    """A bound on the rounding in the factorisation of a matrix with this graph and diagonal, as a diagonal matrix."""
    _, m, q = matrix.tails.shape
    of_frames, of_tail = matrix.order.spread(m, q)
    return np.append(np.repeat(of_frames, m), np.full(q, of_tail)) * np.abs(diagonal) + _TINY


def proof_that_it_exceeds(matrix: BlockMatrix, margin: Array | float = 0.0) -> BlockFactor | None:
    """The proof that a matrix, exactly as stored, minus diag(margin) is positive definite: the factor of a smaller one.

    None proves nothing. A negative margin makes a weaker test.
    """
    return _smaller(matrix, margin).factor()


def is_proven_to_exceed(matrix: BlockMatrix, margin: Array | float = 0.0) -> bool:
    """Whether this proof succeeds; its factor is not kept."""
    return _smaller(matrix, margin).has_factor()


def _smaller(matrix: BlockMatrix, margin: Array | float) -> BlockMatrix:
    diagonal = matrix.diagonal
    # The subtraction rounds by at most u times its result.
    reach = np.abs(diagonal) + np.abs(margin)
    return matrix.plus(-(margin + cholesky_allowance(matrix, reach) + 4.0 * UNIT * reach))


def forward_substitution(lower: Array, right: Array) -> Array:
    """Solve lower y = right for stacks (L, m, m) and (L, m, c): each row of all L systems at once."""
    y = np.empty_like(right)
    for i in range(lower.shape[1]):
        row = right[:, i, :]
        if i:
            row = row - np.matmul(lower[:, i, None, :i], y[:, :i, :])[:, 0]
        y[:, i, :] = row / lower[:, i, i, None]
    return y


def backward_substitution(lower: Array, right: Array) -> Array:
    """Solve lower' y = right for stacks."""
    y = np.empty_like(right)
    m = lower.shape[1]
    for i in reversed(range(m)):
        row = right[:, i, :]
        if i + 1 < m:
            row = row - np.matmul(lower[:, i + 1 :, i][:, None, :], y[:, i + 1 :, :])[:, 0]
        y[:, i, :] = row / lower[:, i, i, None]
    return y
