"""What the poses of targets in images say first: outliers, time offsets and sizes."""

from __future__ import annotations

from dataclasses import dataclass

from gtsam_rwhec.pipeline.solving_rounds import SolvingRounds, SynchronisedPairs
from gtsam_rwhec.results.log_history import SizeFields


@dataclass(frozen=True, eq=False)
class SettledPoses:
    """The measurements with outliers marked, and A at the time offsets; and what they say about sizes.

    Attributes
    ----------
    pairs : SynchronisedPairs
    sizes : tuple of SizeFields
    free : frozenset of str
        Targets whose size is estimated.
    """

    pairs: SynchronisedPairs
    sizes: tuple[SizeFields, ...] = ()
    free: frozenset[str] = frozenset()


def settled_poses(rounds: SolvingRounds, given: SynchronisedPairs) -> SettledPoses:
    """Settle outliers, time offsets and sizes."""
    rig = rounds.rig
    if rig.sizes == "known":
        settled = rounds.settled(given, ())
        return SettledPoses(settled, rounds.sizes_as_seen(settled))
    sizes, given = rounds.sizes(given)
    free: frozenset[str] = frozenset()
    if any(size.is_free for size in sizes):
        free = frozenset(rig.targets) - {size.target for size in sizes if not size.is_free}
    return SettledPoses(rounds.settled(given, free), sizes, free)
