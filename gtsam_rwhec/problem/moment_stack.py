"""The moments of a part's pairs as the solver reads them: matrices are made for few pairs at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.moments import ONE, R_A, R_B, SHIFT_OPERATIONS, T_A, T_B, Moments, shift_of

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


I3 = np.eye(3)


@dataclass(frozen=True)
class MomentStack:
    """Moments of E pairs, about a gauge that is moved by ``a`` and ``c`` from that of the packed ones.

    ``motion`` (E,): whether both ends of a pair are the sensor's carrier. ``count``, ``kappa``, ``weight``,
    ``operations``, ``deviation`` (E,), ``magnitude`` and ``feature_error`` (E, 25) are as in `Moments`. Matrices of
    some pairs are made where they are asked for: all at once are 5 kB a pair.
    """

    packed: PackedMoments
    motion: np.ndarray
    a: Array | None = None
    c: Array | None = None

    @staticmethod
    def of(moments: Sequence[Moments], motion: Sequence[bool]) -> MomentStack:
        """Stack the moments of several pairs."""
        return MomentStack(PackedMoments.of(moments), np.array(motion, dtype=bool))

    @property
    def count(self) -> np.ndarray:
        """(E,) numbers of measurements."""
        return self.packed.count

    @property
    def kappa(self) -> Array:
        """(E,) sums of kappa."""
        return self.packed.kappa

    @property
    def deviation(self) -> Array:
        """(E,), of R'R from the identity."""
        return self.packed.deviation

    @property
    def operations(self) -> np.ndarray:
        """(E,) rounded operations of an entry."""
        return self.packed.operations + (0 if self.a is None else SHIFT_OPERATIONS)

    @cached_property
    def weight(self) -> Array:
        """(E,) sums of 1 / sigma^2."""
        return self.packed.weight

    @cached_property
    def magnitude(self) -> Array:
        """(E, 25), which bound the rounding."""
        return self._by_shift(self.packed.magnitude[:])

    @cached_property
    def feature_error(self) -> Array:
        """(E, 25), which bound the rounding."""
        error = np.zeros((len(self.packed), 25))
        error[:, T_A] = self.packed.feature_error[:]
        return self._by_shift(error)

    def rotations(self, index: np.ndarray | slice) -> Array:
        """``rotation`` of some pairs (e, 9, 9)."""
        return self.packed.rotation[index].reshape(-1, 9, 9)

    def translations(self, index: np.ndarray | slice) -> Array:
        """``translation`` of some pairs (e, 25, 25): t_A becomes t_A + R_A c - a, in rows and then in columns."""
        return self._moved(self.packed.matrices(index), index, ONE)

    def fronts(self, index: np.ndarray | slice) -> Array:
        """The entries of `translations` without R_B, (e, 16, 16), in the order of `FRONT`."""
        return self._moved(self.packed.fronts(index), index, 15)

    def entries(self, rows: np.ndarray | slice, columns: np.ndarray | slice) -> Array:
        """Entries (rows[k], columns[k]) of all pairs, (E, k), of features that the gauge does not move (not t_A)."""
        features = np.arange(25)
        of_rows, of_columns = np.broadcast_arrays(features[rows], features[columns])
        return self.packed.entries(of_rows, of_columns)

    def _moved(self, G: Array, index: np.ndarray | slice, one: int) -> Array:
        """Sums with R_A in 0:9, t_A in 9:12 and 1 in ``one``, about the gauge."""
        if self.a is None or self.c is None:
            return G
        a = np.broadcast_to(self.a, (len(G), 3))
        c = np.where(self.motion[index][:, None], a, self.c)
        rows = G[:, 0:3] * c[:, 0, None, None] + G[:, 3:6] * c[:, 1, None, None] + G[:, 6:9] * c[:, 2, None, None]
        G[:, T_A] += rows - a[:, :, None] * G[:, one, None, :]
        columns = G[:, :, 0:3] * c[:, None, 0, None]
        columns += G[:, :, 3:6] * c[:, None, 1, None]
        columns += G[:, :, 6:9] * c[:, None, 2, None]
        G[:, :, T_A] += columns - G[:, :, one, None] * a[:, None, :]
        return G

    def blocks(self) -> Iterator[slice]:
        """The pairs, some at a time."""
        for first in range(0, len(self.packed), PAIRS_AT_ONCE):
            yield slice(first, min(first + PAIRS_AT_ONCE, len(self.packed)))

    def is_finite(self) -> np.ndarray:
        """(E,): whether the sums of a pair are numbers that did not overflow."""
        return np.concatenate([np.isfinite(self.packed.front[at]).all(axis=1) for at in self.blocks()])

    def squares(self, features: slice) -> Array:
        """(E,): the sum of the weighted squares of t_A or t_B."""
        if features == T_B:
            squares: Array = self.entries(T_B, T_B).sum(axis=1)
            return squares
        return np.concatenate([np.einsum("ekk->e", self.fronts(at)[:, features, features]) for at in self.blocks()])

    def best_shift(self) -> tuple[Array, Array]:
        """The shift (a, c) that centres all pairs together: min sum |t_A + R_A c - a|^2 / sigma^2, minimum norm."""
        of_two = np.zeros((2, 3, 3)), np.zeros((2, 3)), np.zeros((2, 3))  # of pairs, and of motions
        for at in self.blocks():
            G, motion = self.fronts(at), self.motion[at]
            # The sum of R_A': entry (i, k) is R_A[k, i], which vec has at 3 i + k.
            Rt = G[:, R_A, 15].reshape(-1, 3, 3)
            Rt_t = np.einsum("eikk->ei", G[:, R_A, T_A].reshape(-1, 3, 3, 3))
            for total, each in zip(of_two, (Rt, Rt_t, G[:, T_A, 15]), strict=True):
                total[0] += each[~motion].sum(axis=0)
                total[1] += each[motion].sum(axis=0)
        (Rt_still, turned), (Rt_t_still, Rt_t_moving), (t_still, t_moving) = of_two
        normal, right = np.zeros((6, 6)), np.zeros(6)
        normal[:3, :3] = normal[3:, 3:] = self.weight[~self.motion].sum() * I3
        normal[3:, :3] = -Rt_still
        normal[:3, 3:] = normal[3:, :3].T
        right[:3], right[3:] = t_still, -Rt_t_still
        if self.motion.any():  # c = a: residual t_A - (I - R_A) a
            normal[:3, :3] += 2.0 * self.weight[self.motion].sum() * I3 - turned - turned.T
            right[:3] += t_moving - Rt_t_moving
        solution: Array = np.linalg.lstsq(normal, right, rcond=1e-9)[0]
        return solution[:3], solution[3:]

    def shifted(self, a: Array, c: Array) -> MomentStack:
        """The moments about a gauge moved by a (sensor carrier) and c (target carrier), exactly."""
        if self.a is not None and self.c is not None:
            a, c = a + self.a, c + self.c
        return replace(self, a=a, c=c)

    def spread(self) -> float:
        """Root mean square of t_A about the gauge, in metres."""
        square = float(self.squares(T_A).sum())
        return float(np.sqrt(max(square, 0.0) / self.weight.sum()))

    def _by_shift(self, of_features: Array) -> Array:
        """|shift| times vectors (E, 25)."""
        if self.a is None or self.c is None:
            return of_features
        moved: Array = of_features @ np.abs(shift_of(self.a, self.c)).T
        if self.motion.any():
            moved[self.motion] = of_features[self.motion] @ np.abs(shift_of(self.a, self.a)).T
        return moved
