"""Pairs whose measurements weigh by direction: their forms, costs and information, in the place of moments.

In the direct kind, A X = Y B, with E = R_A R_X - R_Y R_B and e = R_A t_X + alpha t_A - t_Y - R_Y t_B, a measurement's
six to twelve rows are E V and L' (e + E c), linear in the pair's 25 variables (design fact 26). The directions L are in
the sensor carrier's axes. They depend on the answer, so they are those of the answer of the round before.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
from rwhec_factors.se3 import hat, inverse

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.rounding import Doubled, gamma, two_sum
from gtsam_rwhec.problem.directions import Weighing, aligned, frames_of
from gtsam_rwhec.problem.measurements import Kind, Pair
from gtsam_rwhec.problem.problem import Problem

#: Rows of this many measurements are computed at once: some megabytes.
BLOCK = 2048
#: What holds a direction that means nothing has this part of one measurement's weight: little, and it is never paid.
HELD = 1e-2
#: Rounded operations of an entry of a row: the product of three matrices, and A about the gauge.
OPERATIONS = 20


def directed_pairs(
    problem: Problem, pairs: tuple[Pair, ...], about: Mapping[str, Array], scale: float
) -> tuple[DirectedPair, ...]:
    """Those of some pairs that weigh by direction.

    ``about`` has poses (4, 4) of frames, at which the directions are taken, and ``scale`` measured over true length;
    where poses lack, translations have one mean weight. What means nothing of a target is held in its first pair.
    """
    by_direction, known = problem.directed, problem.fixed | dict(about)
    found: list[DirectedPair] = []
    held: set[str] = set()
    for e, pair in enumerate(pairs):
        if pair in by_direction:
            one = DirectedPair.of(e, pair, problem, known, scale)
            if one.unseen.any() and pair.target not in held:
                one = one.holding(known.get(pair.target), known.get(pair.sensor, np.eye(4)), scale)
                held.add(pair.target)
            found.append(one)
    return tuple(found)


@dataclass(frozen=True)
class DirectedPair:
    """The measurements of one pair, with L in the sensor carrier's axes."""

    e: int  #: the pair's place in its part
    A: Array  #: (N, 4, 4)
    B: Array  #: (N, 4, 4)
    weighing: Weighing
    #: The weights of ``weighing`` without those that only hold, (N, 3) each: of turns and of axes.
    told: tuple[Array, Array]
    equations: tuple[int, int]  #: how many they are, of rotation and of translation
    unseen: np.ndarray  #: (6,): which directions of the target mean nothing

    @staticmethod
    def of(e: int, pair: Pair, problem: Problem, known: Mapping[str, Array], scale: float) -> DirectedPair:
        """A pair of a problem, with the directions at the poses (4, 4) of its frames that are known."""
        raw = problem.measurements(*pair)
        X, Y = known.get(pair.target), known.get(pair.sensor)
        if X is not None and Y is not None:
            raw = aligned(raw, X, Y, scale)
        w, is_point, N = Weighing.of(raw), raw.is_of(Kind.POINT), len(raw.A)
        axes, of_axes = np.tile(np.eye(3), (N, 1, 1)), np.repeat(w.mean[:, None], 3, axis=1)
        for T, has in ((X, ~is_point), (Y, is_point)):
            if T is not None:
                of_frame = T[:3, :3] @ raw.B[has, :3, :3] if T is Y else raw.A[has, :3, :3] @ T[:3, :3]
                axes[has], of_axes[has] = of_frame @ w.axes[has], w.of_axes[has]
        weighing = replace(w, axes=axes, of_axes=of_axes)
        told = weighing.without_slides(raw.is_of(Kind.DIRECTIONAL))
        if X is not None and Y is not None:
            weighing = weighing.holding_slides(raw.is_of(Kind.DIRECTIONAL), HELD)
        return DirectedPair(
            e,
            raw.A,
            raw.B,
            weighing,
            told,
            replace(w, of_turns=told[0], of_axes=told[1]).equations,
            problem.unseen(pair.target),
        )

    def holding(self, X: Array | None, Y: Array, scale: float) -> DirectedPair:
        """The pair with one more row of measurements, which holds what means nothing where convention has it.

        What means nothing follows whatever the other frames do, so this costs nothing.
        """
        A, T = self.A[:1], np.eye(4)
        if X is not None and not self.unseen[0]:
            normal = X[:3, 2]
            T[:3, :3] = frames_of(normal[None])[0]
            T[:3, 3] = normal * (normal @ X[:3, 3])
        B, w = inverse(Y)[None] @ A @ T, self.weighing
        B[:, :3, 3] *= scale
        along = HELD * float(w.of_axes.max())
        about = HELD * float(w.of_turns.max()) or along
        more = Weighing(
            turns=np.eye(3)[None],
            of_turns=about * np.array([[1.0, 1.0, float(self.unseen[0])]]),
            centre=np.zeros((1, 3)),
            axes=A[:, :3, :3] @ T[:3, :3],
            of_axes=along * self.unseen[None, 3:] * (X is not None),
            mean=np.zeros(1),
        )
        whole = {part.name: np.concatenate([getattr(w, part.name), getattr(more, part.name)]) for part in fields(w)}
        A, B = np.concatenate([self.A, A]), np.concatenate([self.B, B])
        of_turns, of_axes = (np.concatenate([of, np.zeros((1, 3))]) for of in self.told)
        return replace(self, A=A, B=B, weighing=Weighing(**whole), told=(of_turns, of_axes))

    @property
    def slides(self) -> bool:
        """Whether the measurements do not tell all of the target's pose."""
        measured = np.concatenate(self.told, axis=1).any(axis=1)
        return sum(self.equations) < 6 * int(measured.sum())

    @property
    def count(self) -> int:
        """The number of measurements, and of what holds."""
        return len(self.A)

    def extent(self, a: Array, c: Array, scale: float) -> float:
        """The longest translation of A about a gauge (a, c), and of B in true length."""
        centred = self.A[:, :3, 3] + self.A[:, :3, :3] @ c - a
        both = np.concatenate([centred, self.B[:, :3, 3] / scale])
        return float(np.linalg.norm(both, axis=1).max())

    def rows(self, a: Array, c: Array) -> Iterator[tuple[Array, Array, Array]]:
        """Some measurements' rows (k, 12, 25), magnitudes of their terms, and weights (k, 12); A about a gauge (a, c).

        Nine rows are of the rotation, three of the translation.
        """
        for begin in range(0, self.count, BLOCK):
            at = slice(begin, begin + BLOCK)
            A, B, w = self.A[at], self.B[at], self.weighing
            R_A, R_B, k = A[:, :3, :3], B[:, :3, :3], len(A)
            plain, size = np.zeros((2, k, 12, 25))
            for p in range(3):
                for q in range(3):
                    plain[:, 3 * p + q, 7 + 3 * q : 10 + 3 * q] = R_A[:, p]
                    plain[:, 3 * p + q, 16 + p :: 3] = -R_B[:, :, q]
                plain[:, 9 + p, 16 + p :: 3] = -B[:, :3, 3]
                plain[:, 9 + p, 3 + p] = -1.0
            plain[:, 9:, :3] = R_A
            plain[:, 9:, 6] = A[:, :3, 3] + R_A @ c - a
            size[...] = np.abs(plain)
            size[:, 9:, 6] = np.abs(A[:, :3, 3]) + np.abs(R_A) @ np.abs(c) + np.abs(a)
            turned = _turning(w.turns[at], w.centre[at], w.axes[at])
            yield turned @ plain, np.abs(turned) @ size, self.weights(at)

    def weights(self, at: slice) -> Array:
        """(k, 12) weights of the rows of some measurements."""
        return self._by_row(self.weighing.of_turns[at], self.weighing.of_axes[at])

    @staticmethod
    def _by_row(of_turns: Array, of_axes: Array) -> Array:
        return np.concatenate([np.tile(of_turns, 3), of_axes], axis=1)

    def forms(self, a: Array, c: Array, reach: float) -> tuple[Array, Array, Array]:
        """The forms (25, 25) of translations and of rotations, and a diagonal (25,) that dominates their rounding.

        ``reach``: the size of what a fixed frame's translation adds to those of A.
        """
        of_both, rounding = np.zeros((2, 25, 25)), np.zeros(25)
        for rows, sizes, weights in self.rows(a, c):
            for form, part in zip(of_both, (slice(9, 12), slice(0, 9)), strict=True):
                one = rows[:, part].reshape(-1, 25)
                form += 0.5 * (one * weights[:, part].reshape(-1, 1)).T @ one
            # x'Dx with |D| <= u s s' is at most 25 u sum s_p^2 x_p^2.
            sizes[:, 9:, 6] += reach
            rounding += 0.5 * 25.0 * np.einsum("kr,krp->p", weights, sizes**2)
        return of_both[0], of_both[1], gamma(self.count + 2 * OPERATIONS) * rounding * (1.0 + 1e-9)

    def costs(self, a: Array, c: Array, x: Array) -> tuple[float, float]:
        """J_t and J_R at values of the pair's variables (25,)."""
        squares, weights, first = np.zeros(12), self._by_row(*self.told), 0
        for rows, _, _ in self.rows(a, c):
            squares += 0.5 * (weights[first : first + len(rows)] * (rows @ x) ** 2).sum(axis=0)
            first += len(rows)
        return float(squares[9:].sum()), float(squares[:9].sum())

    def information(self, a: Array, c: Array, X: Array, Y: Array, alpha: float) -> tuple[Array, Array]:
        """The expected information (15, 15) of rotations and of translations at poses (4, 4) about the gauge.

        The parameters are those of `PairInformation`: at B's prediction E is R [omega_X - R' R_Y omega_Y] with
        R = R_A R_X, and e + E c is as there, with [R c] (R_Y omega_Y - R omega_X) beside it.
        """
        w, A, R_Y = self.weighing, self.A, Y[:3, :3]
        R = A[:, :3, :3] @ X[:3, :3]
        lever = A[:, :3, :3] @ (X[:3, 3] + c) + A[:, :3, 3] - a - Y[:3, 3]
        turn, move = np.zeros((2, self.count, 3, 15))
        turn[:, :, 0:3], turn[:, :, 7:10] = np.eye(3), -R.transpose(0, 2, 1) @ R_Y
        arm = hat(np.einsum("nij,nj->ni", R, w.centre))
        move[:, :, 0:3], move[:, :, 7:10] = -arm @ R, (alpha * hat(lever) + arm) @ R_Y
        move[:, :, 3:6], move[:, :, 10:13] = alpha * R, -alpha * R_Y
        move[:, :, 14] = alpha * lever
        of_turns, of_axes = self.told
        told = of_turns.sum(axis=1, keepdims=True) - of_turns
        found = []
        for axes, weights, J in ((w.turns, told, turn), (w.axes, of_axes, move)):
            one = (axes.transpose(0, 2, 1) @ J).reshape(-1, 15)
            found.append((one * weights.reshape(-1, 1)).T @ one)
        return found[0], found[1]

    def turned(self, at: slice, hi: Array, lo: Array | None) -> Array:
        """Residuals hi + lo (1, m, 12 D), E row by row and then e, as E V and L' (e + E c), without cancellation."""
        w, m = self.weighing, hi.shape[1]
        both = Doubled(*(each.reshape(m, -1, 12) for each in two_sum(hi, np.zeros_like(hi) if lo is None else lo)))
        E = Doubled(*(each[:, :, :9].reshape(m, -1, 3, 3) for each in both))
        e = Doubled(*(each[:, :, 9:] for each in both))
        turns = _products(E, w.turns[at][:, None, None])
        moved = e.plus(Doubled(*(each[..., 0] for each in _products(E, w.centre[at][:, None, None, :, None]))))
        along = _products(Doubled(moved.hi[:, :, None], moved.lo[:, :, None]), w.axes[at][:, None, None])
        values = turns.value.reshape(m, -1, 9), along.value.reshape(m, -1, 3)
        return np.concatenate(values, axis=2).reshape(hi.shape)

    def turned_back(self, at: slice, rows: Array) -> Array:
        """Numbers of the rows E V and L' (e + E c), (1, m, 12 D), as numbers of E and e: the transpose."""
        w, m = self.weighing, rows.shape[1]
        matrix = _turning(w.turns[at], w.centre[at], w.axes[at])
        result: Array = (rows.reshape(m, -1, 12) @ matrix).reshape(rows.shape)
        return result

    def reach(self, at: slice, sizes: Array) -> Array:
        """Bounds on the rows' sizes from those of E row by row and e, (..., 12), of some measurements."""
        w = self.weighing
        result: Array = sizes @ np.abs(_turning(w.turns[at], w.centre[at], w.axes[at])).max(axis=0).T
        return result

    def reach_back(self, at: slice, sizes: Array) -> Array:
        """Bounds on the sizes of what ``turned_back`` gives, from those of the rows (..., 12)."""
        w = self.weighing
        result: Array = sizes @ np.abs(_turning(w.turns[at], w.centre[at], w.axes[at])).max(axis=0)
        return result


def _turning(turns: Array, centre: Array, axes: Array) -> Array:
    """The matrices (k, 12, 12) from [E row by row, e] to [E V row by row, L' (e + E c)]."""
    k = len(turns)
    result = np.zeros((k, 12, 12))
    transposed = axes.transpose(0, 2, 1)
    for p in range(3):
        block = slice(3 * p, 3 * p + 3)
        result[:, block, block] = turns.transpose(0, 2, 1)
        result[:, 9:, block] = transposed[:, :, p, None] * centre[:, None, :]
    result[:, 9:, 9:] = transposed
    return result


def _products(rows: Doubled, matrices: Array) -> Doubled:
    """Rows (m, D, i, k) times matrices (m, 1, 1, k, j) of doubles."""
    return Doubled(*(each[..., None] for each in rows)).times(matrices).summed(axis=-2)
