"""What the measurements of one pair determine, and what those of the whole problem determine."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from gtsam_rwhec.identifiability.free_directions import FreeDirection
from gtsam_rwhec.problem.pairs import Pair

#: So many pairs are tested at once.
TESTED_AT_ONCE = 256


@dataclass(frozen=True)
class PairIdentifiability:
    """What one pair determines alone.

    Attributes
    ----------
    is_unique : bool
    free_directions : tuple of FreeDirection
    rotation_axes : int
        Number of axes about which its motion turned: 0, 1, or 2 for two and more (Corollary 2).
    number_of_measurements : int
    weakest : float
        Information of the weakest direction, in units of the information that noise alone would create.
    threshold : float
        Up to this value of ``weakest`` the direction is free.
    """

    is_unique: bool
    free_directions: tuple[FreeDirection, ...]
    rotation_axes: int
    number_of_measurements: int
    weakest: float
    threshold: float


class TestedLater(Protocol):
    """Pairs of one part that can be tested."""

    def verdicts(self, at: slice) -> dict[Pair, PairIdentifiability]:
        """What some of the pairs determine alone."""


class LaterVerdicts(Mapping[Pair, PairIdentifiability]):
    """What each pair determines alone, tested when it is asked for, some pairs at a time: a mapping like a dict.

    A copy, and what is pickled, is a dict with all verdicts.
    """

    def __init__(self, pairs: Sequence[tuple[Pair, ...]], parts: Sequence[TestedLater]) -> None:
        self._parts = tuple(parts)
        self._place = {pair: (p, e) for p, of_part in enumerate(pairs) for e, pair in enumerate(of_part)}
        self._known: dict[Pair, PairIdentifiability] = {}

    def __getitem__(self, pair: Pair) -> PairIdentifiability:
        if pair not in self._known:
            part, e = self._place[pair]
            begin = e - e % TESTED_AT_ONCE
            self._known |= self._parts[part].verdicts(slice(begin, begin + TESTED_AT_ONCE))
        return self._known[pair]

    def __iter__(self) -> Iterator[Pair]:
        return iter(self._place)

    def __len__(self) -> int:
        return len(self._place)

    def __eq__(self, other: object) -> bool:
        return dict(self) == (dict(other) if isinstance(other, Mapping) else other)

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[type[dict[Pair, PairIdentifiability]], tuple[dict[Pair, PairIdentifiability]]]:
        return dict, (dict(self),)


@dataclass(frozen=True)
class Identifiability:
    """What a problem's measurements determine. ``str()`` is a sentence about the pairs and the whole problem.

    Attributes
    ----------
    is_unique : bool
        Whether every frame and scale is determined.
    free_directions : tuple of FreeDirection
        They span all that is free.
    weakest, threshold : float
        As in ``PairIdentifiability``, for the whole problem.
    pairs : mapping of (target, sensor) to PairIdentifiability
        Each pair alone: the grid of the paper's Figure 8. With more than 2,000 pairs each is tested when it is asked
        for.
    parts : tuple of tuple of str
        Frames of each unconnected part.
    """

    is_unique: bool
    free_directions: tuple[FreeDirection, ...]
    weakest: float
    threshold: float
    pairs: Mapping[Pair, PairIdentifiability]
    parts: tuple[tuple[str, ...], ...]

    @staticmethod
    def merged(results: list[Identifiability], components: tuple[tuple[str, ...], ...]) -> Identifiability:
        """One result for parts that were solved separately."""
        weakest = min(results, key=lambda r: r.weakest / max(r.threshold, 1e-300))
        return Identifiability(
            is_unique=all(r.is_unique for r in results),
            free_directions=tuple(direction for r in results for direction in r.free_directions),
            weakest=weakest.weakest,
            threshold=weakest.threshold,
            pairs=_together([r.pairs for r in results]),
            parts=components,
        )

    def __str__(self) -> str:
        alone = sum(pair.is_unique for pair in self.pairs.values())
        if not self.is_unique:
            number = len(self.free_directions)
            return f"The measurements leave {number} direction{'s' if number > 1 else ''} free; see free_directions."
        if len(self.pairs) == 1:
            return "The pair's measurements determine both of its frames."
        if alone:
            number = len(self.pairs)
            if alone == number:
                which = f"Each of the {number} pairs determines its own frames"
            else:
                own = "determines its own frames" if alone == 1 else "determine their own frames"
                which = f"{alone} of {number} pairs {own}, and the other pairs connect the rest to them"
            return f"{which}, so every frame is determined (RWHEC paper, Theorem 3)."
        return "No pair determines its frames on its own; together the pairs determine every frame."


def _together(results: list[Mapping[Pair, PairIdentifiability]]) -> Mapping[Pair, PairIdentifiability]:
    """The verdicts of several parts; those that are tested later stay so."""
    if len(results) == 1:
        return results[0]
    if not any(isinstance(result, LaterVerdicts) for result in results):
        return {pair: value for result in results for pair, value in result.items()}
    return LaterVerdicts([tuple(result) for result in results], [_Tested(result) for result in results])


@dataclass(frozen=True)
class _Tested:
    """The verdicts of one part, by their places."""

    result: Mapping[Pair, PairIdentifiability]

    def verdicts(self, at: slice) -> dict[Pair, PairIdentifiability]:
        return {pair: self.result[pair] for pair in tuple(self.result)[at]}
