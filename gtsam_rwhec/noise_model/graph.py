"""The noise model as a GTSAM graph: drift, systematic errors and the noise of shared carrier poses are its variables.

Every effect has the unit of its own standard deviation, so that its prior is of unit noise:

    x, y, s, d   frames, scales and time offsets, as in every refinement
    w            the drift at each instant: 7 numbers for each track (rotation, translation, logarithm of the scale)
    u            the coefficients of the systematic errors: 6 for each feature of the configuration
    e            the twist of A at an instant, where several measurements share it

With the effects eliminated the graph's information is that of ``NoiseModel`` at the estimate where it was made.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np
from rwhec_factors.with_effects import robot_world_hand_eye_effects_factors

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.noise_model.components import C
from gtsam_rwhec.noise_model.drift import TRACK, DriftPrior, drift_columns
from gtsam_rwhec.noise_model.likelihood import NoiseModel
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.refinement.graph import add_fixed, add_priors
from gtsam_rwhec.refinement.optimisation import Optimum, optimise
from gtsam_rwhec.refinement.pair_data import PairData
from gtsam_rwhec.refinement.variables import State, Variables
from gtsam_rwhec.refinement.weighting import square_root_information

#: A factor has at most about this many numbers of effects that belong to single instants: 10 instants of one track.
COLUMNS = 70
#: A step that lowers the cost by less than this is the last: what is left is far below a thousandth of a deviation.
LAST_STEP = 1e-7
#: Where directions are free, steps of frames, scales and offsets are held by this standard deviation (rad, m, s).
HELD = 10.0
#: The translation's step in a drift is at least this part of what the rotation's step adds to it by its lever.
SMALLEST_STEP = 1e-2
#: The key of the coefficients of the systematic errors.
SYSTEMATIC_KEY: int = gtsam.symbol("u", 0)


def drift_key(instant: int) -> int:
    """Key of the tracks' drift at an instant."""
    key: int = gtsam.symbol("w", instant)
    return key


def twist_key(instant: int) -> int:
    """Key of the twist of A at an instant that several measurements share."""
    key: int = gtsam.symbol("e", instant)
    return key


@dataclass(frozen=True)
class NoiseGraph:
    """A noise model's graph.

    Attributes
    ----------
    graph, values : gtsam.NonlinearFactorGraph, gtsam.Values
        All factors, and the estimate with effects of zero.
    unfixed : gtsam.NonlinearFactorGraph
        The same factors without the constraints of fixed frames: what ``information_of`` takes.
    keys : dict of str to int
        The effects' keys: "drift:INSTANT", "systematic", "carrier:INSTANT"; instants as ``Instants`` counts them.
    """

    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    unfixed: gtsam.NonlinearFactorGraph
    keys: dict[str, int]


@dataclass(frozen=True)
class _Effects:
    """The effects' columns (N, 6, m) in the order of the rows, and the weights of what is left.

    Attributes
    ----------
    root : (N, 6, 6) array
        Square roots of the information of B's noise, and of A's where an instant has one measurement.
    drift, twist, systematic : (N, 6, m) arrays, or None
    shared : (T,) array
        Whether an instant has a twist of its own.
    """

    root: Array
    drift: Array | None
    twist: Array | None
    systematic: Array | None
    shared: np.ndarray

    @staticmethod
    def of(model: NoiseModel, sigma: dict[C, float]) -> _Effects:
        rows = model.rows
        N, index = len(rows.residual), rows.instants.index
        E = rows.twist[model.side] * np.repeat([sigma[C.CARRIER_ROTATION], sigma[C.CARRIER_TRANSLATION]], 3)
        shared = (np.bincount(index, minlength=rows.instants.count) > 1) & bool(E.any())
        alone = ~shared[index]
        covariance = model.white(sigma)
        covariance[alone] += E[alone] @ E[alone].transpose(0, 2, 1)
        systematic = None
        unit = np.repeat([sigma[C.SYSTEMATIC_ROTATION], sigma[C.SYSTEMATIC_TRANSLATION]], 3)
        if model.features.shape[1] and unit.any():
            varying = (rows.twist[model.side] * unit)[:, :, None, :] * model.features[:, None, :, None]
            systematic = varying.reshape(N, 6, -1)
        drift = None if model.drift is None else drift_columns(rows, sigma, model.drift)
        return _Effects(square_root_information(covariance), drift, E if shared.any() else None, systematic, shared)

    def at(self, rows: np.ndarray, instants: np.ndarray) -> dict[int, Array]:
        """The effects of some rows by their keys; ``instants`` are those of these rows."""
        found: dict[int, Array] = {} if self.systematic is None else {SYSTEMATIC_KEY: self.systematic[rows]}
        for instant in np.unique(instants).tolist() if self.drift is not None or self.twist is not None else []:
            own = (instants == instant)[:, None, None]
            if self.drift is not None:
                found[drift_key(instant)] = own * self.drift[rows]
            if self.twist is not None and self.shared[instant]:
                found[twist_key(instant)] = own * self.twist[rows]
        return found

    @property
    def span(self) -> int | None:
        """The number of instants of one factor; None where no effect belongs to single instants."""
        numbers = sum(part.shape[2] for part in (self.drift, self.twist) if part is not None)
        return max(COLUMNS // numbers, 1) if numbers else None


def graph_of(
    model: NoiseModel, sigma: dict[C, float], data: list[PairData], variables: Variables, state: State, problem: Problem
) -> NoiseGraph:
    """The graph of a model whose rows were made at ``state``, at standard deviations of its components."""
    if model.drift is not None:
        sigma = _with_smallest_step(sigma, model.drift)
    effects = _Effects.of(model, sigma)
    graph, values, keys = gtsam.NonlinearFactorGraph(), variables.values(state), {}
    _add_measurements(graph, model, effects, data, variables, state)
    if model.drift is not None:
        walk = gtsam.Values()
        for instant in range(model.rows.instants.count):
            keys[f"drift:{instant}"] = drift_key(instant)
            walk.insert(drift_key(instant), np.zeros(model.drift.states))
        graph.push_back(_walk(model.drift, sigma, walk))
        values.insert(walk)
    own = {}
    if effects.systematic is not None:
        own["systematic"] = (SYSTEMATIC_KEY, effects.systematic.shape[2])
    own |= {f"carrier:{i}": (twist_key(i), 6) for i in np.flatnonzero(effects.shared).tolist()}
    for name, (key, size) in own.items():
        keys[name] = key
        values.insert(key, np.zeros(size))
        graph.add(gtsam.PriorFactorVector(key, np.zeros(size), gtsam.noiseModel.Unit.Create(size)))
    add_priors(graph, variables, problem, "geodesic")
    unfixed = gtsam.NonlinearFactorGraph(graph)
    add_fixed(graph, variables, problem)
    return NoiseGraph(graph, values, unfixed, keys)


def _add_measurements(
    graph: gtsam.NonlinearFactorGraph,
    model: NoiseModel,
    effects: _Effects,
    data: list[PairData],
    variables: Variables,
    state: State,
) -> None:
    """Each pair's measurements, a few instants a factor."""
    instants, span = model.rows.instants, effects.span
    first = np.cumsum([0] + [item.count for item in data])
    pair = np.searchsorted(first, instants.order, side="right") - 1
    for i, item in enumerate(data):
        residuals = item.at(state.offsets_s.get(item.pair.sensor, 0.0))
        rows = np.flatnonzero(pair == i)
        block = instants.index[rows] // span if span is not None else np.zeros(len(rows), dtype=np.int64)
        target, sensor = variables.ends(item.pair)
        place = instants.order[rows] - first[i]
        bounds = np.r_[0, np.flatnonzero(np.diff(block)) + 1, len(rows)]
        factors = robot_world_hand_eye_effects_factors(
            target,
            sensor,
            residuals.A[place],
            residuals.B[place],
            effects.root[rows],
            [(slice(a, b), effects.at(rows[a:b], instants.index[rows[a:b]])) for a, b in pairwise(bounds.tolist())],
            scale_key=variables.scale_key(item.pair),
            time_offset_key=variables.offset_key(item.pair),
            twists=None if residuals.twists is None else residuals.twists[place],
        )
        for factor in factors:
            graph.add(factor)


def _walk(prior: DriftPrior, sigma: dict[C, float], values: gtsam.Values) -> gtsam.NonlinearFactorGraph:
    """The walk of the unit states from instant to instant; ``values`` has zeros for them."""
    linear = gtsam.GaussianFactorGraph()
    F, deviations = prior.unit_transport(sigma), np.sqrt(prior.variance)
    one, zero = np.eye(prior.states), np.zeros(prior.states)
    for instant, deviation in enumerate(deviations):
        noise, key = gtsam.noiseModel.Diagonal.Sigmas(deviation), drift_key(instant)
        if instant and prior.linked[instant - 1]:
            before = instant - 1
            linear.add(gtsam.JacobianFactor(drift_key(before), -F[before], key, one, zero, noise))
        else:
            linear.add(gtsam.JacobianFactor(key, one, zero, noise))
    return gtsam.LinearContainerFactor.ConvertLinearGraph(linear, values)


def _with_smallest_step(sigma: dict[C, float], prior: DriftPrior) -> dict[C, float]:
    """A drift's translation that is almost nothing beside the rotation's lever is one hundredth of that.

    GTSAM's Cholesky factor of the whole graph would lose its digits.
    """
    own = prior.transport.reshape(-1, prior.states // TRACK, TRACK, prior.states // TRACK, TRACK)
    lever = float(np.abs(own[:, :, 3:6, :, :3]).max(initial=0.0))
    smallest = SMALLEST_STEP * lever * sigma[C.DRIFT_ROTATION]
    return sigma | {C.DRIFT_TRANSLATION: max(sigma[C.DRIFT_TRANSLATION], smallest)}


def optimum_of(made: NoiseGraph, variables: Variables, *, has_free: bool, max_iterations: int) -> Optimum:
    """The optimum by Gauss and Newton's steps from an estimate near it; by GTSAM's optimiser where they do not descend.

    GTSAM's optimisers copy all values for every call of a factor in Python, which takes most of their time here.
    """
    values, cost = made.values, made.graph.error(made.values)
    for iteration in range(1, max_iterations + 1):
        linear = made.graph.linearize(values)
        if has_free:
            for unknown in variables.unknowns:
                one, zero = np.eye(unknown.dimension), np.zeros(unknown.dimension)
                held = gtsam.noiseModel.Isotropic.Sigma(unknown.dimension, HELD)
                linear.add(gtsam.JacobianFactor(variables.keys[unknown], one, zero, held))
        try:
            step = linear.optimize()
        except RuntimeError:  # GTSAM's IndeterminantLinearSystemException
            break
        gain = cost - linear.error(step)
        moved = values.retract(step)
        after = made.graph.error(moved)
        if not after <= cost * (1.0 + 1e-12) + 1e-12:
            break
        values, cost = moved, after
        if gain < LAST_STEP:
            return Optimum(values, cost, iteration)
    else:
        return Optimum(values, cost, max_iterations)
    return optimise(made.graph, values, max_iterations)
