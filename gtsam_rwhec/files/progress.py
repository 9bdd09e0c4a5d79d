"""The progress of a long calculation: a callable that takes the name of each stage.

A stage with a count is a `Counted`. It is a string as every stage is, so that ``print``, or any other callable that
takes one string, works; a caller that shows a bar or the time left can read its numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

from gtsam_rwhec.errors import OptionError

Progress = Callable[[str], None]


class Counted(str):
    """A stage that counts: "detecting: image 240 of 1004"."""

    __slots__ = ("done", "total", "what")
    what: str  #: The stage without its count, "detecting: image": the same for all counts of one stage
    #: done, total: the number done so far, and the number in all
    done: int
    total: int

    def __new__(cls, what: str, done: int, total: int) -> Self:
        """Make the stage's text from its parts."""
        stage = super().__new__(cls, f"{what} {done} of {total}")
        stage.what, stage.done, stage.total = what, done, total
        return stage

    def __reduce__(self) -> tuple[type[Self], tuple[str, int, int]]:
        return type(self), (self.what, self.done, self.total)


class Remark(str):
    """A message that is shown once and stays visible: "going on with an unfinished run: ..."."""

    __slots__ = ()


@dataclass
class Pace:
    """The speed of a counted stage since its first report."""

    #: begun_s, begun_done: time and count at the first report, so that work of an earlier run does not count
    begun_s: float
    begun_done: int

    def rate(self, stage: Counted, now_s: float) -> float | None:
        """The number done in a second; None as long as it is unknown."""
        done, seconds = stage.done - self.begun_done, now_s - self.begun_s
        return done / seconds if done > 0 and seconds > 0.0 else None

    def left_s(self, stage: Counted, now_s: float) -> float | None:
        """About how many seconds are left; None as long as this is unknown."""
        rate = self.rate(stage, now_s)
        return None if rate is None else max(stage.total - stage.done, 0) / rate


def share(stage: Counted) -> float:
    """The share that is done, 0 to 1."""
    return min(max(stage.done / stage.total, 0.0), 1.0) if stage.total > 0 else 0.0


def duration(seconds: float) -> str:
    """A time in words, rounded because it is an estimate: "40 s", "2 min", "1.5 h"."""
    if seconds < 55.0:
        return f"{max(5 * round(seconds / 5.0), 5)} s" if seconds > 7.5 else f"{max(round(seconds), 1)} s"
    if seconds < 55.0 * 60.0:
        return f"{max(round(seconds / 60.0), 1)} min"
    return f"{seconds / 3600.0:.1f} h"


def check_progress(progress: object) -> None:
    """Raise an OptionError if ``progress`` is not callable."""
    if progress is not None and not callable(progress):
        raise OptionError(
            f"progress is a {type(progress).__name__}; give a callable that takes the name of each stage, such as print"
        )


def silent(stage: str) -> None:
    """Report nothing."""
