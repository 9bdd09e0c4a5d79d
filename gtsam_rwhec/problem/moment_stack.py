"""The moments of a part's pairs as the solver reads them: matrices are made for few pairs at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.moments import ONE, R_A, SHIFT_OPERATIONS, T_A, T_B, Moments, shift_of
from gtsam_rwhec.problem.packed_moments import PAIRS_AT_ONCE, PackedMoments

I3 = np.eye(3)


@dataclass(frozen=True)
class Matrices:
    """A stack (E, n, n) that is made where it is asked for: ``stack[first:last]``, ``stack[:, rows, columns]``.

    Ask for some pairs, or for some entries of all: all at once are 5 kB a pair.
    """

    stack: MomentStack
    size: int

    def __getitem__(self, key: object) -> Array:
        pairs, *entries = key if isinstance(key, tuple) else (key,)
        index = np.arange(len(self.stack.packed))[pairs]
        chosen = (slice(None), *entries)
        if np.ndim(index) == 0:
            one: Array = self._of(np.atleast_1d(index))[chosen][0]
            return one
        if len(index) <= PAIRS_AT_ONCE:
            few: Array = self._of(index)[chosen]
            return few
        several = [
            self._of(index[first : first + PAIRS_AT_ONCE])[chosen] for first in range(0, len(index), PAIRS_AT_ONCE)
        ]
        return np.concatenate(several)

    def __array__(self, dtype: object = None, copy: bool | None = None) -> Array:
        return self[:]

    @property
    def shape(self) -> tuple[int, int, int]:
        """(E, n, n)."""
        return len(self.stack.packed), self.size, self.size

    def _of(self, index: np.ndarray) -> Array:
        return (
            self.stack.translations(index) if self.size == 25 else self.stack.packed.rotation[index].reshape(-1, 9, 9)
        )


@dataclass(frozen=True)
class MomentStack:
    """Moments of E pairs, about a gauge that is moved by ``a`` and ``c`` from that of the packed ones.

    ``motion`` (E,): whether both ends of a pair are the sensor's carrier. ``count``, ``kappa``, ``weight``,
    ``operations``, ``deviation`` (E,), ``magnitude`` and ``feature_error`` (E, 25) are as in `Moments`; ``translation``
    (E, 25, 25) and ``rotation`` (E, 9, 9) are made where they are asked for.
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

    @property
    def translation(self) -> Matrices:
        """(E, 25, 25): some pairs, or some entries."""
        return Matrices(self, 25)

    @property
    def rotation(self) -> Matrices:
        """(E, 9, 9): some pairs, or some entries."""
        return Matrices(self, 9)

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
