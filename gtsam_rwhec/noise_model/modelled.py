"""The unknowns under the noise that the data have: components and unknowns in turn, until both stay the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import get_args

import gtsam
import numpy as np

from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.identifiability.free_directions import FreeDirection
from gtsam_rwhec.noise_model.components import Component, Sizes
from gtsam_rwhec.noise_model.drift import DriftPrior, Frame, Walk
from gtsam_rwhec.noise_model.found import Deviation, NoiseInData
from gtsam_rwhec.noise_model.likelihood import NoiseModel
from gtsam_rwhec.noise_model.mixture import SAMPLES, Mixture, mixture_of
from gtsam_rwhec.noise_model.options import Drift, NoiseOptions
from gtsam_rwhec.noise_model.prior_knowledge import prior_terms
from gtsam_rwhec.noise_model.reml import Fitted, fitted
from gtsam_rwhec.noise_model.rows import Instants, Rows, Side
from gtsam_rwhec.noise_model.typical import QUIETEST, typical_sizes
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.refinement.joint_covariance import JointCovariance
from gtsam_rwhec.refinement.pair_data import PairData
from gtsam_rwhec.refinement.unknowns import Unknown, UnknownKind
from gtsam_rwhec.refinement.variables import State, Variables

#: Components and unknowns are estimated in turn at most this many times.
ROUNDS = 4
#: The unknowns are settled when they move by less than this part of their standard deviation.
SETTLED = 0.05
#: Components are estimated from at most about this many instants; the unknowns, from all.
INSTANTS = 300
#: A dense log has fewer samples of the components, which are known well.
FEWER_SAMPLES = 16
#: In fewer rows the unknowns have this share of the information of all rows on top.
HELD = 1e-3
#: A track has at least this many instants for a drift.
SHORTEST_TRACK = 20
#: Tracks that are seen at the same instants share a state of at most this many tracks.
MOST_TRACKS = 6
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
#: Residuals are correlated in time when their lag-1 correlation is beyond this many standard deviations.
CORRELATED = 2.5
#: Beyond this many, where no model of it can be tried, the verdict says so.
SURELY_CORRELATED = 8.0
#: Before the data, the hand is the carrier that is nearer to its frames: this times log of the ratio of distances.
NEARER = 4.0

C = Component


@dataclass(frozen=True)
class Settled:
    """The model at its optimum, and what simpler models say.

    Attributes
    ----------
    state : State
    model : NoiseModel
    fit : Fitted
    white : Settled or None
        Without drift and systematic errors.
    drift_evidence, systematic_evidence : float
        How much -2 log of the density falls with drift, and with systematic errors.
    """

    state: State
    model: NoiseModel
    fit: Fitted
    white: Settled | None = None
    drift_evidence: float = 0.0
    systematic_evidence: float = 0.0


@dataclass(frozen=True)
class Task:
    """What stays the same while components and unknowns are estimated."""

    problem: Problem
    data: list[PairData]
    variables: Variables
    layout: JointCovariance
    instants: Instants
    options: NoiseOptions
    free_directions: tuple[FreeDirection, ...] = ()

    @property
    def basis(self) -> Array:
        """(d, p): the determined directions of the unknowns."""
        free, unit = self.layout.free, self.layout.unit
        if not free.shape[1]:
            return np.diag(unit)
        rest: Array = unit[:, None] * np.linalg.svd(free, full_matrices=True)[0][:, free.shape[1] :]
        return rest

    def model(self, state: State, side: Side, walk: Walk | None, *, systematic: bool) -> NoiseModel:
        """The model about an estimate, from all measurements."""
        rows = Rows.of(self.data, self.variables, state, self.layout, self.instants)
        drift = None if walk is None else DriftPrior.of(rows, walk)
        features = rows.features(side) if systematic else np.zeros((len(rows.residual), 0))
        information, gradient = prior_terms(self.problem, self.variables, state, self.layout, self.basis)
        return NoiseModel(rows, side, self.basis, information, gradient, drift, features)

    def sizes(self, model: NoiseModel, *, systematic: bool) -> Sizes:
        """The components' ranges, by the residuals at the start."""
        typical = typical_sizes(
            model.rows, model.drift, has_scale=bool(self.variables.scale_of_pair),
            carrier=self.options.carrier, systematic=systematic and model.features.shape[1] > 0,
        )  # fmt: skip
        return Sizes.of(typical, {c: s for c, s in self.options.stated.items() if c in typical})

    def settle(
        self,
        start: State,
        side: Side,
        walk: Walk | None,
        *,
        systematic: bool,
        near: Fitted | None = None,
        rounds: int = ROUNDS,
    ) -> Settled:
        """Components and unknowns in turn; ``near`` has components of a similar model."""
        state, sizes, logs = start, None, None
        for _ in range(rounds):
            model = self.model(state, side, walk, systematic=systematic)
            sizes = self.sizes(model, systematic=systematic) if sizes is None else sizes
            if logs is None:
                known = {} if near is None else dict(zip(near.sizes.active, near.logs, strict=True))
                logs = np.array([known.get(c, e) for c, e in zip(sizes.active, sizes.expected, strict=True)])
            fit = fitted(thinned(model), sizes, logs)
            logs = fit.logs
            whole = model.evaluate(sizes.values(logs))
            state = moved(state, self.variables, self.layout, model.basis @ whole.step)
            if (np.abs(whole.step) < SETTLED * np.sqrt(np.diagonal(whole.covariance))).all():
                break
        return Settled(state, self.model(state, side, walk, systematic=systematic), fit)


def thinned(model: NoiseModel) -> NoiseModel:
    """The model of fewer instants, where there are very many."""
    every = -(-model.rows.instants.count // INSTANTS)
    if every == 1:
        return model
    rows = model.rows.thinned(every)
    kept = np.isin(model.rows.instants.order, rows.instants.order)
    drift = None if model.drift is None else DriftPrior.of(rows, model.drift.walk)
    # Frames that are not seen in these rows are held by a little of what all rows know of them.
    size = np.sqrt((model.rows.residual**2).mean(axis=0)) + QUIETEST
    J = (model.rows.jacobian @ model.basis / size[:, None]).reshape(-1, model.basis.shape[1])
    held = model.prior_information + HELD * (J.T @ J)
    return replace(model, rows=rows, drift=drift, features=model.features[kept], prior_information=held)


def settled(task: Task, start: State, tell: Progress, before: Settled | None = None) -> Settled:
    """The side of A's errors, the drift, and the optimum under them.

    ``before`` is the optimum for nearly the same measurements, whose side and drift are kept.
    """
    options = task.options
    if before is not None:
        tell("estimating the noise again")
        drift = before.model.drift
        again = task.settle(
            start, before.model.side, None if drift is None else drift.walk, systematic=options.systematic,
            near=before.fit,
        )  # fmt: skip
        return replace(before, state=again.state, model=again.model, fit=again.fit)
    sides: tuple[Side, ...] = ("targetcarrier", "sensorcarrier") if options.side is None else (options.side,)
    tell("estimating the noise of A and B")
    tried = {side: task.settle(start, side, None, systematic=False) for side in sides}
    lengths = {"targetcarrier": start.X, "sensorcarrier": start.Y}
    nearer = NEARER if all(lengths.values()) else 0.0  # motions alone have frames on one side only
    score = {side: found.fit.objective + nearer * np.log(_distance(lengths[side])) for side, found in tried.items()}
    side = min(score, key=lambda each: score[each])
    white = steady = tried[side]
    if options.systematic:
        steady = task.settle(white.state, side, None, systematic=True, near=white.fit)
    best = with_drift(task, steady, tell)
    drift_evidence, systematic_evidence = steady.fit.objective - best.fit.objective, 0.0
    if options.systematic:
        systematic_evidence = white.fit.objective - steady.fit.objective
        if best is not steady and systematic_evidence > 0.0:  # drift may explain the same
            kind = None if best.model.drift is None else best.model.drift.walk
            without = task.settle(best.state, side, kind, systematic=False, near=best.fit)
            systematic_evidence = without.fit.objective - best.fit.objective
    return replace(best, white=white, drift_evidence=drift_evidence, systematic_evidence=systematic_evidence)


def with_drift(task: Task, steady: Settled, tell: Progress) -> Settled:
    """The best model with drift, where that pays; else the one without."""
    options, instants = task.options, task.instants
    is_long = instants.count >= SHORTEST_TRACK * len(task.data) / instants.chains and instants.chains <= MOST_TRACKS
    if options.drift == "none" or not is_long or (options.drift == "auto" and not is_correlated(steady)):
        return steady
    tell("estimating drift")

    def best_of(kinds: Sequence[Walk], near: Settled) -> tuple[Walk, Settled]:
        tried = [
            (kind, task.settle(near.state, steady.model.side, kind, systematic=systematic, near=near.fit, rounds=1))
            for kind in kinds
        ]
        return min(tried, key=_height)

    systematic = options.systematic
    kind, walk = best_of(FIRST_WALKS[options.drift], steady)
    if kind.correlation < 1.0:
        more = best_of([Walk(each, kind.frame) for each in MORE_CORRELATIONS], walk)
        kind, walk = min((kind, walk), more, key=_height)
    if options.drift == "auto" and walk.fit.objective > steady.fit.objective - PAYS:
        return steady
    return task.settle(walk.state, steady.model.side, kind, systematic=systematic, near=walk.fit)


def _height(tried: tuple[Walk, Settled]) -> float:
    """-2 log of the density; more for a random walk, which says that the first instant has no error."""
    kind, found = tried
    return found.fit.objective + (PAYS if kind.correlation == 1.0 else 0.0)


def is_correlated(found: Settled, limit: float = CORRELATED) -> bool:
    """Whether residuals of neighbours in time are alike: the lag-1 correlation of each track's residuals."""
    rows = found.model.rows
    products, squares, count = np.zeros(6), np.zeros(6), 0
    tracks = np.cumsum(rows.instants.step[rows.instants.index] == 0.0) if rows.instants.chains == 1 else None
    groups = rows.instants.chain if tracks is None else tracks
    for group in np.unique(groups):
        r = rows.residual[groups == group]
        r = r - r.mean(axis=0)
        products += (r[1:] * r[:-1]).sum(axis=0)
        squares += (r**2).sum(axis=0)
        count += len(r) - 1
    correlation = products / np.maximum(squares, 1e-300)
    return bool(correlation.mean() * np.sqrt(6 * max(count, 1)) > limit)


def moved(state: State, variables: Variables, layout: JointCovariance, d: Array) -> State:
    """The estimate after a change (d,) of the unknowns: frames by right perturbations, scales by their logarithms."""
    X, Y, scales, offsets = dict(state.X), dict(state.Y), dict(state.scales), dict(state.offsets_s)
    for unknown, place in layout.slots.items():
        change, owner = d[place], unknown.owner
        if unknown.kind is UnknownKind.FRAME:
            step = gtsam.Pose3.Expmap(change)
            for poses in (X, Y):
                if owner in poses:
                    poses[owner] = poses[owner].compose(step)
        elif unknown.kind is UnknownKind.SCALE:
            scales[unknown] *= float(np.exp(np.clip(change[0] / scales[unknown], -1.0, 1.0)))
        else:
            offsets[owner] += float(change[0])
    return State(X, Y, scales, offsets)


def noise_in(task: Task, found: Settled, mixture: Mixture) -> NoiseInData:
    """What the data say of their noise."""
    white = found.white or found
    middle, low, high = mixture.quantiles((0.5, 0.05, 0.95))
    active = found.fit.sizes.active
    given = np.sqrt(np.einsum("nii->i", found.model.rows.given) / len(found.model.rows.given))
    stated = {C.ROTATION: float(given[:3].mean()), C.TRANSLATION: float(given[3:].mean())}
    simple = white.model.evaluate(white.fit.sizes.values(white.fit.logs)).covariance
    ratios = [0.0]
    for unknown, place in task.layout.slots.items():
        if unknown.kind is UnknownKind.FRAME and not task.layout.free[place].any():
            rows = found.model.basis[place]
            independent, real = (np.linalg.slogdet(rows @ C_all @ rows.T)[1] for C_all in (simple, mixture.covariance))
            ratios.append((independent - real) / 6.0)
    return NoiseInData(
        deviations={
            c: Deviation(*(stated.get(c, 1.0) * float(x) for x in of))
            for c, of in zip(active, zip(middle, low, high, strict=True), strict=True)
        },
        instants=task.instants.count,
        worth=task.instants.count * float(np.exp(min(ratios))),
        hand=found.model.side,
        correlation=None if found.model.drift is None else found.model.drift.walk.correlation,
        frame=None if found.model.drift is None else found.model.drift.walk.frame,
        drift_evidence=found.drift_evidence,
        systematic_evidence=found.systematic_evidence,
        is_drift_untried=task.instants.chains > MOST_TRACKS and is_correlated(found, SURELY_CORRELATED),
        arms_assumed=C.SYSTEMATIC_ROTATION in active,
    )


def mixed(task: Task, found: Settled) -> tuple[JointCovariance, Mixture]:
    """The covariance, with the components' uncertainty mixed in, and the arm's constant error added."""
    is_dense = task.instants.count > INSTANTS
    mixture = mixture_of(thinned(found.model), found.fit, found.model, FEWER_SAMPLES if is_dense else SAMPLES)
    basis = found.model.basis
    state = moved(found.state, task.variables, task.layout, basis @ mixture.step)
    finite = basis @ mixture.covariance @ basis.T + constant_error(task, found, state, mixture)
    return replace(task.layout, finite=finite), mixture


def constant_error(task: Task, found: Settled, state: State, mixture: Mixture) -> Array:
    """The covariance (d, d) of what constant errors of A, of the hand and of the base, add to the frames there.

    A Expmap(c) X = A X Expmap(Ad(X^-1) c), and Expmap(c) A X = Y B the same for Y: no residual shows c, since X or Y
    takes it up. It is tied to the part that varies with the configuration: the same standard deviations. (An assumption
    about arms: the first links' errors move with the base, the last links' with the hand.)
    """
    active = found.fit.sizes.active
    size = len(task.layout.unit)
    if C.SYSTEMATIC_ROTATION not in active:
        return np.zeros((size, size))
    places = [active.index(c) for c in (C.SYSTEMATIC_ROTATION, C.SYSTEMATIC_TRANSLATION)]
    deviations = np.repeat(np.exp(mixture.logs[:, places]), 3, axis=1)  # (samples, 6)
    added = np.zeros((size, size))
    for poses in (state.X, state.Y):
        shift, shares = np.zeros((size, 6)), [0.0]
        for name, pose in poses.items():
            unknown = Unknown(UnknownKind.FRAME, name)
            if unknown in task.layout.slots and name not in task.problem.priors:  # a prior is of the true pose
                rows = task.layout.slots[unknown]
                shift[rows] = pose.inverse().AdjointMap()
                if not task.layout.free[rows].any():
                    shares.append(mixture.share_of(found.model.basis[rows], shift[rows] * deviations[:, None, :]))
        added += (shift * max(shares) * (mixture.weights @ deviations**2)) @ shift.T
    return added


def _distance(poses: dict[str, gtsam.Pose3]) -> float:
    """The typical distance of frames from their carrier, m; without frames, the smallest."""
    return max(float(np.median([float(np.linalg.norm(pose.translation())) for pose in poses.values()] or [0.0])), 1e-6)
