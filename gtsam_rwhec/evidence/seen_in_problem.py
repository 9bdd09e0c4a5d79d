"""What was seen in a problem: its measurements, and the corners where it has them. There are no images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import numpy as np

from gtsam_rwhec.errors import CountError
from gtsam_rwhec.evidence.measured import MeasuredRows
from gtsam_rwhec.evidence.seen import PIECES, SeenEvidence
from gtsam_rwhec.evidence.seen_cameras import rated_views, seen_cameras, worst_image, worst_views
from gtsam_rwhec.evidence.seen_tracks import counts_of, removed_list, span_of, tracks_of
from gtsam_rwhec.evidence.seen_views import SeenView, board_of
from gtsam_rwhec.fitting.pair_data import local_paths
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.trajectories.trajectory import Trajectory

#: The stage that removes measurements of a problem.
ROBUST = "robust estimation"


def seen_in_problem(
    problem: Problem, refined: Refined | None, rows: Mapping[Pair, MeasuredRows], carrier_path: Trajectory | None = None
) -> SeenEvidence:
    """What was seen, of a problem and its measurements; corners are there where there is a refined calibration."""
    used = sum(int(measured.used.sum()) for measured in rows.values())
    views = {} if refined is None else _views(problem, refined, rows, carrier_path)
    found = None if refined is None else refined.reprojection
    cameras = dict(problem.cameras)
    if refined is not None:
        cameras |= {sensor: one.camera for sensor, one in refined.intrinsics.items()}
    noise = (problem.corner_px or 0.1) if found is None else found.corner_px
    rated = rated_views(views, cameras, found, lambda target, sensor: noise)
    is_stamped = span_of(rows.values())[1] is not None
    return SeenEvidence(
        span_s=span_of(rows.values())[1],
        pieces=PIECES,
        tracks=tracks_of(rows, lambda reason: ROBUST),
        used=used,
        removed=sum(len(measured.reasons) for measured in rows.values()) - used,
        removed_counts=counts_of(
            ((pair, Counter(measured.reasons)) for pair, measured in rows.items()), lambda reason: ROBUST
        ),
        removed_list=removed_list(rows, lambda sensor, stamp: str(stamp)),
        cameras=seen_cameras(rated, cameras, found),
        worst=tuple(
            worst_image(one, str(one.view.stamp_ns) if is_stamped else f"measurement {one.view.stamp_ns}")
            for one in worst_views(rated)
        ),
        no_pictures="the measurements were given without images.",
    )


def _views(
    problem: Problem, refined: Refined, rows: Mapping[Pair, MeasuredRows], path: Trajectory | None
) -> dict[str, list[SeenView]]:
    """The corners of a problem's images, by sensor, with A at the final time offsets."""
    late = dict(refined.time_offsets_s)
    try:
        paths = local_paths(problem, tuple(late), path)
    except CountError:  # the motion that gave the offsets is not known here: A as it was measured is what is left
        paths = {}
    views: dict[str, list[SeenView]] = {}
    for pair, measured in rows.items():
        pixels = problem.measurements(*pair).pixels
        if pixels is None or pair.target not in refined.X or pair.sensor not in refined.Y:
            continue
        A = measured.A @ paths[pair].motion(late[pair.sensor]) if pair in paths else measured.A
        T = np.linalg.inv(refined.Y[pair.sensor].matrix()) @ A
        X, board = refined.X[pair.target].matrix(), board_of(refined, pair.target, problem.boards[pair.target])
        seen: np.ndarray = np.asarray(np.isfinite(pixels).all(axis=2))
        for i in np.flatnonzero(seen.any(axis=1)).tolist():
            stamp = i if measured.stamps_ns is None else int(measured.stamps_ns[i])
            views.setdefault(pair.sensor, []).append(
                SeenView.of(
                    pixels[i, seen[i]], board[seen[i]], T[i], X, stamp, pair.target, is_used=not measured.reasons[i]
                )
            )
    return views
