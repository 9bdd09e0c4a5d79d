"""Columns of which each row has few: a measurement knows two frames of many.

Products of such columns are summed up by ``numpy.bincount`` at their places, and read from there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array

#: Columns that are at most so many times as many as each row has are kept whole: one product is then faster.
FEW = 2


@dataclass(frozen=True)
class SparseColumns:
    """The numbers of some rows in columns that are zero elsewhere.

    Attributes
    ----------
    values : (N, 6, w) array
    places : (N, w) array
        The column of each number; a row's columns may be named twice, and then add up.
    count : int
        The number of all columns.
    """

    values: Array
    places: np.ndarray
    count: int

    @staticmethod
    def of(blocks: list[tuple[Array, np.ndarray]], count: int) -> SparseColumns:
        """Blocks of rows (n, 6, w_i), each with its columns (w_i,), one after the other."""
        width = max((len(places) for _, places in blocks), default=0)
        is_whole = count <= FEW * width
        values = np.zeros((sum(len(J) for J, _ in blocks), 6, count if is_whole else width))
        columns = np.zeros((len(values), values.shape[2]), dtype=np.int64)
        if is_whole:
            columns[:] = np.arange(count)
        first = 0
        for J, places in blocks:
            rows = slice(first, first + len(J))
            if is_whole:
                values[rows, :, places] = J
            else:
                values[rows, :, : len(places)] = J
                columns[rows, : len(places)] = places
            first += len(J)
        return SparseColumns(values, columns, count)

    def of_rows(self, rows: np.ndarray) -> SparseColumns:
        """Those of some rows."""
        return SparseColumns(self.values[rows], self.places[rows], self.count)

    @property
    def is_whole(self) -> bool:
        """Whether every row has all columns, in their order."""
        return self.values.shape[2] == self.count and bool((self.places == np.arange(self.count)).all())

    @property
    def whole(self) -> Array:
        """All columns (N, 6, count)."""
        if self.is_whole:
            return self.values
        found = np.zeros((len(self.values), 6, self.count))
        rows = np.arange(len(self.values))
        for k in range(self.values.shape[2]):
            found[rows, :, self.places[:, k]] += self.values[:, :, k]
        return found

    def by(self, basis: Array) -> SparseColumns:
        """The columns in another basis (count, p) of them; few of each row again where it only scales."""
        unit = np.diagonal(basis)
        if basis.shape[0] == basis.shape[1] and not (basis - np.diag(unit)).any():
            return SparseColumns(self.values * unit[self.places][:, None], self.places, self.count)
        values = self.whole @ basis
        p = values.shape[2]
        return SparseColumns(values, np.broadcast_to(np.arange(p), (len(values), p)), p)

    def gram(self, weights: Array) -> Array:
        """J' J (count, count) of the rows with their equations divided by ``weights`` (6,)."""
        scaled = self.values / weights[:, None]
        if self.is_whole:
            flat = scaled.reshape(-1, self.count)
            whole: Array = flat.T @ flat
            return whole
        at = self.places[:, :, None] * self.count + self.places[:, None]
        return summed(scaled.transpose(0, 2, 1) @ scaled, at, (self.count, self.count))


def summed(values: Array, places: np.ndarray, shape: tuple[int, ...]) -> Array:
    """An array whose entries are the sums of the values at these places of its flat form."""
    found = np.bincount(places.ravel(), values.ravel(), int(np.prod(shape)))
    return found.reshape(shape).astype(np.float64, copy=False)  # counts of none are integers
