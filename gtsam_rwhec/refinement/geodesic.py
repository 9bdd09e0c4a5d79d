"""Refinement with the geodesic residual: any covariance of B, noise in A, robust losses, time offsets."""

from __future__ import annotations

import dataclasses
import warnings
from dataclasses import dataclass

import gtsam
import numpy as np
from rwhec_factors.batch import Linearization
from scipy.special import chdtr, chdtri

from gtsam_rwhec.errors import NoiseError, WeightsWarning
from gtsam_rwhec.geometry.poses import Array, to_pose3
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.variance_factors import VarianceFactors
from gtsam_rwhec.refinement import graph as graphs
from gtsam_rwhec.refinement.joint_covariance import JointCovariance
from gtsam_rwhec.refinement.options import NoiseGroups, RefineOptions, Robust
from gtsam_rwhec.refinement.pair_data import PairData, check_carriers
from gtsam_rwhec.refinement.variables import State, Variables, carrier_key
from gtsam_rwhec.refinement.variance_components import SMALLEST, VarianceComponents, from_measurements
from gtsam_rwhec.refinement.weighting import (
    COMPONENTS,
    FactorsByPair,
    Group,
    group_of,
    residual_covariance,
    square_root_information,
)


@dataclass(frozen=True)
class GeodesicModel:
    """The raw measurements of every pair; ``carriers`` where carrier poses are variables.

    inlier_share is the share of its variance that a squared residual keeps when those beyond the inlier threshold are
    left out.
    """

    data: list[PairData]
    variables: Variables
    options: RefineOptions
    carriers: graphs.CarrierVariables | None
    inlier_share: float

    @staticmethod
    def of(data: list[PairData], variables: Variables, options: RefineOptions) -> GeodesicModel:
        """Decide whether carrier poses are variables."""
        check_carriers(data, options)
        carriers = None
        if options.carrier_noise is not None and options.carrier_model != "propagated":
            candidates = graphs.CarrierVariables.of(data)
            if options.carrier_model == "variables" or candidates.is_shared:
                carriers = candidates
        elif options.carrier_noise is not None and graphs.CarrierVariables.of(data).is_shared:
            warnings.warn(
                "some measurements share a carrier pose, whose error does not average out between them, but its "
                "noise is propagated to each on its own: standard deviations are too small; take "
                "carrier_model='variables'",
                WeightsWarning,
                stacklevel=4,
            )
        share = 1.0
        if options.robust == "gnc":  # of a chi-square with 6 degrees of freedom, cut at its quantile
            cut = chdtri(6, 1.0 - options.inlier_confidence)
            share = float(chdtr(8, cut) / options.inlier_confidence)
        return GeodesicModel(data, variables, options, carriers, share)

    @property
    def is_m_estimate(self) -> bool:
        """Whether one of GTSAM's losses weighs each measurement."""
        return self.options.robust in graphs.LOSSES

    @property
    def reweighs(self) -> bool:
        """Whether the factors depend on the estimate: A's noise is carried into the residual at it."""
        return self.options.carrier_noise is not None and self.carriers is None

    @property
    def given_noise(self) -> dict[Pair, tuple[float, float]]:
        """Standard deviations as given, root mean square over measurements and axes: rad and metres."""
        result = {}
        for item in self.data:
            variances = np.einsum("nii->i", item.covariance) / item.count
            result[item.pair] = (float(np.sqrt(variances[:3].mean())), float(np.sqrt(variances[3:].mean())))
        return result

    def linearize(self, state: State) -> dict[Pair, Linearization]:
        """Residuals and Jacobians of every pair at an estimate."""
        return linearized(self.data, self.variables, state)

    def covariances(self, state: State, factors: FactorsByPair) -> dict[Pair, Array]:
        """(N, 6, 6) of every pair's residuals at an estimate."""
        at = self.linearize(state)
        return {i.pair: residual_covariance(i, at[i.pair], factors[i.pair]) for i in self.data}

    def graph(self, state: State, factors: FactorsByPair, robust: Robust | None = None) -> gtsam.NonlinearFactorGraph:
        """The measurements' factors, weighed as of an estimate; in another loss than the options', if told."""
        loss = self.options.robust if robust is None else robust
        graph = gtsam.NonlinearFactorGraph()
        here = [
            dataclasses.replace(item, residuals=item.at(state.offsets_s.get(item.pair.sensor, 0.0)))
            for item in self.data
        ]
        rest = here
        if self.carriers is not None:
            graphs.add_with_carriers(graph, self.variables, here, self.carriers, factors, loss)
            rest = [item for item in here if item.pair not in self.carriers.index]
        covariances = self.covariances(state, factors) if rest else {}
        if loss in graphs.LOSSES:
            graphs.add_single(graph, self.variables, rest, covariances, loss)
        else:
            roots = {item.pair: square_root_information(covariances[item.pair]) for item in rest}
            graphs.add_batches(graph, self.variables, rest, roots)
        return graph

    @property
    def first_loss(self) -> Robust | None:
        """A loss without local minima to start under, for those that let go of what is far away."""
        return "huber" if self.is_m_estimate and self.options.robust != "huber" else None

    def values(self, state: State) -> gtsam.Values:
        """An estimate with the carrier poses as measured, where they are variables."""
        values = self.variables.values(state)
        if self.carriers is not None:
            for i, A in enumerate(self.carriers.A):
                values.insert(carrier_key(i), to_pose3(A[:3, :3], A[:3, 3]))
        return values

    def information_graph(self, state: State, factors: FactorsByPair) -> gtsam.NonlinearFactorGraph:
        """The measurements' factors without a loss: what the information is of, up to ``inefficiency``."""
        return self.graph(state, factors, "none")

    def inefficiency(self, state: State, factors: FactorsByPair) -> float:
        """By what a loss widens the covariance of least squares: Huber's E psi^2 / (E psi')^2, for 6 dimensions.

        (Huber and Ronchetti, Robust Statistics, eq. 7.87, whose psi' is here the divergence of w(|u|) u over 6.)
        """
        if not self.is_m_estimate:
            return 1.0
        loss = graphs.loss_of(self.options.robust)
        lengths = np.concatenate([np.linalg.norm(u, axis=1) for u in self._whitened(state, factors).values()])
        weight = np.array([loss.weight(d) for d in lengths])
        step = 1e-5
        slope = np.array([(loss.weight(d + step) - loss.weight(max(d - step, 0.0))) for d in lengths]) / (
            step + np.minimum(lengths, step)
        )
        unknowns = sum(unknown.dimension for unknown in self.variables.unknowns)
        degrees_of_freedom = max(6 * len(lengths) - unknowns, 1)
        square = float(np.sum((weight * lengths) ** 2)) / degrees_of_freedom
        gain = float(np.mean(weight + slope * lengths / 6.0))
        if not gain > 0.05:
            raise NoiseError(
                f"robust={self.options.robust!r} leaves next to nothing of the measurements (mean weight "
                f"{weight.mean():.2g}): half of the residuals are beyond {np.median(lengths):.3g} standard "
                "deviations, so either the noise is larger than given (noise='estimate') or outliers have pulled the "
                "start away (robust='gnc' needs none)"
            )
        return square / gain**2

    def next_factors(
        self, state: State, joint: JointCovariance, factors: FactorsByPair, groups: NoiseGroups
    ) -> VarianceComponents:
        """Variance factors from the residuals at an estimate."""
        at = self.linearize(state)
        components = from_measurements(
            self.data, at, self.variables, joint, factors, groups, consistency=self.inlier_share
        )
        if not self.is_m_estimate:
            return components
        return VarianceComponents(
            self._median_factors(state, factors, groups, components), components.degrees_of_freedom
        )

    def _whitened(self, state: State, factors: FactorsByPair) -> dict[Pair, Array]:
        at = self.linearize(state)
        result = {}
        for item in self.data:
            covariance = residual_covariance(item, at[item.pair], factors[item.pair])
            result[item.pair] = np.einsum("nij,nj->ni", square_root_information(covariance), at[item.pair].residual)
        return result

    def _median_factors(
        self, state: State, factors: FactorsByPair, groups: NoiseGroups, components: VarianceComponents
    ) -> FactorsByPair:
        """Where outliers are expected: medians of squared residuals against a chi-square's, 3 dimensions each."""
        at = self.linearize(state)
        squares: dict[tuple[Group, int], list[Array]] = {}
        for item in self.data:
            covariance = residual_covariance(item, at[item.pair], factors[item.pair])
            for i, block in enumerate((slice(0, 3), slice(3, 6))):
                r = at[item.pair].residual[:, block]
                square = np.einsum("ni,nij,nj->n", r, np.linalg.inv(covariance[:, block, block]), r)
                squares.setdefault((group_of(item.pair, groups), i), []).append(square)
        ratios = {}
        for (group, i), values in squares.items():
            all_squares = np.concatenate(values)
            degrees_of_freedom = components.degrees_of_freedom[group, COMPONENTS[i]] / (3.0 * len(all_squares))
            ratios[group, i] = max(float(np.median(all_squares)) / float(chdtri(3, 0.5)) / degrees_of_freedom, SMALLEST)
        return {
            pair: VarianceFactors(*(factor * ratios[group_of(pair, groups), i] for i, factor in enumerate(old)))
            for pair, old in factors.items()
        }


def linearized(data: list[PairData], variables: Variables, state: State) -> dict[Pair, Linearization]:
    """Residuals and Jacobians of pairs at an estimate."""
    frames = {name: pose.matrix() for name, pose in (state.X | state.Y).items()}
    result = {}
    for item in data:
        scale = variables.scale_of_pair.get(item.pair)
        offset_s = state.offsets_s.get(item.pair.sensor, 0.0)
        result[item.pair] = item.at(offset_s).linearize(
            frames[item.pair.target],
            frames[item.pair.sensor],
            1.0 if scale is None else state.scales[scale],
            offset_s,
        )
    return result
