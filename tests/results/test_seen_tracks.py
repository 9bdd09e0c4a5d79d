"""Detections over time and what was removed: counts are those of the measurements, in few rows of few pieces."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np

from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.results.detection_evidence import (
    MOST_LISTED,
    MOST_ROWS,
    PIECES,
    counts_of,
    removed_list,
    span_of,
    tracks_of,
)


class Marks(NamedTuple):
    stamps_ns: np.ndarray | None
    reasons: tuple[str, ...]


def stage(reason: str) -> str:
    return reason.split()[0]


def marks(number: int, bad: dict[int, str], *, first_ns: int | None = 0) -> Marks:
    stamps = None if first_ns is None else first_ns + 1_000_000_000 * np.arange(number)
    return Marks(stamps, tuple(bad.get(i, "") for i in range(number)))


def test_each_measurement_is_in_its_piece_of_time() -> None:
    pairs = {Pair("tag", "cam"): marks(5, {3: "late one"}), Pair("board", "cam"): marks(3, {}, first_ns=8_000_000_000)}
    assert span_of(pairs.values()) == (0, 10.0)
    tag, board = tracks_of(pairs, stage)
    assert (tag.target, tag.sensor, tag.used, tag.removed) == ("tag", "cam", 4, 1)
    assert tag.used_at == ((0, 1), (PIECES // 10, 1), (PIECES // 5, 1), (2 * PIECES // 5, 1))
    assert tag.removed_at == {"late": ((3 * PIECES // 10, 1),)}
    assert [at for at, _ in board.used_at] == [4 * PIECES // 5, 9 * PIECES // 10, PIECES - 1]


def test_without_stamps_the_order_counts() -> None:
    pairs = {Pair("tag", "cam"): marks(4, {1: "far"}, first_ns=None), Pair("board", "cam"): marks(2, {})}
    assert span_of(pairs.values()) == (0, None)
    tag, board = tracks_of(pairs, stage)
    assert tag.removed_at == {"far": ((PIECES // 4, 1),)}
    assert board.used_at == ((0, 1), (PIECES // 2, 1))
    (only,) = removed_list(pairs, lambda sensor, stamp: "no")
    assert (only.image, only.time_s, only.reason) == ("measurement 1", None, "far")


def test_many_pairs_are_one_row_a_sensor() -> None:
    names = [(f"t{i}", f"c{j}") for i in range(MOST_ROWS) for j in range(2)]
    pairs = {Pair(*name): marks(3, {0: "far"} if name[1] == "c1" else {}) for name in names}
    rows = tracks_of(pairs, stage)
    assert [(row.sensor, row.target, row.used, row.removed) for row in rows] == [
        ("c1", None, 2 * MOST_ROWS, MOST_ROWS),
        ("c0", None, 3 * MOST_ROWS, 0),
    ]
    assert sum(count for _, count in rows[1].used_at) == 3 * MOST_ROWS


def test_all_that_was_removed_is_counted_and_the_first_is_listed() -> None:
    number = MOST_LISTED + 50
    pairs = {Pair("tag", "cam"): marks(number, dict.fromkeys(range(number), "far off"))}
    (count,) = counts_of(((pair, Counter(one.reasons)) for pair, one in pairs.items()), stage)
    assert (count.stage, count.reason, count.count) == ("far", "far off", number)
    listed = removed_list(pairs, lambda sensor, stamp: f"{sensor}_{stamp // 1_000_000_000}.png")
    assert len(listed) == MOST_LISTED
    assert (listed[7].image, listed[7].time_s) == ("cam_7.png", 7.0)
