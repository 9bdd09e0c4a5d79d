"""In which order the frames of a graph are eliminated, and what fill that makes.

Frames without a coupling between them are eliminated together, those with few neighbours first: in each round, the
frames that have fewer neighbours than any of theirs (multiple minimum degree, Liu 1985). For a star that is one round:
the leaves. When the remaining frames are few, or almost all pairs of them are coupled, the rest is one dense matrix.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.rounding import SAFETY, gammas

#: A round eliminates frames with at most ``TIMES_FEWEST`` * (fewest neighbours) + ``MORE`` neighbours.
TIMES_FEWEST, MORE = 2, 2
#: When this fraction of all possible couplings exists, the rest is one dense matrix.
DENSE = 0.8
#: Up to this many frames are always one dense matrix: to eliminate them one by one takes longer.
FEW = 30
#: Groups with different numbers of neighbours are padded and merged if that costs at most this much: numbers of blocks,
#: squared.
PADDING = 12_000
#: From this many frames with the same neighbours on, one matrix product eliminates them.
ALIKE = 8
#: Frames with the same number of neighbours are tried in a random order, drawn once and for all.
SEED = 0


@dataclass(frozen=True)
class Group:
    """k frames with d neighbours each that are eliminated together; the index n (number of frames) means no neighbour.

    ``edges`` (k, d) are the couplings with the neighbours, which are stored ``flipped`` where the neighbour comes first
    by number; ``are_alike`` says that all have the same neighbours.
    """

    frames: np.ndarray
    neighbours: np.ndarray
    edges: np.ndarray
    flipped: np.ndarray
    are_alike: bool


@dataclass(frozen=True)
class Elimination:
    """The order of n frames, and all couplings that exist at any time of the elimination.

    Couplings are pairs ``first`` < ``second`` of frames: the ``given`` ones, in their order, and then the fill.
    ``changed`` is the place of each coupling among those that the elimination of other frames changes, or one past the
    last. ``rest`` are the frames that are dense at the end, in ascending order.
    """

    n: int
    first: np.ndarray
    second: np.ndarray
    given: int
    changed: np.ndarray
    groups: tuple[Group, ...]
    rest: np.ndarray
    _spreads: dict[tuple[int, int], tuple[Array, float]] = field(default_factory=dict, compare=False, repr=False)

    @staticmethod
    def of(n: int, first: np.ndarray, second: np.ndarray, few: int = FEW) -> Elimination:
        """The order for frames 0 to n - 1 with couplings of ``first`` and ``second`` (F,), each first < second, once.

        When at most ``few`` frames are left, they are one dense matrix.
        """
        first, second = np.asarray(first, dtype=np.int64), np.asarray(second, dtype=np.int64)
        if n <= few:
            return Elimination(n, first, second, len(first), np.full(len(first), len(first)), (), np.arange(n))
        return _Ordering(n, first, second).run(few)

    @property
    def is_dense(self) -> bool:
        """Whether the few frames are all in the dense rest: the factor is one of LAPACK then."""
        return 0 < self.n <= FEW and not self.groups

    @cached_property
    def number_changed(self) -> int:
        """How many couplings are changed by the elimination of other frames."""
        return int((self.changed < len(self.changed)).sum())

    @cached_property
    def neighbours(self) -> np.ndarray:
        """The number of frames that each frame is coupled with before the elimination, (n,)."""
        return np.bincount(np.concatenate([self.first[: self.given], self.second[: self.given]]), minlength=self.n)

    @cached_property
    def eliminated(self) -> int:
        """The number of blocks of the factor outside the frames' own blocks and the dense rest."""
        return sum(group.neighbours.size for group in self.groups)

    @cached_property
    def key_order(self) -> tuple[np.ndarray, np.ndarray]:
        """The couplings' keys, ascending, and which couplings they are."""
        keys = self.first * (self.n + 1) + self.second
        order = np.argsort(keys)
        return keys[order], order

    def couplings_of(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """The indices of the couplings of given frames; one past the last index for pairs with the frame n."""
        keys, order = self.key_order
        wanted = first * (self.n + 1) + second
        place = np.minimum(np.searchsorted(keys, wanted), max(len(keys) - 1, 0))
        none = (first >= self.n) | (second >= self.n)
        if len(keys) == 0:
            return np.zeros(wanted.shape, dtype=np.int64)
        return np.where(none, len(keys), order[place])

    @cached_property
    def terms(self) -> np.ndarray:
        """The number of blocks in each frame's rows of the factor, its own included, (n,); without the tail."""
        result = np.ones(self.n + 1, dtype=np.int64)
        for group in self.groups:
            np.add.at(result, group.neighbours, 1)
        result[self.rest] += len(self.rest) - 1
        return result[: self.n]

    def spread(self, m: int, q: int) -> tuple[Array, float]:
        """Rounding of a factorisation with blocks of m and a tail of q, as a fraction of the diagonal: (n,), ().

        Higham 2002, theorem 10.3, for any order of summation: dA_ij is at most g_ij sqrt(a_ii a_jj), g = gamma_(k+1) /
        (1 - gamma_(k+1)) for k terms in the sum, and zero outside the fill. A symmetric matrix of numbers that are not
        negative is dominated by the diagonal matrix of its row sums.
        """
        if (m, q) not in self._spreads:
            self._spreads[m, q] = self._spread(m, q)
        return self._spreads[m, q]

    def _spread(self, m: int, q: int) -> tuple[Array, float]:
        terms = np.append(m * self.terms, 0)
        terms[self.rest] += q
        of_tail = int(m * self.n + q)
        g = gammas(np.append(terms, of_tail) + 3)
        g /= 1.0 - g
        g, last = g[:-1], float(g[-1])
        sums = m * g + q * g
        for group in self.groups:
            fewer = np.minimum(g[group.frames][:, None], g[group.neighbours])
            fewer[group.neighbours == self.n] = 0.0
            sums[group.frames] += m * fewer.sum(axis=1)
            np.add.at(sums, group.neighbours, m * fewer)
        sums[self.rest] += m * max(len(self.rest) - 1, 0) * g[self.rest]
        return SAFETY * sums[: self.n], SAFETY * float(m * g[: self.n].sum() + q * last)


class _Ordering:
    """The state of the symbolic elimination."""

    def __init__(self, n: int, first: np.ndarray, second: np.ndarray) -> None:
        self.n, self.given = n, len(first)
        self.first, self.second = first, second
        self.alive = np.ones(n, dtype=bool)
        self.current = np.arange(len(first))  # couplings between frames that are alive
        self.keys = np.sort(first * (n + 1) + second)
        self.priority = np.random.default_rng(SEED).permutation(n) / max(n, 1)
        self.is_changed = np.zeros(len(first), dtype=bool)

    def run(self, few: int) -> Elimination:
        groups: list[tuple[np.ndarray, np.ndarray, bool]] = []
        while True:
            left = int(self.alive.sum())
            if left <= few or len(self.current) >= DENSE * left * (left - 1) / 2:
                break
            groups += self._eliminated(self._chosen())
        total = len(self.first)
        changed = np.full(total, total)
        changed[self.is_changed] = np.arange(int(self.is_changed.sum()))
        order = Elimination(self.n, self.first, self.second, self.given, changed, (), np.flatnonzero(self.alive))
        made = []
        for frames, neighbours, are_alike in groups:
            flipped = neighbours < frames[:, None]
            edges = order.couplings_of(np.minimum(frames[:, None], neighbours), np.maximum(frames[:, None], neighbours))
            made.append(Group(frames, neighbours, edges, flipped, are_alike))
        return replace(order, groups=tuple(made))

    def _chosen(self) -> np.ndarray:
        """Frames without couplings between them, each with fewer neighbours than its neighbours have."""
        ends = np.concatenate([self.first[self.current], self.second[self.current]])
        others = np.concatenate([self.second[self.current], self.first[self.current]])
        degree = np.bincount(ends, minlength=self.n)
        fewest = int(degree[self.alive].min())
        value = degree + self.priority
        open_ = self.alive & (degree <= TIMES_FEWEST * fewest + MORE)
        chosen = np.zeros(self.n, dtype=bool)
        while open_.any():
            lowest = np.full(self.n, np.inf)
            np.minimum.at(lowest, ends, np.where(open_[others], value[others], np.inf))
            new = open_ & (value < lowest)
            chosen |= new
            open_ &= ~new
            open_[ends[new[others]]] = False
        return chosen

    def _eliminated(self, chosen: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, bool]]:
        """Eliminate the chosen frames, and return their groups."""
        first, second = self.first[self.current], self.second[self.current]
        ends, others = np.concatenate([first, second]), np.concatenate([second, first])
        mine = chosen[ends]
        ends, others = ends[mine], others[mine]
        order = np.lexsort((others, ends))
        ends, others = ends[order], others[order]
        frames = np.flatnonzero(chosen)
        begin = np.searchsorted(ends, frames)
        degree = np.searchsorted(ends, frames, side="right") - begin
        groups, fill = [], []
        for members in _padded(degree):
            d = int(degree[members].max(initial=0))
            at = np.minimum(begin[members, None] + np.arange(d), max(len(others) - 1, 0))
            has = np.arange(d) < degree[members, None]
            neighbours = np.where(has, others[at] if len(others) else self.n, self.n)
            sort = np.lexsort(neighbours.T[::-1]) if d else np.arange(len(members))
            groups += _alike(frames[members][sort], neighbours[sort])
            a, b = np.triu_indices(d, 1)
            distinct = np.unique(neighbours, axis=0) if d else neighbours[:0]
            keys = (distinct[:, a] * (self.n + 1) + distinct[:, b]).ravel()
            fill.append(np.unique(keys[(distinct[:, b] < self.n).ravel()]))
        self.alive &= ~chosen
        self.current = self.current[~(chosen[first] | chosen[second])]
        self._add(np.unique(np.concatenate(fill)) if fill else np.zeros(0, dtype=np.int64))
        return groups

    def _add(self, keys: np.ndarray) -> None:
        """Add the couplings that an elimination changes; some of them are new."""
        of_current = self.first[self.current] * (self.n + 1) + self.second[self.current]
        self.is_changed[self.current[np.isin(of_current, keys)]] = True
        new = np.setdiff1d(keys, of_current, assume_unique=True)
        start = len(self.first)
        self.first = np.concatenate([self.first, new // (self.n + 1)])
        self.second = np.concatenate([self.second, new % (self.n + 1)])
        self.is_changed = np.concatenate([self.is_changed, np.ones(len(new), dtype=bool)])
        self.current = np.concatenate([self.current, start + np.arange(len(new))])


def _padded(degree: np.ndarray) -> list[np.ndarray]:
    """Groups of frames with about the same number of neighbours."""
    order = np.argsort(-degree, kind="stable")
    sizes = degree[order]
    groups, begin, cost = [], 0, 0.0
    for start in np.flatnonzero(np.diff(sizes, prepend=-1)):
        stop = int(np.searchsorted(-sizes, -sizes[start], side="right"))
        more = float((stop - start) * (sizes[begin] ** 2 - sizes[start] ** 2))
        if start > begin and cost + more > PADDING:
            groups.append(order[begin:start])
            begin, cost, more = int(start), 0.0, 0.0
        cost += more
    groups.append(order[begin:])
    return groups


def _alike(frames: np.ndarray, neighbours: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, bool]]:
    """Split a group, sorted by neighbours, into sets of many frames with the same neighbours, and the others."""
    differs = np.r_[True, (neighbours[1:] != neighbours[:-1]).any(axis=1)]
    begin = np.flatnonzero(differs)
    count = np.diff(np.r_[begin, len(frames)])
    large = count >= ALIKE
    groups = [(frames[b : b + c], neighbours[b : b + c], True) for b, c in zip(begin[large], count[large], strict=True)]
    others = np.repeat(~large, count)
    if others.any():
        groups.append((frames[others], neighbours[others], False))
    return groups
