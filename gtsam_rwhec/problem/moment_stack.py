"""Moments of many pairs in little memory: one triangle of each matrix, and matrices for few pairs at a time.

80,000 matrices of 25 x 25 doubles are 400 MB. They are symmetric, and where the lengths in B are known nothing reads
the entries of B's rotations (only the inverse equation does, design fact 7). So a pair takes 2 kB here, in place of 6.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.moments import ONE, R_A, R_B, SHIFT_OPERATIONS, T_A, T_B, Moments, shift_of

#: The features without B's rotation.
FRONT = np.r_[R_A, T_A, T_B, ONE]
#: The matrices of this many pairs are computed at once: some megabytes.
PAIRS_AT_ONCE = 256
_IS_BACK = np.isin(np.arange(25), np.arange(25)[R_B])
_ROWS, _COLUMNS = np.triu_indices(25)
_BACK = _IS_BACK[_ROWS] | _IS_BACK[_COLUMNS]
#: Rows and columns of the entries that are kept always, and of those with B's rotation.
FRONT_ENTRIES = _ROWS[~_BACK], _COLUMNS[~_BACK]
BACK_ENTRIES = _ROWS[_BACK], _COLUMNS[_BACK]
#: The position of each entry of a 16 x 16 matrix in a row of 136.
_UPPER = np.zeros((16, 16), dtype=int)
_UPPER[np.triu_indices(16)] = np.arange(136)
_FULL: np.ndarray = np.maximum(_UPPER, _UPPER.T).ravel()
_I3 = np.eye(3)


@dataclass(frozen=True, eq=False)
class MomentStack:
    """Moments of E pairs, as in `Moments`, in the order of the pairs.

    They were summed about one gauge, and are read about a gauge moved from it by ``a`` and ``c``. Matrices are computed
    on request, for some pairs.
    """

    motion: np.ndarray  #: (E,): whether both ends of a pair are the sensor's carrier
    count: np.ndarray  #: (E,)
    kappa: Array  #: (E,)
    front: Array  #: (E, 136): the upper triangle of ``translation`` without the entries of R_B
    back: Array | None  #: (E, 189): those with R_B; None where they are not kept
    rotation: Array  #: (E, 81)
    magnitude_as_summed: Array  #: (E, 25)
    error_as_summed: Array  #: (E, 3): the feature error of t_A
    operations_as_summed: np.ndarray  #: (E,)
    deviation: Array  #: (E,)
    longest_as_summed: Array  #: (E, 2): the longest t_A and t_B of a measurement
    projected: np.ndarray  #: (E,)
    a: Array | None = None
    c: Array | None = None

    @staticmethod
    def nothing(motion: np.ndarray, *, with_R_B: bool) -> MomentStack:
        """The sums of pairs without measurements."""
        E = len(motion)
        whole, back = np.zeros((3, E), dtype=int), np.zeros((E, len(BACK_ENTRIES[0]))) if with_R_B else None
        return MomentStack(
            motion=motion,
            count=whole[0],
            kappa=np.zeros(E),
            front=np.zeros((E, len(FRONT_ENTRIES[0]))),
            back=back,
            rotation=np.zeros((E, 81)),
            magnitude_as_summed=np.zeros((E, 25)),
            error_as_summed=np.zeros((E, 3)),
            operations_as_summed=whole[1],
            deviation=np.zeros(E),
            longest_as_summed=np.zeros((E, 2)),
            projected=whole[2],
        )

    @staticmethod
    def joined(several: Sequence[MomentStack]) -> MomentStack:
        """All pairs of several stacks, one after the other."""
        if len(several) == 1:
            return several[0]
        with_R_B = any(stack.back is not None for stack in several)
        n = len(BACK_ENTRIES[0])
        arrays: dict[str, Any] = {
            name: np.concatenate([getattr(stack, name) for stack in several]) for name in _ARRAYS if name != "back"
        }
        back = [np.full((len(stack), n), np.nan) if stack.back is None else stack.back for stack in several]
        return MomentStack(back=np.concatenate(back) if with_R_B else None, **arrays)

    def __len__(self) -> int:
        return len(self.count)

    def rows(self, index: np.ndarray | slice) -> MomentStack:
        """Some of the pairs."""
        arrays: dict[str, Any] = {name: getattr(self, name) for name in _ARRAYS}
        return replace(self, **{name: array[index] for name, array in arrays.items() if array is not None})

    def add_to(self, index: np.ndarray, other: MomentStack) -> None:
        """Add the pairs of another stack to some rows of this one, in place, as `Moments` are added."""
        for name in ("count", "kappa", "front", "rotation", "projected"):
            getattr(self, name)[index] += getattr(other, name)
        if self.back is not None:
            self.back[index] += np.nan if other.back is None else other.back
        for name in ("magnitude_as_summed", "error_as_summed"):
            getattr(self, name)[index] = np.hypot(getattr(self, name)[index], getattr(other, name))
        self.operations_as_summed[index] = np.maximum(self.operations_as_summed[index], other.operations_as_summed) + 1
        for name in ("deviation", "longest_as_summed"):
            getattr(self, name)[index] = np.maximum(getattr(self, name)[index], getattr(other, name))

    def as_summed(self) -> MomentStack:
        """The same moments, as if they had been summed about the gauge that they are read about."""
        front, back = self.front.copy(), None if self.back is None else self.back.copy()
        for at in self.blocks():
            G = self.translations(at)
            front[at] = G[:, FRONT_ENTRIES[0], FRONT_ENTRIES[1]]
            if back is not None:
                back[at] = G[:, BACK_ENTRIES[0], BACK_ENTRIES[1]]
        whole = replace(self, front=front, back=back, count=self.count.copy(), a=None, c=None)
        names = ("magnitude", "operations", "longest")
        arrays = {f"{name}_as_summed": getattr(self, name).copy() for name in names}
        return replace(whole, **arrays)

    def one(self, e: int) -> Moments:
        """The moments of one pair, as they were summed; nan in the entries of R_B where these are not kept."""
        error = np.zeros(25)
        error[T_A] = self.error_as_summed[e]
        return Moments(
            int(self.count[e]),
            float(self.kappa[e]),
            self._matrices(slice(e, e + 1))[0],
            self.rotation[e].reshape(9, 9),
            self.magnitude_as_summed[e],
            error,
            int(self.operations_as_summed[e]),
            float(self.deviation[e]),
            int(self.projected[e]),
        )

    @cached_property
    def weight(self) -> Array:
        """(E,) sums of 1 / sigma^2, the last entry of each triangle."""
        return self.front[:, -1]

    @property
    def operations(self) -> np.ndarray:
        """(E,) rounded operations of an entry."""
        return self.operations_as_summed + (0 if self.a is None else SHIFT_OPERATIONS)

    @cached_property
    def magnitude(self) -> Array:
        """(E, 25), which bound the rounding."""
        return self._by_shift(self.magnitude_as_summed)

    @property
    def longest(self) -> Array:
        """(E, 2): no t_A and no t_B of a measurement is longer."""
        if self.a is None or self.c is None:
            return self.longest_as_summed
        moved = float(np.linalg.norm(self.a) + np.linalg.norm(self.c))
        return np.asarray(self.longest_as_summed + np.array([moved, 0.0]))

    @cached_property
    def feature_error(self) -> Array:
        """(E, 25), which bound the rounding."""
        error = np.zeros((len(self), 25))
        error[:, T_A] = self.error_as_summed
        return self._by_shift(error)

    def rotations(self, index: np.ndarray | slice) -> Array:
        """``rotation`` of some pairs (e, 9, 9)."""
        return self.rotation[index].reshape(-1, 9, 9)

    def translations(self, index: np.ndarray | slice) -> Array:
        """``translation`` of some pairs (e, 25, 25)."""
        return self._moved(self._matrices(index), index, ONE)

    def fronts(self, index: np.ndarray | slice) -> Array:
        """The entries of `translations` without R_B, (e, 16, 16), in the order of `FRONT`."""
        return self._moved(self._fronts(index), index, 15)

    def entries(self, rows: np.ndarray | slice, columns: np.ndarray | slice) -> Array:
        """Entries (rows[k], columns[k]) of all pairs, (E, k), of features that the gauge does not move (not t_A)."""
        place = np.searchsorted(FRONT, np.arange(25))
        of_rows, of_columns = np.broadcast_arrays(place[rows], place[columns])
        return self.front[:, _FULL.reshape(16, 16)[of_rows, of_columns]]

    def _matrices(self, index: np.ndarray | slice) -> Array:
        fronts = self._fronts(index)
        result = np.full((len(fronts), 25, 25), np.nan)
        result[:, FRONT[:, None], FRONT] = fronts
        if self.back is not None:
            rows, columns = BACK_ENTRIES
            result[:, rows, columns] = result[:, columns, rows] = self.back[index]
        return result

    def _fronts(self, index: np.ndarray | slice) -> Array:
        result: Array = np.take(self.front[index], _FULL, axis=1)
        return result.reshape(-1, 16, 16)

    def _moved(self, G: Array, index: np.ndarray | slice, one: int) -> Array:
        """Sums with R_A in 0:9, t_A in 9:12 and 1 in ``one``, about the gauge: t_A becomes t_A + R_A c - a."""
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

    def _by_shift(self, of_features: Array) -> Array:
        """|shift| times vectors (E, 25)."""
        if self.a is None or self.c is None:
            return of_features
        moved: Array = of_features @ np.abs(shift_of(self.a, self.c)).T
        if self.motion.any():
            moved[self.motion] = of_features[self.motion] @ np.abs(shift_of(self.a, self.a)).T
        return moved

    def blocks(self) -> Iterator[slice]:
        """The pairs, some at a time."""
        for first in range(0, len(self), PAIRS_AT_ONCE):
            yield slice(first, min(first + PAIRS_AT_ONCE, len(self)))

    def is_finite(self) -> np.ndarray:
        """(E,): whether the sums of a pair are finite."""
        return np.asarray(np.isfinite(self.front).all(axis=1))

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
        normal[:3, :3] = normal[3:, 3:] = self.weight[~self.motion].sum() * _I3
        normal[3:, :3] = -Rt_still
        normal[:3, 3:] = normal[3:, :3].T
        right[:3], right[3:] = t_still, -Rt_t_still
        if self.motion.any():  # c = a: residual t_A - (I - R_A) a
            normal[:3, :3] += 2.0 * self.weight[self.motion].sum() * _I3 - turned - turned.T
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
        return float(np.sqrt(max(float(self.squares(T_A).sum()), 0.0) / self.weight.sum()))


_ARRAYS = tuple(field.name for field in fields(MomentStack) if field.name not in ("a", "c"))
