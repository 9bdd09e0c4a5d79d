"""A model of the noise settled: components and unknowns in turn, until both stay the same."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.identifiability.free_directions import FreeDirection
from gtsam_rwhec.noise_model.components import Sizes
from gtsam_rwhec.noise_model.drift import DriftPrior, Walk
from gtsam_rwhec.noise_model.likelihood import NoiseModel
from gtsam_rwhec.noise_model.options import NoiseOptions
from gtsam_rwhec.noise_model.prior_knowledge import prior_terms
from gtsam_rwhec.noise_model.reml import Fitted, fitted
from gtsam_rwhec.noise_model.rows import Instants, Rows, Side
from gtsam_rwhec.noise_model.typical import QUIETEST, typical_sizes
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.refinement.joint_covariance import JointCovariance
from gtsam_rwhec.refinement.pair_data import PairData
from gtsam_rwhec.refinement.unknowns import UnknownKind
from gtsam_rwhec.refinement.variables import State, Variables

#: Components and unknowns are estimated in turn at most this many times.
ROUNDS = 4
#: The unknowns are settled when they move by less than this part of their standard deviation.
SETTLED = 0.05
#: Components are estimated from at most about this many instants; the unknowns, from all.
INSTANTS = 300
#: The rows at so many estimates are kept.
KEPT = 3
#: In fewer rows the unknowns have this share of the information of all rows on top.
HELD = 1e-3


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
    #: Is told each round, so that a long model is seen to move.
    tell: Progress = silent
    _known: list[tuple[State, Rows]] = field(default_factory=list, init=False, repr=False, compare=False)

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
        rows = self._rows(state)
        drift = None if walk is None else DriftPrior.of(rows, walk)
        features = rows.features(side) if systematic else np.zeros((len(rows.residual), 0))
        information, gradient = prior_terms(self.problem, self.variables, state, self.layout, self.basis)
        return NoiseModel(rows, side, self.basis, information, gradient, drift, features)

    def _rows(self, state: State) -> Rows:
        """The rows at an estimate; those at the last ones are kept, since several models begin where one ended."""
        for known, rows in self._known:
            if known is state:
                return rows
        self._known.append((state, Rows.of(self.data, self.variables, state, self.layout, self.instants)))
        del self._known[:-KEPT]
        return self._known[-1][1]

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
            if (np.abs(whole.step) < SETTLED * np.sqrt(np.diagonal(whole.covariance))).all():
                break
        return Settled(state, self.model(state, side, walk, systematic=systematic), fit)


def start_at(sizes: Sizes, near: Fitted | None) -> Array:
    """Logarithms (k,) from which components are fitted: those of a similar model, others as expected."""
    known = {} if near is None else dict(zip(near.sizes.active, near.logs, strict=True))
    return np.array([known.get(c, e) for c, e in zip(sizes.active, sizes.expected, strict=True)])


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
    held = model.prior_information + HELD * (model.basis.T @ model.rows.by_unknowns.gram(size) @ model.basis)
    return replace(model, rows=rows, drift=drift, features=model.features[kept], prior_information=held)


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
