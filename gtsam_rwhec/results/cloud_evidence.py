"""Clouds of some views in one frame, as the calibrated poses have them, thinned for a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import gtsam
import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.results.file_record import Count, FileRecord, Rows
from gtsam_rwhec.results.linear_model import MeasuredRows

#: So many views are drawn: there are no more colours that everybody can tell apart.
MOST_VIEWS = 9
#: Points of a view.
POINTS = 1000
#: Decimals of their coordinates, metres.
DECIMALS = 5


class DrawnCloud(FileRecord):
    """The points of one view."""

    sensor: str
    name: str  #: Of the file, else the stamp
    is_used: bool  #: Whether the view is in the answer
    points: Rows  #: (n, 3), in the frame of the targets' carrier; m


class CloudsEvidence(FileRecord):
    """Clouds in one frame."""

    of: Count  #: Of so many views these are a choice, evenly spread
    clouds: tuple[DrawnCloud, ...]


def clouds_of(
    rows: Mapping[Pair, MeasuredRows],
    Y: Mapping[str, gtsam.Pose3],
    clouds: Mapping[str, Mapping[int, tuple[str, Array]]],
) -> CloudsEvidence | None:
    """Clouds as the poses have them; `clouds` has names and points (n, 3) by sensor and stamp. None without any."""
    views = [
        (pair.sensor, *clouds[pair.sensor][stamp], bool(used), se3.inverse(A) @ Y[pair.sensor].matrix())
        for pair, one in rows.items()
        if pair.sensor in clouds and pair.sensor in Y and one.stamps_ns is not None
        for stamp, used, A in zip(one.stamps_ns.tolist(), one.used, one.A, strict=True)
        if stamp in clouds[pair.sensor] and np.isfinite(A).all()
    ]
    if not views:
        return None
    chosen = np.unique(np.linspace(0, len(views) - 1, MOST_VIEWS).round().astype(int))
    return CloudsEvidence(of=len(views), clouds=tuple(_drawn(*views[i]) for i in chosen))


def _drawn(sensor: str, name: str, points: Array, is_used: bool, T: Array) -> DrawnCloud:
    at = np.linspace(0, len(points) - 1, min(POINTS, len(points))).round().astype(int)
    placed = np.round(points[at] @ T[:3, :3].T + T[:3, 3], DECIMALS) + 0.0
    return DrawnCloud(sensor=sensor, name=name, is_used=is_used, points=tuple(map(tuple, placed.tolist())))


def box_of(clouds: Sequence[Array]) -> tuple[Array, Array]:
    """Corners (3,) of the box that holds clouds but for their outermost points: a far background hides the thing."""
    low, high = np.percentile(np.concatenate(clouds), [2.0, 98.0], axis=0)
    return low, high
