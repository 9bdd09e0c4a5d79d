"""What the measurements of one pair determine, and what those of the whole problem determine."""

from __future__ import annotations

from dataclasses import dataclass

from gtsam_rwhec.identifiability.free_directions import FreeDirection
from gtsam_rwhec.problem.pairs import Pair


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
    pairs : dict of (target, sensor) to PairIdentifiability
        Each pair alone: the grid of the paper's Figure 8.
    parts : tuple of tuple of str
        Frames of each unconnected part.
    """

    is_unique: bool
    free_directions: tuple[FreeDirection, ...]
    weakest: float
    threshold: float
    pairs: dict[Pair, PairIdentifiability]
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
            pairs={pair: value for r in results for pair, value in r.pairs.items()},
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
