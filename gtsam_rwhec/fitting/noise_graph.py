"""The noise model as a GTSAM graph: drift, systematic errors and the noise of shared carrier poses are its variables.

Every effect has the unit of its own standard deviation, so that its prior is of unit noise:

    x, y, s, d   frames, scales and time offsets, as in every refinement
    w            the drift at each instant: 7 numbers for each track (rotation, translation, logarithm of the scale)
    u            the coefficients of the systematic errors: 6 for each feature of the configuration
    e            the twist of A at an instant, where several measurements share it

With the effects eliminated the graph's information is that of ``NoiseModel`` at the estimate where it was made.
"""

from __future__ import annotations
import warnings
from dataclasses import dataclass
from itertools import pairwise
import gtsam
import numpy as np
from rwhec_factors.batch import robot_world_hand_eye_effects_factors
from gtsam_rwhec.errors import NotConvergedWarning
from gtsam_rwhec.fitting.drift import TRACK
from gtsam_rwhec.fitting.drift import DriftPrior
from gtsam_rwhec.fitting.drift import drift_columns
from gtsam_rwhec.fitting.fit_options import RefineOptions
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.noise_components import C
from gtsam_rwhec.fitting.noise_likelihood import NoiseModel
from gtsam_rwhec.fitting.noise_search import Settled
from gtsam_rwhec.fitting.noise_search import Task
from gtsam_rwhec.fitting.pair_data import PairData
from gtsam_rwhec.fitting.pair_data import square_root_information
from gtsam_rwhec.fitting.pose_graph import Optimum
from gtsam_rwhec.fitting.pose_graph import add_fixed
from gtsam_rwhec.fitting.pose_graph import add_priors
from gtsam_rwhec.fitting.pose_graph import optimise
from gtsam_rwhec.fitting.refined import PairNoise
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.refinement_from_poses import movements
from gtsam_rwhec.fitting.refinement_from_poses import scale_of
from gtsam_rwhec.fitting.unknowns import State
from gtsam_rwhec.fitting.unknowns import UnknownKind
from gtsam_rwhec.fitting.unknowns import Variables
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.solution import Solution

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
    """A noise model's graph."""

    #: All factors, and the estimate with effects of zero.
    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    #: The same factors without the constraints of fixed frames: what ``information_of`` takes.
    unfixed: gtsam.NonlinearFactorGraph
    #: The effects' keys: "drift:INSTANT", "systematic", "carrier:INSTANT"; instants as ``Instants`` counts them.
    keys: dict[str, int]


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


#: The graph's optimum and the linear model's may differ by this part of a standard deviation: linearisation's share.
AGREES = 0.1


def refined_of(
    task: Task,
    settled: Settled,
    joint: JointCovariance,
    degrees_of_freedom: float,
    inliers: dict[Pair, np.ndarray],
    solution: Solution,
    options: RefineOptions,
) -> Refined:
    """The answer with its graph, at the graph's optimum.

    ``Refined.keys`` has the effects too: "drift:INSTANT", "systematic" and "carrier:INSTANT" (``noise_model.graph``).
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
        If the optimiser stopped at its limit, or its optimum is not that of the linear model.
    """
    sigma = settled.fit.sizes.values(settled.fit.logs)
    made = graph_of(settled.model, sigma, task.data, task.variables, settled.state, task.problem)
    optimum = optimum_of(
        made, task.variables, has_free=bool(task.layout.free.shape[1]), max_iterations=options.max_iterations
    )
    state = task.variables.state(optimum.values)
    if optimum.iterations >= options.max_iterations:
        warnings.warn(
            f"GTSAM stopped after {optimum.iterations} iterations without converging; raise "
            "RefineOptions.max_iterations",
            NotConvergedWarning,
            stacklevel=3,
        )
    share = disagreement(task, settled, sigma, state)
    if share > AGREES:
        warnings.warn(
            f"the graph's optimum is {share:.2g} standard deviations from that of the linear model, to which the "
            "covariance belongs: residuals are too large for a linear model; look for outliers (robust='gnc')",
            NotConvergedWarning,
            stacklevel=3,
        )
    start = gtsam.Values(made.values)
    start.update(task.variables.values(task.variables.start(solution)))
    keys = {str(unknown): key for unknown, key in task.variables.keys.items()}
    return Refined(
        X=state.X,
        Y=state.Y,
        scale=scale_of(task.problem, state),
        scale_mode=task.problem.scale,
        time_offsets_s=state.offsets_s,
        graph=made.graph,
        values=optimum.values,
        keys=keys | made.keys,
        noise_source="estimated",
        noise=noise_of_pairs(settled.model, sigma, task.data, degrees_of_freedom),
        cost=optimum.cost,
        initial_cost=made.graph.error(start),
        iterations=optimum.iterations,
        moved=movements(solution, state.X, state.Y),
        inlier_counts={pair: (int(kept.sum()), len(kept)) for pair, kept in inliers.items()},
        inliers=inliers,
        free_directions=task.free_directions,
        solution=solution,
        options=options,
        joint=joint,
    )


def noise_of_pairs(
    model: NoiseModel, sigma: dict[C, float], data: list[PairData], degrees_of_freedom: float
) -> dict[Pair, PairNoise]:
    """The noise of each pair's B: root mean square over measurements and axes, depth included, jitter not."""
    variances = np.einsum("nii->ni", model.white(sigma | {C.JITTER: 0.0}))
    in_order = np.empty_like(variances)
    in_order[model.rows.instants.order] = variances
    result, first = {}, 0
    for item in data:
        mean = in_order[first : first + item.count].mean(axis=0)
        rotation, translation = float(np.sqrt(mean[:3].mean())), float(np.sqrt(mean[3:].mean()))
        result[item.pair] = PairNoise(rotation, translation, (degrees_of_freedom, degrees_of_freedom))
        first += item.count
    return result


def disagreement(task: Task, settled: Settled, sigma: dict[C, float], state: State) -> float:
    """The largest difference of an estimate from the linear model's optimum, in its standard deviations."""
    estimate, basis = settled.model.evaluate(sigma), settled.model.basis
    if not basis.shape[1]:
        return 0.0
    away = np.linalg.lstsq(basis, change_between(task, settled.state, state), rcond=None)[0] - estimate.step
    return float(np.abs(away / np.sqrt(np.diagonal(estimate.covariance))).max())


def change_between(task: Task, before: State, after: State) -> Array:
    """The change (d,) of the unknowns that ``settling.moved`` makes of one estimate the other."""
    change = np.zeros(len(task.layout.unit))
    poses, moved = before.X | before.Y, after.X | after.Y
    for unknown, place in task.layout.slots.items():
        owner = unknown.owner
        if unknown.kind is UnknownKind.FRAME:
            change[place] = gtsam.Pose3.Logmap(poses[owner].between(moved[owner]))
        elif unknown.kind is UnknownKind.SCALE:
            change[place] = before.scales[unknown] * np.log(after.scales[unknown] / before.scales[unknown])
        else:
            change[place] = after.offsets_s[owner] - before.offsets_s[owner]
    return change
