"""Optimisation in rounds, where the weights depend on the answer or on the residuals, until the weights settle."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import gtsam
import numpy as np

from gtsam_rwhec.errors import NotConvergedWarning
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.fitting import pose_graph as graphs
from gtsam_rwhec.fitting.fit_options import RefineOptions
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.pair_data import FactorsByPair, Group, group_label, largest_change
from gtsam_rwhec.fitting.pose_graph import Optimum, information_of, optimise
from gtsam_rwhec.fitting.pose_models import ChordalModel, GeodesicModel
from gtsam_rwhec.fitting.unknowns import State, Variables
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import AS_STATED

Model = GeodesicModel | ChordalModel

#: At most this many rounds estimate the noise and propagate A's noise again; two to five are usual.
MAX_ROUNDS = 30
#: A variance factor is settled when a round changes it by no more than this part.
SETTLED = 1e-4
#: A time offset is settled when a round changes it by no more than this, s.
OFFSET_SETTLED_S = 1e-6


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
    if isinstance(model, GeodesicModel) and model.first_loss is not None:
        graph = model.graph(state, factors, model.first_loss)
        graphs.add_knowledge(graph, variables, problem, options.residual)
        optimum = optimise(graph, values, options.max_iterations)
        iterations += optimum.iterations
        state, values = variables.state(optimum.values), optimum.values
    for round_number in range(MAX_ROUNDS):
        if round_number:
            tell(f"refining: the weights settle, round {round_number + 1} of at most {MAX_ROUNDS}")
        without_loss = model.graph(state, factors)
        graphs.add_priors(without_loss, variables, problem, options.residual)
        graph = gtsam.NonlinearFactorGraph(without_loss)
        graphs.add_fixed(graph, variables, problem)
        optimum = optimise(graph, values, options.max_iterations)
        iterations += optimum.iterations
        before, state, values = state, variables.state(optimum.values), optimum.values
        if not model.has_constant_weights:
            without_loss = model.information_graph(state, factors)
            graphs.add_priors(without_loss, variables, problem, options.residual)
        information = information_of(without_loss, values, variables) / model.inefficiency(state, factors)
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
        few = sorted(degrees_of_freedom, key=lambda key: degrees_of_freedom[key])[:3]
        where = ", ".join(
            f"the {component} of {group_label(group)}: {degrees_of_freedom[group, component]:.2g}"
            for group, component in few
        )
        warnings.warn(
            f"the estimated noise did not settle in {MAX_ROUNDS} rounds; these have the fewest degrees of "
            f"freedom: {where}. "
            + (
                "The noise given for A may already explain the residuals: give less, or give B's noise (noise='given')"
                if options.carrier_noise is not None
                else "Join groups (noise_groups='sensor' or 'all'), or give sigma and kappa (noise='given')"
            ),
            NotConvergedWarning,
            stacklevel=5,
        )
    if optimum.iterations >= options.max_iterations:
        warnings.warn(
            f"GTSAM stopped after {optimum.iterations} iterations without converging; raise "
            "RefineOptions.max_iterations",
            NotConvergedWarning,
            stacklevel=5,
        )
    return SettledFit(graph, optimum, information, factors, degrees_of_freedom, iterations)
