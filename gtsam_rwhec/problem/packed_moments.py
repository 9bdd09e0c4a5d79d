"""Moments of many pairs in little memory: one triangle of each matrix, and matrices for few pairs at a time.

80,000 matrices of 25 x 25 doubles are 400 MB. They are symmetric, and where the lengths in B are known nothing reads
the entries of B's rotations (only the inverse equation does, design fact 7). So a pair takes 2 kB here, in place of 6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.moments import ONE, R_A, R_B, T_A, T_B, Moments

#: The features without B's rotation.
FRONT = np.r_[R_A, T_A, T_B, ONE]
#: So many pairs have their matrices at once: some megabytes.
PAIRS_AT_ONCE = 256
_IS_BACK = np.isin(np.arange(25), np.arange(25)[R_B])
_ROWS, _COLUMNS = np.triu_indices(25)
_BACK = _IS_BACK[_ROWS] | _IS_BACK[_COLUMNS]
#: Rows and columns of the entries that are kept always, and of those with B's rotation.
FRONT_ENTRIES = _ROWS[~_BACK], _COLUMNS[~_BACK]
BACK_ENTRIES = _ROWS[_BACK], _COLUMNS[_BACK]
#: Where each of 16 x 16 entries is in a row of 136.
_UPPER = np.zeros((16, 16), dtype=int)
_UPPER[np.triu_indices(16)] = np.arange(136)
_FULL: np.ndarray = np.maximum(_UPPER, _UPPER.T).ravel()
#: Fields with one entry, or one short row, for each pair; and those with a long one.
_SHORT = ("count", "kappa", "operations", "deviation", "projected")
_LONG = ("front", "rotation", "magnitude", "feature_error")


@dataclass(frozen=True)
class Rows:
    """The rows of several arrays (e, n), one after the other, without a copy: ``rows[first:last]``, ``rows[index]``."""

    arrays: tuple[Array, ...]

    @staticmethod
    def of(several: Sequence[Array | Rows]) -> Rows:
        """The rows of all."""
        return Rows(tuple(array for each in several for array in (each.arrays if isinstance(each, Rows) else (each,))))

    def __getitem__(self, index: np.ndarray | slice) -> Array:
        ends = np.cumsum([len(array) for array in self.arrays])
        wanted = np.arange(ends[-1])[index]
        where = np.searchsorted(ends, wanted, side="right")
        result = np.empty((len(wanted), self.arrays[0].shape[1]))
        for i in np.unique(where):
            own = where == i
            result[own] = self.arrays[i][wanted[own] - (ends[i - 1] if i else 0)]
        return result

    def columns(self, at: np.ndarray) -> Array:
        """Some entries of each row."""
        return np.concatenate([array[:, at] for array in self.arrays])


@dataclass(frozen=True)
class PackedMoments:
    """Moments of E pairs, as in `Moments`, with the upper triangles of ``translation`` as rows.

    count, kappa, operations, deviation, projected (E,); front (E, 136) without the entries of R_B, and back (E, 189)
    with R_B, or None where they are not kept; rotation (E, 81); magnitude (E, 25); feature_error (E, 3), of t_A.
    """

    count: np.ndarray
    kappa: Array
    front: Array | Rows
    back: Array | Rows | None
    rotation: Array | Rows
    magnitude: Array | Rows
    feature_error: Array | Rows
    operations: np.ndarray
    deviation: Array
    projected: np.ndarray

    @staticmethod
    def of(moments: Sequence[Moments]) -> PackedMoments:
        """The moments of several pairs; all of their matrices are kept."""
        translation = np.array([of_pair.translation for of_pair in moments]).reshape(-1, 25, 25)
        back = translation[:, BACK_ENTRIES[0], BACK_ENTRIES[1]]
        return PackedMoments(
            count=np.array([of_pair.count for of_pair in moments], dtype=int),
            kappa=np.array([of_pair.kappa for of_pair in moments], dtype=float),
            front=translation[:, FRONT_ENTRIES[0], FRONT_ENTRIES[1]],
            back=None if np.isnan(back).all() else back,
            rotation=np.array([of_pair.rotation for of_pair in moments]).reshape(-1, 81),
            magnitude=np.array([of_pair.magnitude for of_pair in moments]).reshape(-1, 25),
            feature_error=np.array([of_pair.feature_error[T_A] for of_pair in moments]).reshape(-1, 3),
            operations=np.array([of_pair.operations for of_pair in moments], dtype=int),
            deviation=np.array([of_pair.deviation for of_pair in moments], dtype=float),
            projected=np.array([of_pair.projected for of_pair in moments], dtype=int),
        )

    @staticmethod
    def joined(several: Sequence[PackedMoments]) -> PackedMoments:
        """All pairs of several, one after the other; long rows stay where they are."""
        if len(several) == 1:
            return several[0]
        fields: dict[str, Any] = {name: np.concatenate([getattr(each, name) for each in several]) for name in _SHORT}
        fields |= {name: Rows.of([getattr(each, name) for each in several]) for name in _LONG}
        back: Rows | None = None
        if any(each.back is not None for each in several):
            n = len(BACK_ENTRIES[0])
            back = Rows.of([np.full((len(each), n), np.nan) if each.back is None else each.back for each in several])
        return PackedMoments(back=back, **fields)

    @property
    def weight(self) -> Array:
        """(E,) sums of 1 / sigma^2, the last entry of each triangle."""
        return self.entries(np.array([ONE]), np.array([ONE]))[:, 0]

    def __len__(self) -> int:
        return len(self.count)

    def rows(self, index: np.ndarray | slice) -> PackedMoments:
        """Some of the pairs."""
        back = None if self.back is None else self.back[index]
        return PackedMoments(back=back, **{name: getattr(self, name)[index] for name in _SHORT + _LONG})

    def matrices(self, index: np.ndarray | slice) -> Array:
        """``translation`` of some pairs, (e, 25, 25); nan in the entries of R_B where these are not kept."""
        fronts = self.fronts(index)
        result = np.full((len(fronts), 25, 25), np.nan) if self.back is None else np.empty((len(fronts), 25, 25))
        result[:, FRONT[:, None], FRONT] = fronts
        if self.back is not None:
            (rows, columns), values = BACK_ENTRIES, self.back[index]
            result[:, rows, columns] = values
            result[:, columns, rows] = values
        return result

    def fronts(self, index: np.ndarray | slice) -> Array:
        """The entries of ``translation`` without R_B, of some pairs, (e, 16, 16) in the order of `FRONT`."""
        result: Array = np.take(self.front[index], _FULL, axis=1)
        return result.reshape(-1, 16, 16)

    def entries(self, rows: np.ndarray, columns: np.ndarray) -> Array:
        """Some entries of ``translation``, none of them of R_B, of all pairs, (E, k)."""
        chosen = _FULL.reshape(16, 16)[np.searchsorted(FRONT, rows), np.searchsorted(FRONT, columns)]
        return self.front.columns(chosen) if isinstance(self.front, Rows) else self.front[:, chosen]

    def one(self, index: int) -> Moments:
        """The moments of one pair."""
        error = np.zeros(25)
        error[T_A] = self.feature_error[index : index + 1][0]
        return Moments(
            int(self.count[index]),
            float(self.kappa[index]),
            self.matrices(slice(index, index + 1))[0],
            self.rotation[index : index + 1].reshape(9, 9),
            self.magnitude[index : index + 1][0],
            error,
            int(self.operations[index]),
            float(self.deviation[index]),
            int(self.projected[index]),
        )

    def add_to(self, index: np.ndarray, other: PackedMoments) -> None:
        """Add the pairs of another to some rows of this one, in place, as ``Moments`` are added."""
        for name in ("count", "kappa", "front", "rotation", "projected"):
            getattr(self, name)[index] += getattr(other, name)[:]
        if isinstance(self.back, np.ndarray):
            self.back[index] += np.nan if other.back is None else other.back[:]
        for name in ("magnitude", "feature_error"):
            getattr(self, name)[index] = np.hypot(getattr(self, name)[index], getattr(other, name)[:])
        self.operations[index] = np.maximum(self.operations[index], other.operations) + 1
        self.deviation[index] = np.maximum(self.deviation[index], other.deviation)
