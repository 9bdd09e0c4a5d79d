"""Which measurements agree with the answer under the noise that the data have.

Outliers are found first under noise that is the same for all, to which drift and the noise of A are strange. So every
measurement is judged again: those that are left out have no weight, and the drift at their instants comes from their
neighbours. What is then left of the residual is compared with the noise of single measurements.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import fdtri

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.noise_model.components import C
from gtsam_rwhec.noise_model.drift import drift_columns
from gtsam_rwhec.noise_model.rows import Instants
from gtsam_rwhec.noise_model.settling import SETTLED, Settled, Task, moved
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.refinement.options import RefineOptions
from gtsam_rwhec.refinement.refining import data_of
from gtsam_rwhec.refinement.variables import Variables

#: A good measurement is left out in so many of a hundred logs.
FALSE_ALARM = 0.05
#: A measurement that is left out keeps this part of its weight.
WEIGHTLESS = 1e-8
#: The unknowns are settled in at most so many steps, with the measurements that are left out.
STEPS = 4
#: A track without any kept measurement is this many steps from one.
LONGEST = 1e6


def agreeing(
    whole: Problem, inliers: dict[Pair, np.ndarray], task: Task, found: Settled, how: RefineOptions
) -> dict[Pair, np.ndarray]:
    """By pair, (N,) booleans: the measurements that agree. Those of frames that the answer lacks stay left out.

    Parameters
    ----------
    whole : Problem
        With all measurements.
    inliers : dict of (target, sensor) to (N,) booleans
        Those from which the answer comes.
    """
    known = set(found.state.X) | set(found.state.Y)
    pairs = [pair for pair in whole.pairs if known.issuperset(pair)]
    judged = whole.with_measurements({pair: whole.measurements(*pair) for pair in pairs})
    variables = Variables.of(judged, tuple(task.variables.offsets))
    data = [
        replace(item, covariance=np.where(inliers[item.pair][:, None, None], 1.0, 1.0 / WEIGHTLESS) * item.covariance)
        for item in data_of(judged, variables, how)
    ]
    everything = replace(task, problem=judged, data=data, variables=variables, instants=Instants.of(data))
    walk = None if found.model.drift is None else found.model.drift.walk
    sigma = found.fit.sizes.values(found.fit.logs)
    is_systematic = found.model.features.shape[1] > 0
    state = found.state
    for _ in range(STEPS):
        there = everything.model(state, found.model.side, walk, systematic=is_systematic)
        optimum, eliminated = there.eliminated(sigma)
        if (np.abs(optimum.step) < SETTLED * np.sqrt(np.diagonal(optimum.covariance))).all():
            break
        state = moved(state, variables, task.layout, there.basis @ optimum.step)
    rows = there.rows
    left = eliminated.left(eliminated.measured.of.columns)
    keep = np.concatenate([inliers[item.pair] for item in data])[rows.instants.order]
    honest = replace(there, rows=replace(rows, given=rows.given * np.where(keep, 1.0, WEIGHTLESS)[:, None, None]))
    E = rows.twist[found.model.side] * np.repeat([sigma[C.CARRIER_ROTATION], sigma[C.CARRIER_TRANSLATION]], 3)
    estimate = found.model.evaluate(sigma)
    J = rows.by_unknowns
    covariance = honest.white(sigma) + E @ E.transpose(0, 2, 1)
    # A measurement that is left out also has the unknowns' error.
    of_unknowns = found.model.basis @ estimate.covariance @ found.model.basis.T
    blocks = of_unknowns[J.places[:, :, None], J.places[:, None]]
    covariance += np.where(keep, 0.0, 1.0)[:, None, None] * (J.values @ blocks @ J.values.transpose(0, 2, 1))
    if there.drift is not None:  # the drift is not known where nothing was measured
        # A rotation's error on the way moves the sensor by the way's length.
        way = 2.0 * float(rows.length.var(axis=0).sum()) if there.drift.correlation == 1.0 else 0.0
        lengthened = float(np.hypot(sigma[C.DRIFT_TRANSLATION], np.sqrt(way) * sigma[C.DRIFT_ROTATION]))
        G = drift_columns(rows, sigma | {C.DRIFT_TRANSLATION: lengthened}, there.drift)
        away = steps_from_kept(rows.instants, keep)
        if there.drift.correlation < 1.0:
            away = 1.0 - there.drift.correlation ** (2.0 * away)
        covariance += away.reshape(-1, 1, 1) * (G @ G.transpose(0, 2, 1))
    squares = np.einsum("ni,ni->n", left, np.linalg.solve(covariance, left[:, :, None])[:, :, 0])
    freedom = max(6 * int(keep.sum()) - found.model.basis.shape[1], 1)
    agrees = squares <= 6.0 * fdtri(6, freedom, 1.0 - FALSE_ALARM / len(squares))
    in_order = np.empty(len(agrees), dtype=bool)
    in_order[rows.instants.order] = agrees
    result = {pair: np.zeros(len(inliers[pair]), dtype=bool) for pair in whole.pairs}
    for item, mask in zip(data, np.split(in_order, np.cumsum([item.count for item in data])[:-1]), strict=True):
        result[item.pair] = mask
    return result


def steps_from_kept(instants: Instants, keep: np.ndarray) -> Array:
    """How many steps (N,) each measurement is from the nearest of its track that is kept."""
    walked = np.cumsum(instants.step)[instants.index]
    track = np.cumsum(instants.step == 0.0)[instants.index] if instants.chains == 1 else instants.chain
    result = np.zeros(len(keep))
    for own in (np.flatnonzero(track == each) for each in np.unique(track)):
        kept = walked[own[keep[own]]]
        if not len(kept):
            result[own] = np.inf
            continue
        after = (
            np.clip(np.searchsorted(kept, walked[own]), 1, len(kept) - 1) if len(kept) > 1 else np.zeros(len(own), int)
        )
        nearest = np.minimum(np.abs(kept[after] - walked[own]), np.abs(kept[after - 1] - walked[own]))
        result[own] = nearest
    return np.where(np.isfinite(result), result, LONGEST)
