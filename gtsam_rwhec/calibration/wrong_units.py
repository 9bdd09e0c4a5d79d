"""Lengths of A and B in different units: what a scale that was said to be 1 tells when it is estimated."""

from __future__ import annotations

from dataclasses import dataclass

from gtsam_rwhec.calibration.readings import Mistake
from gtsam_rwhec.files.rounded_numbers import rounded

#: The number of each unit in a metre.
UNITS = {"millimetres": 1000.0, "centimetres": 100.0, "inches": 1.0 / 0.0254, "feet": 1.0 / 0.3048}
#: A scale within this share of a unit's number is that unit.
UNIT_SHARE = 0.03
#: A scale this close to 1 is no misreading: a size may be wrong by as much, which ``sizes`` tests.
NO_MISREADING = 0.1
#: Median lengths above this (m) are of another unit: few carriers move so far, and few sensors see so far.
LONG_M = 30.0


@dataclass(frozen=True)
class WrongUnit:
    """Which lengths are in another unit, or wrong by a factor, in words; ``of_B`` divides B's lengths as given."""

    mistake: Mistake
    likely: str
    cure: str
    of_B: float


def wrong_unit(scale: float, median_A: float, median_B: float, *, from_corners: bool = False) -> WrongUnit | None:
    """What an estimated scale (lengths in B over those in A) says; None where it is about 1, or not positive.

    ``median_A`` and ``median_B`` are median lengths of the translations as given: the long ones are of another unit.
    ``from_corners``: B is made of corners, so that its unit is that of board_points.
    """
    if not scale > 0.0 or abs(scale - 1.0) < NO_MISREADING:
        return None
    longer, shorter = ("B", "A") if scale > 1.0 else ("A", "B")
    ratio = max(scale, 1.0 / scale)
    for unit, number in UNITS.items():
        if abs(ratio / number - 1.0) > UNIT_SHARE:
            continue
        lengths = f"lengths in {longer} are {rounded(ratio, 4)} times those in {shorter}"
        if (median_B if longer == "B" else median_A) > LONG_M or number < 1000.0:
            of_B = number if longer == "B" else 1.0
            if from_corners and longer == "B":
                cure = f"give board_points in metres: divide them by {rounded(number, 4)}"
                return WrongUnit(Mistake.UNIT, f"{lengths}: board_points are in {unit}", cure, of_B)
            cure = f"give metres: divide the translations of {longer} by {rounded(number, 4)}"
            return WrongUnit(Mistake.UNIT, f"{lengths}: {longer} is in {unit}", cure, of_B)
        of_B = 1.0 / number if shorter == "B" else 1.0
        cure = f"give metres: multiply the translations of {shorter} by {rounded(number, 4)}"
        return WrongUnit(Mistake.UNIT, f"{lengths}: those of {shorter} are too small", cure, of_B)
    return WrongUnit(
        Mistake.SCALE,
        f"lengths in B are {rounded(scale, 4)} times the true ones, and were said to be true (scale='known')",
        "measure the targets again and state their true sizes, or let the scale be estimated (scale='shared')",
        scale,
    )
