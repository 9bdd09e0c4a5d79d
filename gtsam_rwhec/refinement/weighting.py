"""What weighs each residual: B's noise with its variance factors, and A's carried into the residual."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from rwhec_factors.batch import Linearization

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.refinement.options import NoiseGroups
from gtsam_rwhec.refinement.pair_data import PairData

#: Rotation and translation, the two components of a measurement's noise.
Component = Literal["rotation", "translation"]
COMPONENTS: tuple[Component, Component] = ("rotation", "translation")


@dataclass(frozen=True)
class VarianceFactors:
    """By what the given variances of B are multiplied: (rotation, translation) of each pair; 1 as given."""

    of: dict[Pair, tuple[float, float]]

    @staticmethod
    def ones(pairs: tuple[Pair, ...]) -> VarianceFactors:
        """As given."""
        return VarianceFactors(dict.fromkeys(pairs, (1.0, 1.0)))

    def distance(self, other: VarianceFactors) -> float:
        """Largest change of a logarithm."""
        mine, theirs = np.array(list(self.of.values())), np.array([other.of[pair] for pair in self.of])
        return float(np.abs(np.log(mine / theirs)).max(initial=0.0))


#: Whose residuals share a variance factor: ("all",), (sensor,) or (target, sensor).
Group = tuple[str, ...]


def group_of(pair: Pair, groups: NoiseGroups) -> Group:
    """The group whose residuals a pair's noise is estimated from."""
    if groups == "all":
        return ("all",)
    return (pair.sensor,) if groups == "sensor" else pair


def measurement_covariance(data: PairData, factors: tuple[float, float]) -> Array:
    """(N, 6, 6) of B: D Sigma D, with the square roots of the factors on D's diagonal."""
    d = np.sqrt(np.repeat(factors, 3))
    scaled: Array = data.covariance * d[:, None] * d
    return scaled


def residual_covariance(data: PairData, at: Linearization, factors: tuple[float, float], propagated: bool) -> Array:
    """(N, 6, 6) of the geodesic residual: that of B, and A's through de/dA, to first order."""
    covariance = measurement_covariance(data, factors)
    if propagated and data.carrier is not None:
        covariance = covariance + at.carrier @ data.carrier @ at.carrier.transpose(0, 2, 1)
    return covariance


def square_root_information(covariance: Array) -> Array:
    """W (N, 6, 6) with W' W = covariance^-1: the inverse of the lower Cholesky factor."""
    L = np.linalg.cholesky(covariance)
    root: Array = np.linalg.solve(L, np.broadcast_to(np.eye(L.shape[-1]), L.shape))
    return root
