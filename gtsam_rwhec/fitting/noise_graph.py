"""The noise model as a GTSAM graph: drift, systematic errors and the noise of shared carrier poses are its variables.

Every effect has the unit of its own standard deviation, so that its prior is of unit noise:

    x, y, s, d   frames, scales and time offsets, as in every refinement
    c            how much more than in the estimate a clock's rate is off
    w            the drift at each instant: 7 numbers for each track (rotation, translation, logarithm of the scale)
    u            the coefficients of the systematic errors: 6 for each feature of the configuration
    e            the twist of A at an instant, where several measurements share it

With the effects eliminated the graph's information is that of ``NoiseModel`` at the estimate where it was made.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import gtsam
import numpy as np
from rwhec_factors.batch import Together, robot_world_hand_eye_effects_factors

from gtsam_rwhec.errors import NotConvergedWarning
from gtsam_rwhec.fitting.clock_rates import RATE
from gtsam_rwhec.fitting.drift import TRACK, DriftPrior, drift_columns
from gtsam_rwhec.fitting.fit_options import C, RefineOptions
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.noise_likelihood import Estimate, NoiseModel
from gtsam_rwhec.fitting.noise_rows import prior_terms
from gtsam_rwhec.fitting.noise_search import Settled, Task, moved
from gtsam_rwhec.fitting.pair_data import PairData, square_root_information
from gtsam_rwhec.fitting.pose_fit import by_clock, linearized, residuals
from gtsam_rwhec.fitting.pose_graph import add_knowledge, optimise
from gtsam_rwhec.fitting.refined import FactorGraph, PairNoise, Refined
from gtsam_rwhec.fitting.refinement_from_poses import movements, scale_of
from gtsam_rwhec.fitting.unknowns import State, Unknown, UnknownKind, Variables
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.solution import Solution

#: A factor has at most about this many numbers of effects that belong to single instants: 10 instants of one track.
COLUMNS = 70
#: After a step of fewer standard deviations than this what is left is far below a thousandth of one.
LINEAR = 1e-2
#: An answer whose next step is longer than this, in standard deviations, has not converged.
CONVERGED = 0.1
#: Steps that have become no shorter so often go round in a circle.
IN_A_CIRCLE = 10
#: The translation's step in a drift is at least this part of what the rotation's step adds to it by its lever.
SMALLEST_STEP = 1e-2
#: The key of the coefficients of the systematic errors.
SYSTEMATIC_KEY: int = gtsam.symbol("u", 0)


def drift_key(instant: int) -> int:
    """Key of the tracks' drift at an instant."""
    key: int = gtsam.symbol("w", instant)
    return key


def rate_key(variables: Variables, sensor: str) -> int:
    """Key of the change of a clock's rate."""
    key: int = gtsam.symbol("c", list(variables.rates).index(sensor))
    return key


def twist_key(instant: int) -> int:
    """Key of the twist of A at an instant that several measurements share."""
    key: int = gtsam.symbol("e", instant)
    return key


@dataclass(frozen=True)
class _Effects:
    """The effects' columns (N, 6, m) in the order of the rows, and the weights of what is left."""

    #: (N, 6, 6): Square roots of the information of B's noise, and of A's where an instant has one measurement.
    root: Array
    #: (N, 6, m)
    drift: Array | None
    twist: Array | None
    systematic: Array | None
    #: (T,): Whether an instant has a twist of its own.
    shared: np.ndarray

    @staticmethod
    def of(model: NoiseModel, sigma: dict[C, float]) -> _Effects:
        rows = model.rows
        N, index = len(rows.residual), rows.instants.index
        E = model.carrier(sigma)
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
) -> FactorGraph:
    """The graph of a model whose rows were made at ``state``, and the estimate with effects of zero.

    The effects' keys are "drift:INSTANT", "systematic", "carrier:INSTANT"; instants as ``Instants`` counts them.
    """
    if model.drift is not None:
        sigma = _with_smallest_step(sigma, model.drift)
    effects = _Effects.of(model, sigma)
    graph, values, keys = gtsam.NonlinearFactorGraph(), variables.values(state), {}
    _add_measurements(graph, model, effects, data, variables, state)
    for name, rate in state.rates.items():
        key = keys[str(Unknown(UnknownKind.CLOCK_RATE, name))] = rate_key(variables, name)
        values.insert(key, np.zeros(1))
        graph.add(gtsam.PriorFactorVector(key, np.array([-rate / RATE]), gtsam.noiseModel.Unit.Create(1)))
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
    add_knowledge(graph, variables, problem, "geodesic")
    return FactorGraph(graph, values, keys)


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
    together, at = Together(), linearized(data, variables, state) if variables.rates else {}
    for i, item in enumerate(data):
        residuals, stretched = by_clock(item, variables, state), dict[int, Array]()
        rows = np.flatnonzero(pair == i)
        block = instants.index[rows] // span if span is not None else np.zeros(len(rows), dtype=np.int64)
        target, sensor = variables.ends(item.pair)
        place = instants.order[rows] - first[i]
        if item.pair.sensor in variables.rates:
            since_s = item.since_s(variables.rates[item.pair.sensor])[:, None]
            by_rate = -RATE * (at[item.pair].offset * since_s)[place, :, None]
            stretched = {rate_key(variables, item.pair.sensor): by_rate}
        bounds = np.r_[0, np.flatnonzero(np.diff(block)) + 1, len(rows)]
        factors = robot_world_hand_eye_effects_factors(
            target,
            sensor,
            residuals.A[place],
            residuals.B[place],
            effects.root[rows],
            [
                (
                    slice(a, b),
                    effects.at(rows[a:b], instants.index[rows[a:b]]) | {k: e[a:b] for k, e in stretched.items()},
                )
                for a, b in pairwise(bounds.tolist())
            ],
            scale_key=variables.scale_key(item.pair),
            time_offset_key=variables.offset_key(item.pair),
            twists=None if residuals.twists is None else residuals.twists[place],
            together=together,
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


def refined_of(
    task: Task,
    settled: Settled,
    joint: JointCovariance,
    degrees_of_freedom: float,
    inliers: dict[Pair, np.ndarray],
    solution: Solution,
    options: RefineOptions,
) -> Refined:
    """The answer at the optimum of the settled components, with its graph, which is made when it is asked for.

    ``Refined.keys`` has the effects too: "drift:INSTANT", "systematic" and "carrier:INSTANT".
    The graph has the components at their most probable values; the ``joint`` covariance also has their uncertainty
    and the constant error of an arm, so that the graph's own marginals are a little smaller.

    Parameters
    ----------
    joint : JointCovariance
        The final covariance of the unknowns.
    degrees_of_freedom : float
        Those of the quantile that fits the ellipsoids; infinite for chi-square.
    inliers : dict of Pair to (N,) booleans
        Of all measurements; empty where none was left out.
    solution : Solution
        The certified start.

    Warns
    -----
    NotConvergedWarning
        If the steps stopped at their limit, or are those of no linear model.
    """
    sigma = settled.fit.sizes.values(settled.fit.logs)
    state, model, estimate, iterations = _optimum(task, settled, sigma, options.max_iterations)
    variables = task.variables

    @cache
    def factor_graph() -> FactorGraph:
        made = graph_of(model, sigma, task.data, variables, state, task.problem)
        is_free = task.layout.free.shape[1] > 0
        held = {key: u.dimension for u, key in variables.keys.items() if is_free and u in task.layout.slots}
        optimum = optimise(made.graph, made.values, options.max_iterations, held)
        return FactorGraph(made.graph, optimum.values, {str(u): key for u, key in variables.keys.items()} | made.keys)

    if estimate.farthest > CONVERGED:
        warnings.warn(
            f"after {iterations} steps the next one is {estimate.farthest:.2g} standard deviations long: residuals are "
            "too large for a linear model; look for outliers (robust='gnc'), or raise RefineOptions.max_iterations",
            NotConvergedWarning,
            stacklevel=3,
        )
    return Refined(
        X=state.X,
        Y=state.Y,
        scale=scale_of(task.problem, state),
        scale_mode=task.problem.scale,
        time_offsets_s=state.offsets_s,
        factor_graph=factor_graph,
        noise_source="estimated",
        noise=noise_of_pairs(model, sigma, task.data, degrees_of_freedom),
        cost=estimate.cost,
        initial_cost=_cost_without_effects(task, model, sigma, variables.start(solution)),
        iterations=iterations,
        moved=movements(solution, state.X, state.Y),
        inlier_counts={pair: (int(kept.sum()), len(kept)) for pair, kept in inliers.items()},
        inliers=inliers,
        free_directions=task.free_directions,
        solution=solution,
        options=options,
        joint=joint,
    )


def _optimum(
    task: Task, settled: Settled, sigma: dict[C, float], max_iterations: int
) -> tuple[State, NoiseModel, Estimate, int]:
    """The optimum of the unknowns and all effects together by Gauss and Newton's steps, and the number of these.

    Steps that become no shorter go round in a circle: then they end.
    """
    state, model, iteration = settled.state, settled.model, 0
    estimate = model.evaluate(sigma)
    shortest, since = estimate.farthest, 0
    for iteration in range(1, max_iterations + 1):
        state = moved(state, task.variables, task.layout, model.basis @ estimate.step)
        if estimate.farthest < LINEAR:
            return state, model, estimate, iteration
        model = task.model_like(model, state)
        estimate = model.evaluate(sigma)
        since = 0 if estimate.farthest < shortest else since + 1
        shortest = min(shortest, estimate.farthest)
        if since == IN_A_CIRCLE:
            break
    return state, model, estimate, iteration


def _cost_without_effects(task: Task, model: NoiseModel, sigma: dict[C, float], state: State) -> float:
    """The graph's cost at an estimate, with all effects at zero."""
    residual = np.concatenate(residuals(task.data, task.variables, state))[model.rows.instants.order]
    whitened = np.einsum("nij,nj->ni", _Effects.of(model, sigma).root, residual)
    priors = prior_terms(task.problem, task.variables, state, model.basis)[2]
    return 0.5 * float((whitened**2).sum()) + priors


def noise_of_pairs(
    model: NoiseModel, sigma: dict[C, float], data: list[PairData], degrees_of_freedom: float
) -> dict[Pair, PairNoise]:
    """The noise of each pair's B: root mean square over measurements and axes, depth included, jitter not."""
    variances = np.einsum("nii->ni", model.white(sigma | {C.JITTER: 0.0}))
    if model.rows.slides is not None:  # what is not measured has no noise
        variances = np.maximum(variances - np.einsum("nii->ni", model.rows.slides), 0.0)
    in_order = np.empty_like(variances)
    in_order[model.rows.instants.order] = variances
    result, first = {}, 0
    for item in data:
        mean = in_order[first : first + item.count].mean(axis=0)
        rotation, translation = float(np.sqrt(mean[:3].mean())), float(np.sqrt(mean[3:].mean()))
        result[item.pair] = PairNoise(rotation, translation, (degrees_of_freedom, degrees_of_freedom))
        first += item.count
    return result
