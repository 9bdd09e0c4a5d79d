"""Which drift the residuals show: the kind that fits best, where it pays to have one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import get_args

import numpy as np

from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.noise_model.drift import DriftPrior, Frame, Walk
from gtsam_rwhec.noise_model.options import Drift
from gtsam_rwhec.noise_model.reml import ENOUGH, Fitted, fitted
from gtsam_rwhec.noise_model.settling import Settled, Task, start_at, thinned

#: A track has at least this many instants for a drift.
SHORTEST_TRACK = 20
#: Tracks that are seen at the same instants share a state of at most this many tracks.
MOST_TRACKS = 9
#: Kinds of drift that are tried.
FIRST_WALKS: dict[Drift, tuple[Walk, ...]] = {
    "auto": tuple(Walk(each, frame) for each in (1.0, 0.9) for frame in get_args(Frame)),
    "walk": tuple(Walk(1.0, frame) for frame in get_args(Frame)),
    "correlated": tuple(Walk(0.9, frame) for frame in get_args(Frame)),
    "none": (),
}
#: These correlations are tried where the walk is not a random one.
MORE_CORRELATIONS = (0.6, 0.97, 0.99)
#: A drift is in the model when it lowers -2 log of the density by more than this.
PAYS = 6.0
#: A kind's first fit ends where -2 log of the density would fall by less than this; kinds up to so far above the best
#: are fitted to the end.
ROUGH, NEAR = 1.0, 10.0
#: Residuals are correlated in time when their lag-1 correlation is beyond this many standard deviations.
CORRELATED = 2.5


def with_drift(task: Task, steady: Settled, tell: Progress) -> Settled:
    """The best model with drift, where that pays; else the one without."""
    options = task.options
    if options.drift == "none" or why_no_drift(task) or (options.drift == "auto" and not is_correlated(steady)):
        return steady
    tell("estimating drift")
    if isinstance(options.drift, Walk):
        return task.settle(
            steady.state, steady.model.side, options.drift, systematic=options.systematic, near=steady.fit
        )
    thin, systematic = thinned(steady.model), options.systematic

    def best_of(kinds: Sequence[Walk], near: Fitted) -> tuple[Walk, Fitted]:
        """A rough fit of each kind, and a whole one of those that are near the best."""

        def fit(kind: Walk, near: Fitted, enough: float) -> Fitted:
            name = "a random walk" if kind.correlation == 1.0 else f"correlation {kind.correlation:g}"
            tell(f"estimating drift: {name}")
            model, whole = (replace(each, drift=DriftPrior.of(each.rows, kind)) for each in (thin, steady.model))
            sizes = task.sizes(whole, systematic=systematic)
            return fitted(model, sizes, start_at(sizes, near), enough=enough)

        rough = [(kind, fit(kind, near, ROUGH)) for kind in kinds]
        most = min(map(_height, rough)) + NEAR
        return min(((kind, fit(kind, one, ENOUGH)) for kind, one in rough if _height((kind, one)) <= most), key=_height)

    kind, walk = best_of(FIRST_WALKS[options.drift], steady.fit)
    if kind.correlation < 1.0:
        more = best_of([Walk(each, kind.frame) for each in MORE_CORRELATIONS], walk)
        kind, walk = min((kind, walk), more, key=_height)
    if options.drift == "auto" and walk.objective > steady.fit.objective - PAYS:
        return steady
    return task.settle(steady.state, steady.model.side, kind, systematic=systematic, near=walk)


def why_no_drift(task: Task) -> str:
    """Why no drift can be looked for; empty where it can."""
    instants = task.instants
    if instants.chains > MOST_TRACKS:
        return (
            f"{instants.chains} pairs are measured at the same instants, and it can take {MOST_TRACKS} at most; "
            "errors of neighbours in time are not clearly alike"
        )
    if instants.count < SHORTEST_TRACK * len(task.data) / instants.chains:
        return f"it takes {SHORTEST_TRACK} instants of each pair, one after the other"
    return ""


def _height(tried: tuple[Walk, Fitted]) -> float:
    """-2 log of the density; more for a random walk, which says that the first instant has no error."""
    kind, fit = tried
    return fit.objective + (PAYS if kind.correlation == 1.0 else 0.0)


def is_correlated(found: Settled, limit: float = CORRELATED) -> bool:
    """Whether residuals of neighbours in time are alike, track by track."""
    rows = found.model.rows
    tracks = np.cumsum(rows.instants.step[rows.instants.index] == 0.0) if rows.instants.chains == 1 else None
    groups = rows.instants.chain if tracks is None else tracks
    return likeness_of_neighbours([rows.residual[groups == group] for group in np.unique(groups)]) > limit


def likeness_of_neighbours(tracks: Sequence[Array]) -> float:
    """The lag-1 correlation of residuals (N, 6), track by track, in the standard deviations of independent ones."""
    products, squares, count = np.zeros(6), np.zeros(6), 0
    for track in tracks:
        if len(track) > 1:
            r = track - track.mean(axis=0)
            products += (r[1:] * r[:-1]).sum(axis=0)
            squares += (r**2).sum(axis=0)
            count += len(r) - 1
    correlation = products / np.maximum(squares, 1e-300)
    return float(correlation.mean() * np.sqrt(6 * max(count, 1)))
