"""The weights of residuals: B's noise with its variance factors, and A's noise propagated into the residual."""

from __future__ import annotations

from typing import Literal

import numpy as np
from rwhec_factors.batch import Linearization

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.variance_factors import VarianceFactors
from gtsam_rwhec.refinement.options import NoiseGroups
from gtsam_rwhec.refinement.pair_data import PairData

#: The two components of a measurement's noise.
Component = Literal["rotation", "translation"]
COMPONENTS: tuple[Component, Component] = ("rotation", "translation")
#: Pairs that share a variance factor: one pair, all pairs of the sensor with this name, or all pairs (None).
Group = Pair | str | None
#: The variance factors of each pair.
FactorsByPair = dict[Pair, VarianceFactors]


def largest_change(before: FactorsByPair, after: FactorsByPair) -> float:
    """The largest change of a factor's logarithm."""
    ratios = np.array([after[pair] for pair in before]) / np.array(list(before.values()))
    return float(np.abs(np.log(ratios)).max(initial=0.0))


def group_of(pair: Pair, groups: NoiseGroups) -> Group:
    """The group that a pair is in."""
    if groups == "all":
        return None
    return pair.sensor if groups == "sensor" else pair


def group_label(group: Group) -> str:
    """The group's name in messages."""
    return "the measurements" if group is None else str(group)


def measurement_covariance(data: PairData, factors: VarianceFactors) -> Array:
    """B's covariances (N, 6, 6): D Sigma D, with the square roots of the factors on D's diagonal."""
    d = np.sqrt(np.repeat(factors, 3))
    scaled: Array = data.covariance * d[:, None] * d
    return scaled


def residual_covariance(data: PairData, at: Linearization, factors: VarianceFactors) -> Array:
    """Covariances (N, 6, 6) of the geodesic residual: B's, and A's through de/dA, to first order."""
    covariance = measurement_covariance(data, factors)
    if data.carrier is not None:
        covariance = covariance + at.carrier @ data.carrier @ at.carrier.transpose(0, 2, 1)
    return covariance


def square_root_information(covariance: Array) -> Array:
    """W (N, 6, 6) with W' W = covariance^-1: the inverse of the lower Cholesky factor."""
    L = np.linalg.cholesky(covariance)
    root: Array = np.linalg.solve(L, np.broadcast_to(np.eye(L.shape[-1]), L.shape))
    return root
