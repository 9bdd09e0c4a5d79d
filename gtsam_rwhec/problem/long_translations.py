"""Translations that look like millimetres: one warning for all pairs of a call."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.errors import UnitsWarning
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.moments import BLOCK, Gauge

#: Translations with a median size beyond this, in metres, look like millimetres: no camera sees a tag at 100 m.
MILLIMETRES_M = 100.0
#: A warning names so many pairs; it counts the others.
MOST_NAMED = 3


@dataclass(frozen=True)
class LongTranslations:
    """The median sizes of A's and B's translations in a batch (m) that are too long, by "A" and "B", and where.

    ``from_corners``: B is made of corners, in the unit of their board.
    """

    where: str
    sizes: dict[str, float]
    from_corners: bool = False

    @staticmethod
    def of(
        A: Array, B: Array, gauge: Gauge, motion: bool, where: str, *, from_corners: bool = False
    ) -> LongTranslations:
        """Look at a batch; A is taken about the gauge, so that a distant world origin is not too long."""
        c = gauge.sensor_carrier if motion else gauge.target_carrier
        centred_A = A[:BLOCK, :3, 3] + A[:BLOCK, :3, :3] @ c - gauge.sensor_carrier
        # What a sensor sees (B) is never far.
        found = {"A": centred_A, "B": B[:BLOCK, :3, 3]}
        sizes = {name: float(np.median(np.abs(t).max(axis=1))) for name, t in found.items()}
        long = {name: size for name, size in sizes.items() if size > MILLIMETRES_M}
        return LongTranslations(where, long, from_corners)


def warn_of_millimetres(found: Sequence[LongTranslations], stacklevel: int) -> None:
    """Warn once of all batches whose translations look like millimetres."""
    long = [each for each in found if each.sizes]
    if not long:
        return
    sides = sorted({name for each in long for name in each.sizes})
    sizes = [f"{np.median([each.sizes[name] for each in long if name in each.sizes]):.4g}" for name in sides]
    named = ", ".join(each.where for each in long[:MOST_NAMED])
    more = f" and {len(long) - MOST_NAMED} more" if len(long) > MOST_NAMED else ""
    cure = "Give metres: divide by 1000"
    if "B" in sides and all(each.from_corners for each in long):
        also = ", and A too" if "A" in sides else ""
        cure = f"B is made of board_points: give these in metres, divided by 1000{also}"
    warnings.warn(
        f"{named}{more}: translations of {' and '.join(sides)} have a median size of {' and '.join(sizes)}; this looks "
        f"like millimetres. {cure}. (This is said once for all pairs of a problem)",
        UnitsWarning,
        stacklevel=stacklevel + 1,
    )
