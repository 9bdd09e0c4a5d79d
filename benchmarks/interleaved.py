"""Times of several calls taken in turns, so that whatever else the machine does falls on all of them alike."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Times:
    """Seconds of each repetition, by call: arrays (repetitions,)."""

    of: dict[str, NDArray[np.float64]]

    def median(self, name: str) -> float:
        """Median seconds of one call."""
        return float(np.median(self.of[name]))

    def ratio(self, name: str, peer: str) -> float:
        """Median over the repetitions of one call's time over its peer's in the same repetition."""
        return float(np.median(self.of[name] / self.of[peer]))


def interleaved(repetitions: int, calls: dict[str, Callable[[], object]]) -> Times:
    """Time every call ``repetitions`` times in turns, after one round that warms up and does not count."""
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for repetition in range(repetitions + 1):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            elapsed = time.perf_counter() - start
            if repetition:
                seconds[name].append(elapsed)
    return Times({name: np.array(values) for name, values in seconds.items()})


def in_words(seconds: float) -> str:
    """A duration with its unit: "3.42 ms"."""
    if seconds < 1e-3:
        return f"{1e6 * seconds:.0f} us"
    return f"{1e3 * seconds:.3g} ms" if seconds < 1.0 else f"{seconds:.3g} s"
