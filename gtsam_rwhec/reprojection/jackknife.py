"""How much estimates from parts of the images differ, over what their covariance says: the jackknife by blocks.

With m blocks of images left out in turns, the variance of an estimate is (m - 1) / m times the sum of the squares of
these estimates about their mean, whatever the errors are: an arm's that the model lacks go into intrinsics too.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.reprojection.refined import CornersRefined


def spread_over_claims(refined: CornersRefined, parts: Sequence[CornersRefined]) -> dict[tuple[str, str], float]:
    """By unknown: the jackknife's deviation over the claimed one, root mean square of its numbers.

    Parameters
    ----------
    refined : CornersRefined
        From all images.
    parts : sequence of CornersRefined
        From all but one block each.
    """
    m = len(parts)
    found = {}
    for slot, rows in refined.slots.items():
        off = np.array([_off(refined, part, slot) for part in parts])
        variances = (m - 1) / m * ((off - off.mean(axis=0)) ** 2).sum(axis=0)
        found[slot] = float(np.sqrt((variances / np.diagonal(refined.joint)[rows]).mean()))
    return found


def _off(refined: CornersRefined, part: CornersRefined, slot: tuple[str, str]) -> Array:
    """How far a part's unknown is from that of all images."""
    letter, name = slot
    point, other = refined.point, part.point
    if letter in "xy":
        first, second = (each.X if letter == "x" else each.Y for each in (refined, part))
        moved: Array = gtsam.Pose3.Logmap(first[name].between(second[name]))
        return moved
    if letter == "k":
        return other.cameras[name] - point.cameras[name]
    if letter == "b":
        changed: Array = (other.shapes[name] - point.shapes[name])[refined.graph.model.free_shape(name)]
        return changed
    if letter == "t":
        return np.array([other.offsets_s.get(name, 0.0) - point.offsets_s.get(name, 0.0)])
    return (other.corners[name] - point.corners[name]).ravel()
