"""The folds of a cross-validation: measurements that are held out together."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Literal, NamedTuple

import numpy as np

from gtsam_rwhec.problem.measurements import Measurements
from gtsam_rwhec.problem.pairs import Pair

Split = Literal["time", "pair", "sensor"]


class Fold(NamedTuple):
    """Measurements held out together, as (N,) booleans for each pair that has some, and a name for messages."""

    name: str
    held_out: dict[Pair, np.ndarray]


def folds_of(raw: Mapping[Pair, Measurements], by: Split, number: int) -> Iterator[Fold]:
    """The folds of a split; with ``by="time"`` there are ``number`` folds."""
    if by == "time":
        return _blocks(raw, number)
    return _pairs(raw) if by == "pair" else _halves(raw)


def _in_time(one: Measurements) -> np.ndarray:
    """The rank (N,) of each measurement in time."""
    count = len(one.A)
    if one.stamps_ns is None:
        return np.arange(count)
    rank = np.empty(count, dtype=np.int64)
    rank[np.argsort(one.stamps_ns, kind="stable")] = np.arange(count)
    return rank


def _blocks(raw: Mapping[Pair, Measurements], folds: int) -> Iterator[Fold]:
    # The middle of each measurement's share of the pair: few measurements are spread over all folds.
    block = {pair: ((_in_time(one) + 0.5) * folds / len(one.A)).astype(np.int64) for pair, one in raw.items()}
    for fold in range(folds):
        yield Fold(f"block {fold + 1} of {folds}", {pair: number == fold for pair, number in block.items()})


def _pairs(raw: Mapping[Pair, Measurements]) -> Iterator[Fold]:
    for pair, one in raw.items():
        yield Fold(pair.label, {pair: np.ones(len(one.A), dtype=bool)})


def _halves(raw: Mapping[Pair, Measurements]) -> Iterator[Fold]:
    for sensor in dict.fromkeys(sensor for _, sensor in raw):
        own = {pair: 2 * _in_time(one) < len(one.A) for pair, one in raw.items() if pair.sensor == sensor}
        yield Fold(f"{sensor}, first half", own)
        yield Fold(f"{sensor}, second half", {pair: ~mask for pair, mask in own.items()})
