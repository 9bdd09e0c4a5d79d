"""How noisy the measurements really were: variance factors of rotations and translations from the residuals.

Restricted maximum likelihood by its fixed point (Helmert's and Foerstner's variance components): at the optimum, with
C the residuals' covariance and P = C^-1 - C^-1 J Cov J' C^-1, the expectation of r' C^-1 S C^-1 r is tr(P S P C), S
being the part of C that a factor multiplies. The factor times the ratio of both is the next one. The unknowns that
were fitted take their share of the residuals away (the J Cov J' term): 6 N equations alone would call 20 measurements
quieter than they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rwhec_factors.batch import Linearization

from gtsam_rwhec.accumulation import Pair
from gtsam_rwhec.certify.parts import Part
from gtsam_rwhec.errors import NoiseError
from gtsam_rwhec.poses import Array
from gtsam_rwhec.refinement.joint_covariance import JointCovariance
from gtsam_rwhec.refinement.options import NoiseGroups
from gtsam_rwhec.refinement.pair_data import PairData
from gtsam_rwhec.refinement.variables import Variables
from gtsam_rwhec.refinement.weighting import (
    COMPONENTS,
    Group,
    VarianceFactors,
    group_of,
    measurement_covariance,
    residual_covariance,
)

#: No data are taken for quieter than this times what was given (or 1 m and 1 rad, where nothing was).
SMALLEST = 1e-20


@dataclass(frozen=True)
class VarianceComponents:
    """Factors, and by group and component how many equations to spare they rest on."""

    factors: VarianceFactors
    redundancy: dict[tuple[Group, str], float]


@dataclass
class _Sums:
    found: float = 0.0
    expected: float = 0.0
    redundancy: float = 0.0


def jacobian_of(pair: Pair, at: Linearization, variables: Variables, joint: JointCovariance) -> tuple[Array, Array]:
    """A pair's Jacobian (N, m, u) by the unknowns that it touches, and their rows in ``joint``."""
    blocks: dict[str, Array] = {}
    for name, block in ((pair[0], at.target), (pair[1], at.sensor)):
        if name in joint.slots:
            blocks[name] = blocks[name] + block if name in blocks else block
    scale = variables.scale_of_pair.get(pair)
    if scale is not None:
        blocks[scale] = at.scale[:, :, None]
    offset = f"time_offset:{pair[1]}"
    if offset in variables.offsets:
        blocks[offset] = at.offset[:, :, None]
    if not blocks:
        return np.zeros((len(at.residual), at.residual.shape[1], 0)), np.zeros(0, dtype=np.int64)
    return np.concatenate(list(blocks.values()), axis=2), joint.rows(tuple(blocks))


def from_measurements(
    data: list[PairData],
    at: dict[Pair, Linearization],
    variables: Variables,
    joint: JointCovariance,
    factors: VarianceFactors,
    groups: NoiseGroups,
    weights: dict[Pair, Array] | None = None,
    consistency: float = 1.0,
) -> VarianceComponents:
    """The next factors, from geodesic residuals.

    Parameters
    ----------
    data, at, variables, joint, factors
        The pairs, their residuals, and the covariance of the unknowns at the current factors.
    groups : "all", "sensor" or "pair"
    weights : dict of pair to (N,) array, optional
        What a robust loss leaves of each measurement.
    consistency : float
        Share of their variance that residuals keep when those beyond a threshold are left out.

    Raises
    ------
    NoiseError
        When a group has no equation to spare.
    """
    sums: dict[tuple[Group, str], _Sums] = {}
    for item in data:
        pair, linear = item.pair, at[item.pair]
        C = residual_covariance(item, linear, factors.of[pair], propagated=True)
        inverse = np.linalg.inv(C)
        J, rows = jacobian_of(pair, linear, variables, joint)
        fitted = J @ joint.finite[np.ix_(rows, rows)] @ J.transpose(0, 2, 1)
        left = C - fitted  # expected r r'
        w = np.ones(item.count) if weights is None else weights[pair]
        whole = measurement_covariance(item, factors.of[pair])
        for component, block in zip(COMPONENTS, (slice(0, 3), slice(3, 6)), strict=True):
            S = np.zeros_like(whole)
            S[:, block, block] = whole[:, block, block]
            M = inverse @ S @ inverse
            total = sums.setdefault((group_of(pair, groups), component), _Sums())
            total.found += float(np.einsum("n,ni,nij,nj->", w, linear.residual, M, linear.residual))
            total.expected += float(np.einsum("n,nij,nji->", w, M, left))
            total.redundancy += float(np.einsum("n,nij,nji,n->", w, inverse @ S, inverse @ left, w))
    ratios = {key: _ratio(*key, total) / consistency for key, total in sums.items()}
    updated = {}
    for item in data:
        group = group_of(item.pair, groups)
        old = factors.of[item.pair]
        updated[item.pair] = (
            max(old[0] * ratios[group, "rotation"], SMALLEST),
            max(old[1] * ratios[group, "translation"], SMALLEST),
        )
    return VarianceComponents(VarianceFactors(updated), {key: total.redundancy for key, total in sums.items()})


def from_moments(
    parts: list[Part],
    costs: dict[Pair, tuple[float, float]],
    fitted: dict[Pair, tuple[float, float]],
    groups: NoiseGroups,
) -> VarianceComponents:
    """The next factors, from moments.

    Parameters
    ----------
    parts : list of Part
    costs : dict of pair to (J_R, J_t)
        At the weights as given.
    fitted : dict of pair to (float, float)
        tr(Cov Lambda) of the pair's rotation and translation residuals: the equations that the unknowns used up.
    groups : "all", "sensor" or "pair"

    Raises
    ------
    NoiseError
        When a group has no equation to spare.
    """
    sums: dict[tuple[Group, str], _Sums] = {}
    for part in parts:
        for pair, count in zip(part.pairs, part.moments.count, strict=True):
            for i, component in enumerate(COMPONENTS):
                total = sums.setdefault((group_of(pair, groups), component), _Sums())
                total.found += 2.0 * costs[pair][i]
                total.expected += 3.0 * float(count) - fitted[pair][i]
    for total in sums.values():
        total.redundancy = total.expected
    ratios = {key: max(_ratio(*key, total), SMALLEST) for key, total in sums.items()}
    pairs = [pair for part in parts for pair in part.pairs]
    return VarianceComponents(
        VarianceFactors(
            {
                pair: (ratios[group_of(pair, groups), "rotation"], ratios[group_of(pair, groups), "translation"])
                for pair in pairs
            }
        ),
        {key: total.redundancy for key, total in sums.items()},
    )


def _ratio(group: Group, component: str, total: _Sums) -> float:
    if not total.redundancy > 0.5:
        where = "the measurements" if group == ("all",) else "-".join(group)
        raise NoiseError(
            f"the {component} noise of {where} cannot be estimated: {total.redundancy:.2g} equations to spare; measure "
            "more, join groups (noise_groups='all'), or give sigma and kappa (noise='given')"
        )
    return total.found / total.expected
