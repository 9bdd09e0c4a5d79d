"""Merging partial results: a binary tree that the order of the keys fixes, so that every run has the same sums.

The leaves are in the order of their keys. Neighbours are added, then the sums of neighbours, and so on; the last of an
odd number goes up as it is. Who adds, and when, does not change a bit. Where there are many, chunks of the tree are
tasks of their own, whose files have the sums (`merge_task`).
"""

from __future__ import annotations

from collections.abc import Sequence

from gtsam_rwhec.fleet.pair_moments import PairMoments

#: A task merges so many files: a power of two, so that chunks of the tree are subtrees of it.
CHUNK = 16


def merged(leaves: Sequence[PairMoments]) -> PairMoments:
    """The sum of all; at least one."""
    level = list(leaves)
    while len(level) > 1:
        above = [first.added(second) for first, second in zip(level[::2], level[1::2], strict=False)]
        level = above + level[len(level) - len(level) % 2 :]
    return level[0]
