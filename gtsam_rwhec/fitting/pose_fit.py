"""Optimisation in rounds, where the weights depend on the answer or on the residuals, until the weights settle."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from rwhec_factors.batch import BatchResiduals, Linearization, Placed, linearized_together, residuals_together
from scipy.special import chdtr, chdtri

from gtsam_rwhec.errors import NoiseError, NotConvergedWarning, WeightsWarning
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.fitting import pose_graph as graphs
from gtsam_rwhec.fitting.admission import inlier_threshold
from gtsam_rwhec.fitting.fit_options import NoiseGroups, RefineOptions, Robust
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.pair_data import (
    COMPONENTS,
    FactorsByPair,
    Group,
    PairData,
    check_carriers,
    group_label,
    group_of,
    largest_change,
    measurement_covariance,
    residual_covariance,
    square_root_information,
)
from gtsam_rwhec.fitting.pose_graph import Optimum, add_summary, information_of, optimise
from gtsam_rwhec.fitting.unknowns import State, Variables, carrier_key
from gtsam_rwhec.fitting.variance_components import SMALLEST, VarianceComponents, from_measurements, from_moments
from gtsam_rwhec.geometry.poses import Array, to_pose3
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import AS_STATED, VarianceFactors
from gtsam_rwhec.solver.parts import Part


@dataclass(frozen=True)
class GeodesicModel:
    """The geodesic residuals of the raw measurements."""

    data: list[PairData]
    variables: Variables
    options: RefineOptions
    #: The carrier poses, where they are variables.
    carriers: graphs.CarrierVariables | None
    #: Share of its variance that a squared residual keeps when residuals beyond the inlier threshold are left out.
    inlier_share: float

    @staticmethod
    def of(data: list[PairData], variables: Variables, options: RefineOptions) -> GeodesicModel:
        """The model; it decides whether carrier poses are variables."""
        check_carriers(data, options)
        carriers = None
        if options.carrier_noise is not None:
            candidates = graphs.CarrierVariables.of(data)
            if options.carrier_model == "variables" or (options.carrier_model == "auto" and candidates.is_shared):
                carriers = candidates
            elif candidates.is_shared:
                warnings.warn(
                    "some measurements share a carrier pose, but carrier_model='propagated' treats its noise as "
                    "independent for each measurement. The error of a shared pose does not average out, so standard "
                    "deviations are too small; take carrier_model='variables'",
                    WeightsWarning,
                    stacklevel=5,
                )
        share = 1.0
        if options.robust == "gnc":  # of a chi-square with 6 degrees of freedom, cut at its quantile
            cut = inlier_threshold(options.inlier_confidence, sum(item.count for item in data))
            share = float(chdtr(8, cut) / chdtr(6, cut))
        return GeodesicModel(data, variables, options, carriers, share)

    @property
    def is_m_estimate(self) -> bool:
        """Whether one of GTSAM's losses weighs each measurement."""
        return self.options.robust in graphs.LOSSES

    @property
    def first_loss(self) -> Robust | None:
        """The loss that is minimised first, because it has no local minima; the loss of the options follows."""
        return "huber" if self.is_m_estimate and self.options.robust != "huber" else None

    @property
    def reweighs(self) -> bool:
        """Whether the weights depend on the estimate: they do if A's noise is propagated into the residual."""
        return self.options.carrier_noise is not None and self.carriers is None

    @property
    def has_constant_weights(self) -> bool:
        """Whether a graph's factors are the same wherever it is optimised."""
        return not (self.is_m_estimate or self.reweighs or self.variables.offsets)

    @property
    def given_noise(self) -> dict[Pair, tuple[float, float]]:
        """Given standard deviations of each pair's median measurement, root mean square over axes: rad and metres.

        A root mean square over measurements would be that of the few farthest ones, which count least.
        """
        result = {}
        for item in self.data:
            variances = np.maximum(np.einsum("nii->ni", item.measured), 0.0).reshape(-1, 2, 3)
            variances = variances.sum(axis=2) / np.maximum((variances > 0.0).sum(axis=2), 1)
            rotation, translation = np.sqrt(np.median(variances, axis=0)).tolist()
            result[item.pair] = (rotation, translation)
        return result

    def covariances(self, state: State, factors: FactorsByPair) -> dict[Pair, Array]:
        """The covariances (N, 6, 6) of every pair's residuals at an estimate."""
        if self.options.carrier_noise is None:
            return {item.pair: measurement_covariance(item, factors[item.pair]) for item in self.data}
        at = linearized(self.data, self.variables, state)
        return {item.pair: residual_covariance(item, at[item.pair], factors[item.pair]) for item in self.data}

    def graph(self, state: State, factors: FactorsByPair, robust: Robust | None = None) -> gtsam.NonlinearFactorGraph:
        """The measurements' factors, weighted at an estimate; ``robust`` replaces the loss of the options."""
        loss = robust or self.options.robust
        graph = gtsam.NonlinearFactorGraph()
        rest = [replace(item, residuals=item.at(state.offsets_s.get(item.pair.sensor, 0.0))) for item in self.data]
        if self.carriers is not None:
            graphs.add_with_carriers(graph, self.variables, rest, self.carriers, factors, loss)
            rest = [item for item in rest if item.pair not in self.carriers.index]
        if rest:
            add = graphs.add_single if loss in graphs.LOSSES else graphs.add_batches
            add(graph, self.variables, rest, self.covariances(state, factors), loss)
        return graph

    def reweighted(self, state: State, factors: FactorsByPair, robust: Robust) -> gtsam.NonlinearFactorGraph:
        """One factor for each pair, in which measurements have the weights that a loss gives them at an estimate."""
        loss, covariances = graphs.loss_of(robust), self.covariances(state, factors)
        for pair, lengths in self.lengths(state, factors).items():
            weights = np.array([max(loss.weight(d), LEAST_WEIGHT) for d in lengths])
            covariances[pair] = covariances[pair] / weights[:, None, None]
        graph = gtsam.NonlinearFactorGraph()
        there = [replace(item, residuals=item.at(state.offsets_s.get(item.pair.sensor, 0.0))) for item in self.data]
        graphs.add_batches(graph, self.variables, there, covariances)
        return graph

    def lengths(self, state: State, factors: FactorsByPair) -> dict[Pair, Array]:
        """The lengths (N,) of every pair's whitened residuals at an estimate."""
        at = linearized(self.data, self.variables, state)
        return {
            pair: np.linalg.norm(np.einsum("nij,nj->ni", square_root_information(C), at[pair].residual), axis=1)
            for pair, C in self.covariances(state, factors).items()
        }

    def values(self, state: State) -> gtsam.Values:
        """An estimate as GTSAM's values, with the measured carrier poses where they are variables."""
        values = self.variables.values(state)
        if self.carriers is not None:
            for i, A in enumerate(self.carriers.A):
                values.insert(carrier_key(i), to_pose3(A[:3, :3], A[:3, 3]))
        return values

    def inefficiency(self, state: State, factors: FactorsByPair) -> float:
        """The factor by which a loss widens least squares' covariance: Huber's E psi^2 / (E psi')^2, 6 dimensions.

        (Huber and Ronchetti, Robust Statistics, eq. 7.87, whose psi' is here the divergence of w(|u|) u over 6.)
        """
        if not self.is_m_estimate:
            return 1.0
        loss = graphs.loss_of(self.options.robust)
        lengths = np.concatenate(list(self.lengths(state, factors).values()))
        weight = np.array([loss.weight(d) for d in lengths])
        step = 1e-5
        before = np.maximum(lengths - step, 0.0)
        change = [loss.weight(d + step) - loss.weight(b) for d, b in zip(lengths, before, strict=True)]
        slope = np.array(change) / (lengths + step - before)
        unknowns = sum(unknown.dimension for unknown in self.variables.unknowns)
        degrees_of_freedom = max(6 * len(lengths) - unknowns, 1)
        square = float(np.sum((weight * lengths) ** 2)) / degrees_of_freedom
        gain = float(np.mean(weight + slope * lengths / 6.0))
        if not gain > 0.05:
            raise NoiseError(
                f"robust={self.options.robust!r}: half of the residuals are beyond {np.median(lengths):.3g} standard "
                "deviations. Either the noise is larger than given (take noise='estimate'), or outliers have pulled "
                "the certified solution away (take robust='gnc', which needs no good start)"
            )
        return square / gain**2

    def next_factors(
        self, state: State, joint: JointCovariance, factors: FactorsByPair, groups: NoiseGroups
    ) -> VarianceComponents:
        """Variance factors from the residuals at an estimate."""
        at = linearized(self.data, self.variables, state)
        components = from_measurements(
            self.data, at, self.variables, joint, factors, groups, consistency=self.inlier_share
        )
        if self.is_m_estimate:
            factors = self._median_factors(at, state, factors, groups, components.degrees_of_freedom)
            components = replace(components, factors=factors)
        return components

    def _median_factors(
        self,
        at: dict[Pair, Linearization],
        state: State,
        factors: FactorsByPair,
        groups: NoiseGroups,
        degrees_of_freedom: dict[tuple[Group, str], float],
    ) -> FactorsByPair:
        """Variance factors that withstand outliers: medians of squared residuals over a chi-square's, 3 dimensions."""
        squares: dict[tuple[Group, str], list[Array]] = {}
        for pair, covariance in self.covariances(state, factors).items():
            for component, block in zip(COMPONENTS, (slice(0, 3), slice(3, 6)), strict=True):
                r = at[pair].residual[:, block]
                square = np.einsum("ni,nij,nj->n", r, np.linalg.inv(covariance[:, block, block]), r)
                squares.setdefault((group_of(pair, groups), component), []).append(square)
        ratios = {}
        for group, values in squares.items():
            every = np.concatenate(values)
            spare = degrees_of_freedom[group] / (3.0 * len(every))
            ratios[group] = max(float(np.median(every)) / float(chdtri(3, 0.5)) / spare, SMALLEST)
        return {
            pair: VarianceFactors(
                old.rotation * ratios[group_of(pair, groups), "rotation"],
                old.translation * ratios[group_of(pair, groups), "translation"],
            )
            for pair, old in factors.items()
        }


def linearized(data: list[PairData], variables: Variables, state: State) -> dict[Pair, Linearization]:
    """Residuals and Jacobians of pairs at an estimate."""
    found = linearized_together(_placed(data, variables, state))
    return {item.pair: at for item, at in zip(data, found, strict=True)}


def residuals(data: list[PairData], variables: Variables, state: State) -> list[Array]:
    """Residuals (N, 6) of pairs alone."""
    return residuals_together(_placed(data, variables, state))


def _placed(data: list[PairData], variables: Variables, state: State) -> list[Placed]:
    """Each pair with its residuals about an estimate, and X, Y, the scale and the offset there."""
    frames = {name: pose.matrix() for name, pose in (state.X | state.Y).items()}
    found = []
    for item in data:
        scale = variables.scale_of_pair.get(item.pair)
        offset_s = state.offsets_s.get(item.pair.sensor, 0.0)
        alpha = 1.0 if scale is None else state.scales[scale]
        X, Y = frames[item.pair.target], frames[item.pair.sensor]
        found.append(Placed(by_clock(item, variables, state), X, Y, alpha, offset_s))
    return found


def by_clock(item: PairData, variables: Variables, state: State) -> BatchResiduals:
    """A pair's residuals linearised where an estimate has its sensor's clock."""
    sensor = item.pair.sensor
    more_s = state.rates[sensor] * item.since_s(variables.rates[sensor]) if sensor in variables.rates else 0.0
    return item.at(state.offsets_s.get(sensor, 0.0), more_s)


@dataclass(frozen=True)
class ChordalModel:
    """The chordal residuals: one edge summary for each pair."""

    parts: list[Part]
    variables: Variables

    #: The weights do not depend on the estimate, and there is no loss.
    reweighs = False
    has_constant_weights = True
    first_loss = None

    @property
    def given_noise(self) -> dict[Pair, tuple[float, float]]:
        """Given standard deviations, averaged over each pair's measurements: rad and (measured) metres per axis."""
        return {
            pair: (
                float(np.sqrt(0.5 * part.moments.count[e] / part.moments.kappa[e])),
                float(np.sqrt(part.moments.count[e] / part.moments.weight[e])),
            )
            for part in self.parts
            for e, pair in enumerate(part.pairs)
        }

    def graph(self, state: State, factors: FactorsByPair, robust: Robust | None = None) -> gtsam.NonlinearFactorGraph:
        """The measurements' factors."""
        graph = gtsam.NonlinearFactorGraph()
        for part in self.parts:
            for e, pair in enumerate(part.pairs):
                add_summary(graph, self.variables, part, e, factors[pair])
        return graph

    def values(self, state: State) -> gtsam.Values:
        """An estimate as GTSAM's values."""
        return self.variables.values(state)

    def inefficiency(self, state: State, factors: FactorsByPair) -> float:
        """1: least squares has no loss."""
        return 1.0

    def next_factors(
        self, state: State, joint: JointCovariance, factors: FactorsByPair, groups: NoiseGroups
    ) -> VarianceComponents:
        """Variance factors from the residuals at an estimate."""
        values = self.variables.values(state)
        costs: dict[Pair, tuple[float, float]] = {}
        fitted: dict[Pair, tuple[float, float]] = {}
        for part in self.parts:
            for e, pair in enumerate(part.pairs):
                cost, used = [], []
                for i, component in enumerate(COMPONENTS):
                    alone = gtsam.NonlinearFactorGraph()
                    add_summary(alone, self.variables, part, e, AS_STATED, component)
                    cost.append(alone.error(values))
                    information = information_of(alone, values, self.variables)
                    used.append(float(np.sum(joint.finite * information)) / factors[pair][i])
                costs[pair], fitted[pair] = (cost[0], cost[1]), (used[0], used[1])
        return from_moments(self.parts, costs, fitted, groups)


Model = GeodesicModel | ChordalModel

#: At most this many rounds estimate the noise and propagate A's noise again; two to five are usual.
MAX_ROUNDS = 30
#: A variance factor is settled when a round changes it by no more than this part.
SETTLED = 1e-4
#: While weights change, the last step of an optimum lowers the cost by less than this share: they do not feel it.
ROUGHLY = 1e-2 * SETTLED
#: A time offset is settled when a round changes it by no more than this, s.
OFFSET_SETTLED_S = 1e-6


#: An estimate under a loss is settled when a round moves it by less than this part of its standard deviations.
SAME = 1e-3
#: No measurement has less weight than this; its covariance would not be finite.
LEAST_WEIGHT = 1e-12


@dataclass(frozen=True)
class SettledFit:
    """The settled optimum: the graph, the information of the unknowns, and the variance factors."""

    graph: gtsam.NonlinearFactorGraph
    optimum: Optimum
    information: Array
    factors: FactorsByPair
    degrees_of_freedom: dict[tuple[Group, str], float]
    iterations: int


def fit(
    problem: Problem,
    model: Model,
    variables: Variables,
    start: State,
    options: RefineOptions,
    estimates: bool,
    tell: Progress = silent,
    first: FactorsByPair | None = None,
) -> SettledFit:
    """The optimum under settled weights; with ``first`` the variance factors start there."""
    factors: FactorsByPair = {pair: (first or {}).get(pair, AS_STATED) for pair in problem.pairs}
    degrees_of_freedom: dict[tuple[Group, str], float] = {}
    state, values = start, model.values(start)
    iterations = 0
    if isinstance(model, GeodesicModel) and model.is_m_estimate and model.carriers is None:
        state, factors = _reweighted(problem, model, variables, start, options, factors, estimates, tell)
        values = model.values(state)
    elif model.first_loss is not None:
        graph = model.graph(state, factors, model.first_loss)
        graphs.add_knowledge(graph, variables, problem, options.residual)
        optimum = optimise(graph, values, options.max_iterations)
        iterations += optimum.iterations
        state, values = variables.state(optimum.values), optimum.values

    def information_at(graph: gtsam.NonlinearFactorGraph, state: State, values: gtsam.Values) -> Array:
        if not model.has_constant_weights:
            graph = model.graph(state, factors, "none")
            graphs.add_priors(graph, variables, problem, options.residual)
        return information_of(graph, values, variables) / model.inefficiency(state, factors)

    for round_number in range(MAX_ROUNDS):
        if round_number:
            tell(f"refining: the weights settle, round {round_number + 1} of at most {MAX_ROUNDS}")
        without_loss = model.graph(state, factors)
        graphs.add_priors(without_loss, variables, problem, options.residual)
        graph = gtsam.NonlinearFactorGraph(without_loss)
        graphs.add_fixed(graph, variables, problem)
        optimum = optimise(graph, values, options.max_iterations, share=ROUGHLY if estimates else 0.0)
        iterations += optimum.iterations
        before, state, values = state, variables.state(optimum.values), optimum.values
        information = information_at(without_loss, state, values)
        settled = not model.reweighs or round_number > 0
        # A time offset is linearised at its value when the round began.
        settled = settled and all(
            abs(offset - before.offsets_s[name]) < OFFSET_SETTLED_S for name, offset in state.offsets_s.items()
        )
        if estimates:
            size = len(information)
            joint = JointCovariance.of(variables.unknowns, information, np.zeros((size, 0)), np.ones(size))
            components = model.next_factors(state, joint, factors, options.noise_groups)
            change = largest_change(factors, components.factors)
            settled = settled and change < SETTLED
            degrees_of_freedom = components.degrees_of_freedom
            if not settled:
                factors = components.factors
        if settled:
            break
    else:
        where = [
            f"{least:.2g} degrees of freedom for the {component} of {group_label(group)}"
            for (group, component), least in sorted(degrees_of_freedom.items(), key=lambda item: item[1])[:1]
        ]
        warnings.warn(
            f"the weights did not settle in {MAX_ROUNDS} rounds ({', '.join(where) or 'as time offsets change'}). If "
            "the noise given for A already explains the residuals, give less; else join groups (noise_groups='all'), "
            "give sigma and kappa (noise='given'), or estimate no time offsets",
            NotConvergedWarning,
            stacklevel=5,
        )
    if estimates:  # the last digits
        optimum = optimise(graph, values, options.max_iterations)
        iterations += optimum.iterations
        state, values = variables.state(optimum.values), optimum.values
        information = information_at(without_loss, state, values)
    if optimum.iterations >= options.max_iterations:
        warnings.warn(
            f"GTSAM stopped after {optimum.iterations} iterations without converging; raise "
            "RefineOptions.max_iterations",
            NotConvergedWarning,
            stacklevel=5,
        )
    return SettledFit(graph, optimum, information, factors, degrees_of_freedom, iterations)


def _reweighted(
    problem: Problem,
    model: GeodesicModel,
    variables: Variables,
    state: State,
    options: RefineOptions,
    factors: FactorsByPair,
    estimates: bool,
    tell: Progress,
) -> tuple[State, FactorsByPair]:
    """The optimum under a loss by least squares with weights that are taken again, and its variance factors.

    A factor for each measurement, which GTSAM's losses need, is called from C++ in Python each time. So these begin
    where all measurements of a pair in one factor end.
    """
    for robust in dict.fromkeys((model.first_loss or model.options.robust, model.options.robust)):
        for round_number in range(MAX_ROUNDS):
            tell(f"refining: weights of measurements, round {round_number + 1} of at most {MAX_ROUNDS}")
            before = state
            without = model.reweighted(state, factors, robust)
            graphs.add_priors(without, variables, problem, options.residual)
            graph = gtsam.NonlinearFactorGraph(without)
            graphs.add_fixed(graph, variables, problem)
            optimum = optimise(graph, model.values(state), options.max_iterations)
            state = variables.state(optimum.values)
            information, change = information_of(without, optimum.values, variables), 0.0
            if estimates:
                unit = np.ones(len(information))
                joint = JointCovariance.of(variables.unknowns, information, np.zeros((len(unit), 0)), unit)
                again = model.next_factors(state, joint, factors, options.noise_groups).factors
                change, factors = largest_change(factors, again), again
            step = variables.values(before).localCoordinates(optimum.values)
            moved = np.concatenate([step.at(variables.keys[unknown]) for unknown in variables.unknowns])
            if change < SETTLED and moved @ information @ moved < SAME**2:
                break
    return state, factors
