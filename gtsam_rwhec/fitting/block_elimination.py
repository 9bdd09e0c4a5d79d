"""Matrices in which nothing ties many small blocks to one another: which these are, and the inverse that they give.

With the blocks D (block diagonal), the rest R, and B between them, S = R - B' D^-1 B, and the inverse is

    [D^-1 0; 0 0] + U S^-1 U',    U = [-D^-1 B; 1]
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg.lapack import dpotri

from gtsam_rwhec.geometry.poses import Array

#: Smaller matrices are inverted as a whole.
SMALL = 120


@dataclass(frozen=True)
class EliminationOrder:
    """Which parameters are eliminated at once, before the rest."""

    #: (n, w): n blocks of w parameters, which nothing ties to one another.
    blocks: np.ndarray

    @staticmethod
    def of(matrix: Array) -> EliminationOrder:
        """For matrices (d, d) that are zero where this one is; its parameters with the same ties are blocks."""
        best = np.zeros((0, 1), dtype=np.int64)
        if len(matrix) <= SMALL:
            return EliminationOrder(best)
        tied = (matrix != 0.0) | np.eye(len(matrix), dtype=bool)
        alike: dict[bytes, list[int]] = {}
        for i, ties in enumerate(np.packbits(tied, axis=1)):
            alike.setdefault(ties.tobytes(), []).append(i)
        blocks = list(alike.values())
        first = [block[0] for block in blocks]
        neighbours = tied[np.ix_(first, first)]
        np.fill_diagonal(neighbours, val=False)
        widths = np.array([len(block) for block in blocks])
        fewest_first = np.argsort(neighbours.sum(axis=1), kind="stable")
        for width in np.unique(widths):
            found, is_free = [], widths == width
            for number in fewest_first:
                if is_free[number]:
                    found.append(blocks[number])
                    is_free &= ~neighbours[number]
            if len(found) > 1 and len(found) * width > best.size:
                best = np.array(found)
        return EliminationOrder(best)

    def split(self, matrix: Array) -> Arrow:
        """A matrix (d, d) of this pattern."""
        own, others = self.blocks, np.delete(np.arange(len(matrix)), self.blocks.ravel())
        alone, ties = matrix[own[:, :, None], own[:, None]], matrix[own[:, :, None], others]
        return Arrow(own, others, alone, ties, matrix[others[:, None], others])

    def inverse(self, matrix: Array) -> tuple[Array, float]:
        """The inverse of a matrix of this pattern, and log|matrix|; LinAlgError if it is not positive definite."""
        if not self.blocks.size:
            L = np.linalg.cholesky(matrix)
            return _inverse_of(L), 2.0 * float(np.log(np.diagonal(L)).sum())
        inverse = self.split(matrix).inverse()
        own, across = self.blocks, inverse.across
        flat, others = own.ravel(), inverse.of.others
        result = np.empty_like(matrix)
        result[:, others] = across
        result[others[:, None], flat] = across[flat].T
        result[flat[:, None], flat] = across[flat] @ inverse.through[flat].T
        result[own[:, :, None], own[:, None]] += inverse.alone
        return result, inverse.log_det


def _inverse_of(L: Array) -> Array:
    """(L L')^-1 of a Cholesky factor (m, m)."""
    upper = dpotri(L.T, lower=0)[0] if len(L) else L  # its lower triangle is zero, as that of L'
    found: Array = upper + upper.T
    np.fill_diagonal(found, np.diagonal(upper))
    return found


@dataclass(frozen=True, eq=False)
class Arrow:
    """A symmetric matrix of blocks and the rest."""

    #: (n, w) and (m,): Their parameters.
    blocks: np.ndarray
    others: np.ndarray
    #: (n, w, w), (n, w, m) and (m, m): The blocks' own, between them and the rest, and the rest's.
    alone: Array
    ties: Array
    rest: Array

    def __add__(self, other: Arrow) -> Arrow:
        """The sum with a matrix of the same blocks."""
        return replace(self, alone=self.alone + other.alone, ties=self.ties + other.ties, rest=self.rest + other.rest)

    def inverse(self) -> ArrowInverse:
        """LinAlgError if it is not positive definite."""
        L = np.linalg.cholesky(self.alone)
        alone = np.linalg.inv(self.alone)
        flat, m = self.blocks.ravel(), len(self.others)
        through = np.empty((len(flat) + m, m))
        through[self.blocks], through[self.others] = -(alone @ self.ties), np.eye(m)
        L_rest = np.linalg.cholesky(self.rest + self.ties.reshape(len(flat), m).T @ through[flat])
        diagonal = np.r_[np.diagonal(L, axis1=1, axis2=2).ravel(), np.diagonal(L_rest)]
        return ArrowInverse(self, alone, through, L_rest, 2.0 * float(np.log(diagonal).sum()))


@dataclass(frozen=True, eq=False)
class ArrowInverse:
    """The inverse; d parameters."""

    of: Arrow
    #: (n, w, w) and (d, m): D^-1 and U.
    alone: Array
    through: Array
    #: (m, m): The Cholesky factor of S.
    L_rest: Array
    #: log|matrix|.
    log_det: float

    @cached_property
    def across(self) -> Array:
        """The columns (d, m) of the rest."""
        flat, of_rest = self.of.blocks.ravel(), _inverse_of(self.L_rest)
        found = np.empty_like(self.through)
        found[self.of.others], found[flat] = of_rest, self.through[flat] @ of_rest
        return found

    @cached_property
    def diagonal(self) -> Array:
        """Its diagonal (d,)."""
        found: Array = (self.across * self.through).sum(axis=1)
        found[self.of.blocks] += np.diagonal(self.alone, axis1=1, axis2=2)
        return found

    def at(self, rows: np.ndarray, columns: np.ndarray) -> Array:
        """Its entries (..., r, c) at rows (..., r) and columns (..., c)."""
        n, w = self.of.blocks.shape
        block, within = np.full(len(self.through), n), np.zeros(len(self.through), dtype=np.int64)
        block[self.of.blocks], within[self.of.blocks] = np.arange(n)[:, None], np.arange(w)
        alone = np.concatenate([self.alone, np.zeros((1, w, w))])  # the rest has none
        rows, columns = rows[..., None], columns[..., None, :]
        same = np.where(block[rows] == block[columns], block[rows], n)
        found: Array = self.across[rows[..., 0]] @ np.swapaxes(self.through[columns[..., 0, :]], -1, -2)
        found += alone[same, within[rows], within[columns]]
        return found

    def between(self, rows: np.ndarray, columns: np.ndarray) -> Array:
        """Those entries, without `at`'s products, where all rows or all columns are of the rest."""
        place = np.full(len(self.through), -1)
        place[self.of.others] = np.arange(len(self.of.others))
        rows, columns = rows[..., None], columns[..., None, :]
        is_column = (place[columns] >= 0).all()
        found: Array = self.across[rows, place[columns]] if is_column else self.across[columns, place[rows]]
        return found

    def times(self, vector: Array) -> Array:
        """Its product (d,) with a vector."""
        blocks = self.of.blocks
        found: Array = self.across @ (self.through.T @ vector)
        found[blocks] += (self.alone @ vector[blocks][:, :, None])[:, :, 0]
        return found
