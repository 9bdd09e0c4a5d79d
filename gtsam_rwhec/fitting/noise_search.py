"""A model of the noise settled: components and unknowns in turn, until both stay the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import gtsam
import numpy as np

from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.fitting.component_posterior import ENOUGH, Fitted, Sizes, fitted
from gtsam_rwhec.fitting.drift import DriftPrior
from gtsam_rwhec.fitting.fit_options import (
    CARRIER,
    DRIFT,
    SYSTEMATIC,
    WHITE,
    About,
    C,
    Component,
    Drift,
    DriftFrame,
    NoiseOptions,
    Walk,
)
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.noise_likelihood import NoiseModel
from gtsam_rwhec.fitting.noise_rows import Instants, Rows, jumps_in, prior_terms
from gtsam_rwhec.fitting.pair_data import PairData
from gtsam_rwhec.fitting.unknowns import State, UnknownKind, Variables
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.free_directions import FreeDirection

#: Components and unknowns are estimated in turn at most this many times.
ROUNDS = 4
#: The unknowns are settled when they move by less than this part of their standard deviation.
SETTLED = 0.05
#: Derivatives' noise counts where it changes a standard deviation by this share.
FAKE = 0.02
#: Components are estimated from at most about this many instants; the unknowns, from all.
INSTANTS = 300
OTHER_SIDE: dict[About, About] = {"targetcarrier": "sensorcarrier", "sensorcarrier": "targetcarrier"}
#: The rows at so many estimates are kept.
KEPT = 3
#: In fewer rows the unknowns have this share of the information of all rows on top: some see not every frame.
HELD = 1e-3


@dataclass(frozen=True)
class Settled:
    """The model at its optimum, and what simpler models say."""

    state: State
    model: NoiseModel
    fit: Fitted
    #: Without drift and systematic errors.
    white: Settled | None = None
    #: How much -2 log of the density falls with drift, and with systematic errors.
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
    #: Is told each round, so that a long model is seen to move.
    tell: Progress = silent
    #: The instants at which tracks are cut.
    jumps: tuple[int, ...] = ()
    #: (N, 6): The white noise of S = Y^-1 A X, where derivatives are without it.
    noisy: Array | None = None
    _known: list[tuple[State, Rows]] = field(default_factory=list, init=False, repr=False, compare=False)

    @cached_property
    def basis(self) -> Array:
        """(d, p): the determined directions of the unknowns."""
        free, unit = self.layout.free, self.layout.unit
        if not free.shape[1]:
            return np.diag(unit)
        rest: Array = unit[:, None] * np.linalg.svd(free, full_matrices=True)[0][:, free.shape[1] :]
        return rest

    def model(self, state: State, side: About, walk: Walk | None, *, systematic: bool) -> NoiseModel:
        """The model about an estimate, from all measurements."""
        rows = self._rows(state)
        features = rows.features(side) if systematic else np.zeros((len(rows.residual), 0))
        information, gradient, cost = prior_terms(self.problem, self.variables, state, self.basis)
        model = NoiseModel(rows, side, self.basis, information, gradient, None, features, cost)
        return model if walk is None else drifting(model, walk)

    def model_like(self, model: NoiseModel, state: State) -> NoiseModel:
        """A model of the same kind about another estimate."""
        walk = None if model.drift is None else model.drift.walk
        return self.model(state, model.side, walk, systematic=model.features.shape[1] > 0)

    def _rows(self, state: State) -> Rows:
        """The rows at an estimate; those at the last ones are kept, since several models begin where one ended."""
        for known, rows in self._known:
            if known is state:
                return rows
        found = Rows.of(self.data, self.variables, state, self.layout, self.instants, self.noisy)
        self._known.append((state, found))
        del self._known[:-KEPT]
        return self._known[-1][1]

    def on_the_other_side(self, found: Settled, white: Fitted, favour: float) -> Settled:
        """The optimum with A's errors on the other side, if a drift leads there; else the one that was found.

        ``white`` is what that side's white noise looked like; -2 log of the density may be more by ``favour``.
        """
        if found.model.drift is None:
            return found
        walk, side = found.model.drift.walk, OTHER_SIDE[found.model.side]
        walk = Walk(walk.correlation, side) if walk.is_shared else walk
        systematic = found.model.features.shape[1] > 0
        model = self.model(found.state, side, walk, systematic=systematic)
        sizes = self.sizes(model, systematic=systematic)
        start = np.where([c in DRIFT for c in sizes.active], start_at(sizes, found.fit), start_at(sizes, white))
        rough = fitted(thinned(model), sizes, start, enough=ROUGH)
        if rough.objective > found.fit.objective + favour:
            return found
        return self.settle(found.state, side, walk, systematic=systematic, near=rough)

    def without_noise(self, found: Settled) -> tuple[Task, Settled]:
        """The task with derivatives that are without white noise, and the optimum then.

        It matters where a motion hardly excites a direction: a vehicle's heights were 5 standard deviations off.
        """
        task, deviations = self, _deviations(found.model, found)
        for _ in range(ROUNDS):
            task = replace(self, noisy=noise_of_predictions(found))
            model = task.model_like(found.model, found.state)
            after = _deviations(model, found)
            if (np.abs(after / deviations - 1.0) < FAKE).all():
                return task, replace(found, model=model)
            walk = None if model.drift is None else model.drift.walk
            systematic = model.features.shape[1] > 0
            again = task.settle(found.state, model.side, walk, systematic=systematic, near=found.fit)
            found, deviations = replace(found, state=again.state, model=again.model, fit=again.fit), after
        return task, found

    def without_false_jumps(self, found: Settled) -> tuple[Task, Settled]:
        """The task with whole tracks and its optimum, where that is as likely as one that is cut at jumps."""
        if not self.jumps or found.model.drift is None:  # without a drift a cut changes nothing
            return replace(self, jumps=()), found
        whole = replace(self, instants=Instants.of(self.data), jumps=())
        walk, systematic = found.model.drift.walk, found.model.features.shape[1] > 0
        again = whole.settle(found.state, found.model.side, walk, systematic=systematic, near=found.fit)
        if again.fit.objective > found.fit.objective + PAYS * len(self.jumps):
            return self, found
        return whole, replace(found, state=again.state, model=again.model, fit=again.fit)

    def cut_at_jumps(self, state: State) -> Task:
        """The task with the tracks cut where residuals at an estimate jump: a drift does not reach across."""
        jumps = jumps_in(self._rows(state).residual, self.instants)
        return replace(self, instants=self.instants.cut(jumps), jumps=tuple(jumps.tolist())) if len(jumps) else self

    def sizes(self, model: NoiseModel, *, systematic: bool) -> Sizes:
        """The components' ranges, by the residuals at the start."""
        systematic = systematic and model.features.shape[1] > 0
        typical = typical_sizes(
            model.rows, model.drift, has_scale=bool(self.variables.scale_of_pair), carrier=self.options.carrier,
            systematic=systematic,
        )  # fmt: skip

        return Sizes.of(typical, {c: s for c, s in self.options.stated.items() if c in typical})

    def settle(
        self,
        start: State,
        side: About,
        walk: Walk | None,
        *,
        systematic: bool,
        near: Fitted | None = None,
        rounds: int = ROUNDS,
    ) -> Settled:
        """Components and unknowns in turn; ``near`` has components of a similar model."""
        state, sizes, logs = start, None, None
        what = "errors of the configuration" if systematic else "noise of A and B"
        what = what if walk is None else f"drift, {what}"
        for number in range(1, rounds + 1):
            self.tell(f"estimating {what}: round {number} of at most {rounds}")
            model = self.model(state, side, walk, systematic=systematic)
            sizes = self.sizes(model, systematic=systematic) if sizes is None else sizes
            logs = start_at(sizes, near) if logs is None else logs
            fit = fitted(thinned(model), sizes, logs)
            logs = fit.logs
            whole = model.evaluate(sizes.values(logs))
            state = moved(state, self.variables, self.layout, model.basis @ whole.step)
            if whole.farthest < SETTLED:
                break
        return Settled(state, self.model(state, side, walk, systematic=systematic), fit)


def _deviations(model: NoiseModel, found: Settled) -> Array:
    """Standard deviations (p,) of the unknowns under a model with the components that were found."""
    deviations: Array = np.sqrt(np.diagonal(model.evaluate(found.fit.sizes.values(found.fit.logs)).covariance))
    return deviations


def noise_of_predictions(found: Settled) -> Array:
    """What of the residuals' white noise is in S = Y^-1 A X (N, 6): A's.

    Measurements of one instant share A's noise, and tell it from B's. Of a single one nobody knows whose it is: half.
    """
    eliminated = found.model.eliminated(found.fit.sizes.values(found.fit.logs))
    rows = found.model.rows
    of_A: Array = -(rows.twist[found.model.side] @ eliminated.effects[1][rows.instants.index][:, :, None])[:, :, 0]
    alone = np.bincount(rows.instants.index)[rows.instants.index] == 1
    of_A[alone] = 0.5 * (of_A + eliminated.left(eliminated.measured.of.columns))[alone]
    return of_A


def start_at(sizes: Sizes, near: Fitted | None) -> Array:
    """Logarithms (k,) from which components are fitted: those of a similar model, others as expected."""
    known = {} if near is None else dict(zip(near.sizes.active, near.logs, strict=True))
    return np.array([known.get(c, e) for c, e in zip(sizes.active, sizes.expected, strict=True)])


def thinned(model: NoiseModel) -> NoiseModel:
    """The model of fewer instants, where there are very many."""
    return of_every(model, -(-model.rows.instants.count // INSTANTS), HELD)


def of_every(model: NoiseModel, every: int, share: float) -> NoiseModel:
    """The model of every so-many-th instant of each track; unknowns are held by a share of what all rows know."""
    if every == 1:
        return model
    rows = model.rows.thinned(every)
    kept = np.isin(model.rows.instants.order, rows.instants.order)
    drift = None if model.drift is None else DriftPrior.of(rows, model.drift.walk)
    size = np.sqrt((model.rows.residual**2).mean(axis=0)) + QUIETEST
    held = model.prior_information + share * (model.basis.T @ model.rows.by_unknowns.gram(size) @ model.basis)
    return replace(model, rows=rows, drift=drift, features=model.features[kept], prior_information=held)


def moved(state: State, variables: Variables, layout: JointCovariance, d: Array) -> State:
    """The estimate after a change (d,) of the unknowns: frames by right perturbations, scales by their logarithms."""
    X, Y, scales = dict(state.X), dict(state.Y), dict(state.scales)
    clocks = {UnknownKind.TIME_OFFSET: dict(state.offsets_s), UnknownKind.CLOCK_RATE: dict(state.rates)}
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
            clocks[unknown.kind][owner] += float(change[0])
    return State(X, Y, scales, clocks[UnknownKind.TIME_OFFSET], clocks[UnknownKind.CLOCK_RATE])


#: A track has at least this many instants for a drift, and with fewer than these it is short: a model of drift is tried
#: even where neighbours hardly look alike, and is not trusted where they do.
SHORTEST_TRACK, SHORT_TRACK = 8, 20
#: Tracks that are seen at the same instants share a state of at most this many tracks.
MOST_TRACKS = 9
#: The frames of a track's own drift, and the correlations that are tried first.
OWN_FRAMES: tuple[DriftFrame, ...] = ("sensor", "target", "detection")
FIRST_CORRELATIONS: dict[Drift, tuple[float, ...]] = {
    "auto": (1.0, 0.9), "walk": (1.0,), "correlated": (0.9,), "none": (),
}  # fmt: skip
#: These correlations are tried where the walk is not a random one.
MORE_CORRELATIONS = (0.6, 0.97, 0.99)
#: A drift is in the model when it lowers -2 log of the density by more than this, or by that where neighbours do not
#: look alike (short tracks).
PAYS, PAYS_UNSEEN = 6.0, 10.0
#: A kind's first fit ends where -2 log of the density would fall by less than this; kinds up to so far above the best
#: are fitted to the end.
ROUGH, NEAR = 1.0, 10.0
#: Residuals are correlated in time when their lag-1 correlation is beyond this many standard deviations.
CORRELATED = 2.5
#: A drift's first fit starts where other noise is this much (logarithm) less than without a drift: noise that already
#: explains the drift leaves it nothing, and the fit stood still.
LESS = 1.0


def with_drift(task: Task, steady: Settled, tell: Progress) -> Settled:
    """The best model with drift, where that pays; else the one without."""
    options = task.options
    if options.drift == "none" or why_no_drift(task):
        return steady
    tell("estimating drift")
    if isinstance(options.drift, Walk):
        return task.settle(
            steady.state, steady.model.side, options.drift, systematic=options.systematic, near=steady.fit
        )
    thin, systematic = thinned(steady.model), options.systematic

    def best_of(kinds: Sequence[Walk], near: Fitted, less: float = 0.0) -> tuple[Walk, Fitted]:
        """A rough fit of each kind, and a whole one of those that are near the best."""

        def fit(kind: Walk, near: Fitted, enough: float, less: float = 0.0) -> Fitted:
            name = "a random walk" if kind.correlation == 1.0 else f"correlation {kind.correlation:g}"
            tell(f"estimating drift: {name}")
            model, whole = (drifting(each, kind) for each in (thin, steady.model))
            sizes = task.sizes(whole, systematic=systematic)
            start = start_at(sizes, near) - less * np.isin(sizes.active, near.sizes.active)
            return fitted(model, sizes, start, enough=enough)

        rough = [(kind, fit(kind, near, ROUGH, less)) for kind in kinds]
        most = min(one.objective for _, one in rough) + NEAR
        whole = ((kind, fit(kind, one, ENOUGH)) for kind, one in rough if one.objective <= most)
        return min(whole, key=lambda tried: tried[1].objective)

    kinds = kinds_of(task, steady)
    if not kinds:
        return steady
    kind, walk = best_of(kinds, steady.fit, LESS)
    if kind.correlation < 1.0:
        more = best_of([Walk(each, kind.frame) for each in MORE_CORRELATIONS], walk)
        kind, walk = min((kind, walk), more, key=lambda tried: tried[1].objective)
    enough = steady.fit.objective - (PAYS if is_correlated(steady) else PAYS_UNSEEN)
    if options.drift == "auto" and walk.objective > enough:
        return steady
    found = task.settle(steady.state, steady.model.side, kind, systematic=systematic, near=walk)
    # what paid about the answer without drift may not pay about its own
    pays = options.drift != "auto" or found.fit.objective <= enough
    return found if pays else steady


def kinds_of(task: Task, steady: Settled) -> list[Walk]:
    """The kinds of drift that are tried first: of each track, if these are few, and of A, if tracks share it."""
    kind, chains = task.options.drift, task.instants.chains
    assert not isinstance(kind, Walk)
    is_asked = kind != "auto"
    is_likely = is_asked or is_short(task) or is_correlated(steady)
    frames = [*OWN_FRAMES] if chains <= MOST_TRACKS and is_likely else []
    bodies = int(task.instants.bodies.max()) + 1
    shares = bodies < chains and bodies <= MOST_TRACKS
    frames += [steady.model.side] if shares and (is_asked or frames or is_A_correlated(steady)) else []
    return [Walk(each, frame) for each in FIRST_CORRELATIONS[kind] for frame in frames]


def drifting(model: NoiseModel, walk: Walk) -> NoiseModel:
    """The model with a drift."""
    rows = model.rows.in_one_track() if walk.is_shared else model.rows
    return replace(model, rows=rows, drift=DriftPrior.of(rows, walk))


def why_no_drift(task: Task) -> str:
    """Why no drift can be looked for; empty where it can."""
    if is_short(task, SHORTEST_TRACK):
        return f"it takes {SHORTEST_TRACK} instants of each pair, one after the other"
    return ""


def is_short(task: Task, than: int = SHORT_TRACK) -> bool:
    """Whether tracks have fewer instants than that."""
    return task.instants.count < than * len(task.data) / task.instants.chains


def is_correlated(found: Settled) -> bool:
    """Whether residuals of neighbours in time are alike, track by track."""
    rows = found.model.rows
    tracks = np.cumsum(rows.instants.step[rows.instants.index] == 0.0) if rows.instants.chains == 1 else None
    groups = rows.instants.chain if tracks is None else tracks
    return likeness_of_neighbours([rows.residual[groups == group] for group in np.unique(groups)]) > CORRELATED


def is_A_correlated(found: Settled) -> bool:
    """Whether A's errors of neighbours in time are alike, as all measurements of an instant show them."""
    sigma = found.fit.sizes.values(found.fit.logs)
    instants, effects = found.model.rows.instants, found.model.eliminated(sigma).effects[1]
    bodies = instants.bodies[instants.chain]
    tracks = [effects[np.unique(instants.index[bodies == body])] for body in np.unique(bodies)]
    return likeness_of_neighbours(tracks) > CORRELATED


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


#: No noise is smaller: rad and m.
QUIETEST = 1e-7


def _measured_squares(rows: Rows) -> list[Array]:
    """The mean squares of the rotation residuals, and of the translation residuals, of rows that measure any."""
    has = np.einsum("nii->ni", rows.given) > 0.0
    squares = []
    for part in (slice(0, 3), slice(3, 6)):
        number = has[:, part].sum(axis=1)
        square = np.where(has[:, part], rows.residual[:, part] ** 2, 0.0).sum(axis=1)
        squares.append(square[number > 0] / number[number > 0] if number.any() else np.zeros(1))
    return squares


def typical_sizes(
    rows: Rows, drift: DriftPrior | None, *, has_scale: bool, carrier: bool, systematic: bool
) -> dict[Component, float]:
    """The components that are in the model, with their typical sizes."""
    size_r, size_t = (max(float(np.sqrt(np.median(of))), QUIETEST) for of in _measured_squares(rows))
    given = rows.typical_given
    measures_turns = bool(rows.given[:, :3, :3].any())
    if not measures_turns:  # of points: A turns them by their distance
        size_r = size_t / max(_root_mean_square(rows.predicted[:, :3, 3]), QUIETEST)
    active: list[Component] = [c for c in WHITE if measures_turns or c is not C.ROTATION]
    typical: dict[Component, float] = {
        C.ROTATION: size_r / given[0],
        C.TRANSLATION: size_t / given[1],
        C.DEPTH: size_t,
        C.CARRIER_ROTATION: size_r,
        C.CARRIER_TRANSLATION: size_t,
        C.SYSTEMATIC_ROTATION: size_r,
        C.SYSTEMATIC_TRANSLATION: size_t,
    }
    if carrier:
        active += CARRIER
        speed = np.sqrt((rows.rate**2).mean(axis=0))
        if speed.any():
            active.append(C.JITTER)
            turning, moving = max(float(speed[:3].max()), 1e-12), max(float(speed[3:].max()), 1e-12)
            typical[C.JITTER] = min(size_r / turning, size_t / moving)
    if drift is not None:
        steps = np.sqrt(rows.instants.count / rows.instants.chains) if drift.correlation == 1.0 else 1.0
        length = max(_root_mean_square(rows.length), QUIETEST)
        typical |= {
            C.DRIFT_ROTATION: size_r / steps,
            C.DRIFT_TRANSLATION: size_t / steps,
            C.DRIFT_SCALE: size_t / length / steps,
        }
        # What walks is a trajectory, whose scale may walk too; a tag's size stays, and a late clock looks like that.
        active += DRIFT if has_scale or drift.walk.is_of_a_trajectory else DRIFT[:2]
    if systematic:
        active += SYSTEMATIC
    return {component: typical[component] for component in active}


def _root_mean_square(vectors: Array) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))
