"""Shares of runs, with the interval that their number leaves."""

from __future__ import annotations

from dataclasses import dataclass

from scipy.special import betaincinv


@dataclass(frozen=True)
class Share:
    """``held`` of ``runs``."""

    held: int
    runs: int

    @staticmethod
    def of(outcomes: list[bool]) -> Share:
        """The share of those that are true."""
        return Share(sum(outcomes), len(outcomes))

    @property
    def value(self) -> float:
        """The share, between 0 and 1; nan of no runs."""
        return self.held / self.runs if self.runs else float("nan")

    def interval(self, confidence: float = 0.99) -> tuple[float, float]:
        """Clopper and Pearson's: where the true share is, whatever it is, with at least this probability."""
        if not self.runs:
            return 0.0, 1.0
        held, missed, tail = self.held, self.runs - self.held, (1.0 - confidence) / 2.0
        low = betaincinv(held, missed + 1, tail) if held else 0.0
        high = betaincinv(held + 1, missed, 1.0 - tail) if missed else 1.0
        return float(low), float(high)

    def meets(self, least: float, most: float, confidence: float = 0.99) -> bool:
        """Whether the interval and [least, most] have anything in common."""
        low, high = self.interval(confidence)
        return self.runs > 0 and low <= most and high >= least

    def __str__(self) -> str:
        low, high = self.interval()
        return f"{100 * self.value:.1f} % of {self.runs} [{100 * low:.1f}, {100 * high:.1f}]"
