"""Measurements over time, and what was removed of them with its reason: of a log, or of a problem."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gtsam_rwhec.evidence.seen import MOST_LISTED, MOST_ROWS, PIECES, RemovedCount, RemovedMeasurement, SeenTrack
from gtsam_rwhec.problem.pairs import Pair


class Marked(Protocol):
    """Measurements of a pair, each with the reason why it is not used, empty where it is."""

    @property
    def stamps_ns(self) -> np.ndarray | None:
        """(N,) integers, or None."""

    @property
    def reasons(self) -> tuple[str, ...]:
        """Of each measurement."""


@dataclass(frozen=True, eq=False)
class _Row:
    """A row of the figure: where its measurements are in time, and the stage that removed each (empty: it is used)."""

    sensor: str
    target: str | None
    piece: np.ndarray
    stage: np.ndarray


def span_of(pairs: Iterable[Marked]) -> tuple[int, float | None]:
    """The first stamp, and seconds to the last one; None where measurements have no stamps."""
    stamps = [measured.stamps_ns for measured in pairs if len(measured.reasons)]
    known = [each for each in stamps if each is not None]
    if not known or len(known) < len(stamps):
        return 0, None
    first = min(int(each.min()) for each in known)
    return first, 1e-9 * (max(int(each.max()) for each in known) - first)


def tracks_of(pairs: Mapping[Pair, Marked], stage_of: Callable[[str], str]) -> tuple[SeenTrack, ...]:
    """A row for each pair, sensor by sensor; with many pairs one for each sensor, those with the most removed first."""
    first, span = span_of(pairs.values())
    rows = [_row(pair, measured, first, span, stage_of) for pair, measured in pairs.items()]
    rows.sort(key=lambda row: row.sensor)
    if len(rows) > MOST_ROWS:
        of_sensor: dict[str, list[_Row]] = defaultdict(list)
        for row in rows:
            of_sensor[row.sensor].append(row)
        rows = [
            _Row(sensor, None, np.concatenate([r.piece for r in of]), np.concatenate([r.stage for r in of]))
            for sensor, of in of_sensor.items()
        ]
        rows.sort(key=lambda row: -int((row.stage != "").sum()))
    return tuple(_track(row) for row in rows[:MOST_ROWS])


def _row(pair: Pair, measured: Marked, first: int, span: float | None, stage_of: Callable[[str], str]) -> _Row:
    number = len(measured.reasons)
    if span is None or measured.stamps_ns is None:
        share = np.arange(number) / max(number, 1)
    else:
        share = 1e-9 * (measured.stamps_ns - first) / (span or 1.0)
    stages = {reason: stage_of(reason) if reason else "" for reason in set(measured.reasons)}
    stage = np.array([stages[reason] for reason in measured.reasons], dtype="U20")
    return _Row(pair.sensor, pair.target, np.minimum((PIECES * share).astype(int), PIECES - 1), stage)


def _track(row: _Row) -> SeenTrack:
    is_used = row.stage == ""
    stages = np.unique(row.stage[~is_used]).tolist()
    return SeenTrack(
        sensor=row.sensor,
        target=row.target,
        used=int(is_used.sum()),
        removed=int((~is_used).sum()),
        used_at=_counted(row.piece[is_used]),
        removed_at={stage: _counted(row.piece[row.stage == stage]) for stage in stages},
    )


def _counted(pieces: np.ndarray) -> tuple[tuple[int, int], ...]:
    at, count = np.unique(pieces, return_counts=True)
    return tuple(zip(at.tolist(), count.tolist(), strict=True))


def counts_of(
    removed: Iterable[tuple[Pair, Mapping[str, int]]], stage_of: Callable[[str], str]
) -> tuple[RemovedCount, ...]:
    """Counts by pair and reason as records; measurements without a reason are used, and not counted."""
    return tuple(
        RemovedCount(target=pair.target, sensor=pair.sensor, stage=stage_of(reason), reason=reason, count=count)
        for pair, reasons in removed
        for reason, count in reasons.items()
        if reason and count
    )


def removed_list(pairs: Mapping[Pair, Marked], name_of: Callable[[str, int], str]) -> tuple[RemovedMeasurement, ...]:
    """The first removed measurements in order of time; `name_of` has an image's name by sensor and stamp."""
    first, span = span_of(pairs.values())
    found = sorted(_removed(pairs), key=lambda one: (one[0], one[1].sensor, one[1].target))
    return tuple(
        RemovedMeasurement(
            target=pair.target,
            sensor=pair.sensor,
            reason=reason,
            image=f"measurement {stamp}" if span is None else name_of(pair.sensor, stamp),
            time_s=None if span is None else round(1e-9 * (stamp - first), 6),
        )
        for stamp, pair, reason in found[:MOST_LISTED]
    )


def _removed(pairs: Mapping[Pair, Marked]) -> Iterator[tuple[int, Pair, str]]:
    """Stamps, or without them places in the pair, of all that was removed."""
    is_stamped = span_of(pairs.values())[1] is not None
    for pair, measured in pairs.items():
        stamps: Sequence[int] = range(len(measured.reasons))
        if is_stamped and measured.stamps_ns is not None:
            stamps = measured.stamps_ns.tolist()
        yield from ((stamp, pair, why) for stamp, why in zip(stamps, measured.reasons, strict=True) if why)
