"""Refinement with the chordal residual, from moments alone: its optimum is the certified optimum."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.variance_factors import AS_STATED
from gtsam_rwhec.refinement.graph import add_summary, summary_of
from gtsam_rwhec.refinement.joint_covariance import JointCovariance
from gtsam_rwhec.refinement.optimisation import information_of
from gtsam_rwhec.refinement.options import NoiseGroups
from gtsam_rwhec.refinement.variables import State, Variables
from gtsam_rwhec.refinement.variance_components import VarianceComponents, from_moments
from gtsam_rwhec.refinement.weighting import COMPONENTS, FactorsByPair
from gtsam_rwhec.solver.parts import Part


@dataclass(frozen=True)
class ChordalModel:
    """The chordal residuals: one edge summary for each pair."""

    parts: list[Part]
    variables: Variables

    @property
    def reweighs(self) -> bool:
        """The weights do not depend on the estimate."""
        return False

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

    def graph(self, state: State, factors: FactorsByPair) -> gtsam.NonlinearFactorGraph:
        """The measurements' factors."""
        graph = gtsam.NonlinearFactorGraph()
        for part in self.parts:
            for e, pair in enumerate(part.pairs):
                add_summary(graph, self.variables, pair, summary_of(part, e, factors[pair]))
        return graph

    def values(self, state: State) -> gtsam.Values:
        """An estimate as GTSAM's values."""
        return self.variables.values(state)

    def information_graph(self, state: State, factors: FactorsByPair) -> gtsam.NonlinearFactorGraph:
        """The graph itself, which has no loss."""
        return self.graph(state, factors)

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
                    add_summary(alone, self.variables, pair, summary_of(part, e, AS_STATED, component))
                    cost.append(alone.error(values))
                    information = information_of(alone, values, self.variables)
                    used.append(float(np.sum(joint.finite * information)) / factors[pair][i])
                costs[pair], fitted[pair] = (cost[0], cost[1]), (used[0], used[1])
        return from_moments(self.parts, costs, fitted, groups)
