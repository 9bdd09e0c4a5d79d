"""What the poses of targets in images say first: outliers, time offsets and sizes."""

from __future__ import annotations

from dataclasses import dataclass, field

from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.results.log_history import SizeFields
from gtsam_rwhec.runs.solving_rounds import SolvingRounds, SynchronisedPairs


@dataclass(frozen=True, eq=False)
class SettledPoses:
    """The measurements with outliers marked, and A at the time offsets; and what they say about sizes.

    Attributes
    ----------
    pairs : SynchronisedPairs
    sizes : tuple of SizeFields
    free : frozenset of str
        Targets whose size is estimated.
    refined : Refined or None
        The refinement that says so, where the last round had one.
    """

    pairs: SynchronisedPairs
    sizes: tuple[SizeFields, ...] = ()
    free: frozenset[str] = frozenset()
    refined: Refined | None = field(default=None, repr=False)


def settled_poses(rounds: SolvingRounds, given: SynchronisedPairs) -> SettledPoses:
    """Settle outliers, time offsets and sizes."""
    rig = rounds.rig
    if rig.sizes == "known":
        settled, refined = rounds.settled(given, ())
        return SettledPoses(settled, rounds.sizes_as_seen(settled), refined=refined)
    sizes, given = rounds.sizes(given)
    free: frozenset[str] = frozenset()
    if any(size.is_free for size in sizes):
        free = frozenset(rig.targets) - {size.target for size in sizes if not size.is_free}
    settled, refined = rounds.settled(given, free)
    return SettledPoses(settled, sizes, free, refined)
