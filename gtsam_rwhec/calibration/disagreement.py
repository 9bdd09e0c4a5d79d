"""Frames that most of their own measurements contradict, by the counts of outliers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from gtsam_rwhec.problem.pairs import Pair

HALF = 0.5
#: Outliers that agree with each other (a planar target's other pose) may be nearly half, and then win by chance.
NEARLY_HALF = 0.42
#: From so many measurements on, nearly half is no accident.
MANY = 10


@dataclass(frozen=True)
class LeftOut:
    """How many measurements of one sensor or target were left out as outliers; ``str()`` is a sentence's part."""

    frame: str
    left_out: int
    measurements: int

    def __str__(self) -> str:
        return f"{self.left_out} of {self.measurements} measurements of {self.frame} contradict the answer"

    def is_beyond(self, share: float) -> bool:
        """Whether more than this share of the measurements are outliers.

        Of few measurements, more than half; where nearly half is asked, half: which half is right was then chance.
        """
        if self.measurements >= MANY:
            return self.left_out > share * self.measurements
        twice = 2 * self.left_out
        return twice > self.measurements or (share < HALF and twice == self.measurements > 0)


def contradicted_frames(
    counts: Mapping[Pair, tuple[int, int]], nearly_half: float = NEARLY_HALF
) -> tuple[LeftOut, ...]:
    """The sensors and targets of which most measurements were left out: more than half, of few half, of many near it.

    ``counts`` has the number that was kept and the number of all, by pair. Where most are outliers the answer is as
    likely to be wrong as they are: a clock, a size or a mounting may have changed. The frame with most outliers comes
    first. Its outliers then count for no other frame: the targets are not to blame for a camera that contradicts all of
    them. So frames with more than half come before those with nearly half: of two cameras that see one target, the
    one that contradicts everything makes half of the target's measurements outliers.
    """
    rest = counts
    everything = _by_frame(counts)
    names: list[str] = []
    for share in (HALF, nearly_half):
        while beyond := [frame for frame in _by_frame(rest).values() if frame.is_beyond(share)]:
            names.append(max(beyond, key=lambda frame: frame.left_out).frame)
            rest = {pair: count for pair, count in rest.items() if names[-1] not in pair}
    # A frame that was seen only together with contradicted frames rests on them.
    known = {*names, *_by_frame(rest)}
    names += [name for name, frame in everything.items() if name not in known and frame.is_beyond(nearly_half)]
    return tuple(everything[name] for name in names)


def _by_frame(counts: Mapping[Pair, tuple[int, int]]) -> dict[str, LeftOut]:
    """The counts of each sensor and target, over all its pairs."""
    left_out, measurements = Counter[str](), Counter[str]()
    for pair, (kept, number) in counts.items():
        for name in pair.frames:
            left_out[name] += number - kept
            measurements[name] += number
    return {name: LeftOut(name, left_out[name], number) for name, number in measurements.items()}
