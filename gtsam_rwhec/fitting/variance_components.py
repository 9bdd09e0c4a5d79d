"""Variance factors of rotations and translations, estimated from the residuals.

The method is restricted maximum likelihood by its fixed point (Helmert's and Foerstner's variance components). C is the
residuals' covariance, S the part of C that a factor multiplies, and P = C^-1 - C^-1 J Cov J' C^-1. At the optimum the
expectation of r' C^-1 S C^-1 r is tr(P S P C). The next factor is the factor times the ratio of the two numbers. The
fitted unknowns make the residuals smaller (the J Cov J' term): without this term 20 measurements would seem less noisy
than they are.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from rwhec_factors.batch import AT_ONCE, Linearization

from gtsam_rwhec.errors import NoiseError
from gtsam_rwhec.fitting.fit_options import NoiseGroups
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.pair_data import (
    COMPONENTS,
    FactorsByPair,
    Group,
    PairData,
    group_label,
    group_of,
    residual_covariance,
)
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind, Variables
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.selection import VarianceFactors
from gtsam_rwhec.solver.parts import Part

#: A variance factor is at least this part of the noise as given (or of 1 m and 1 rad, where none was given).
SMALLEST = 1e-20


@dataclass(frozen=True)
class VarianceComponents:
    """Variance factors, and by group and component the degrees of freedom that they are estimated with."""

    factors: FactorsByPair
    degrees_of_freedom: dict[tuple[Group, str], float]


@dataclass
class _Sums:
    """Sums over a group: r' C^-1 S C^-1 r of rotation and translation, their expectations, which are also the degrees
    of freedom, and the Fisher information of the logarithms of both factors."""

    found: Array = field(default_factory=lambda: np.zeros(2))
    expected: Array = field(default_factory=lambda: np.zeros(2))
    fisher: Array = field(default_factory=lambda: np.zeros((2, 2)))


def jacobian_of(item: PairData, at: Linearization, variables: Variables, joint: JointCovariance) -> tuple[Array, Array]:
    """A pair's Jacobian (N, m, u) by the unknowns in its residuals, and their rows in ``joint``."""
    pair, blocks = item.pair, dict[Unknown, Array]()
    for name, block in ((pair.target, at.target), (pair.sensor, at.sensor)):
        frame = Unknown(UnknownKind.FRAME, name)
        if frame in joint.slots:
            blocks[frame] = blocks[frame] + block if frame in blocks else block
    scale = variables.scale_of_pair.get(pair)
    if scale is not None:
        blocks[scale] = at.scale[:, :, None]
    if pair.sensor in variables.offsets:
        blocks[Unknown(UnknownKind.TIME_OFFSET, pair.sensor)] = at.offset[:, :, None]
    if pair.sensor in variables.rates:
        since_s = item.since_s(variables.rates[pair.sensor])
        blocks[Unknown(UnknownKind.CLOCK_RATE, pair.sensor)] = at.offset[:, :, None] * since_s[:, None, None]
    if not blocks:
        return np.zeros((len(at.residual), at.residual.shape[1], 0)), np.zeros(0, dtype=np.int64)
    return np.concatenate(list(blocks.values()), axis=2), joint.rows(tuple(blocks))


def from_measurements(
    data: list[PairData],
    at: dict[Pair, Linearization],
    variables: Variables,
    joint: JointCovariance,
    factors: FactorsByPair,
    groups: NoiseGroups,
    consistency: float = 1.0,
) -> VarianceComponents:
    """The next factors, from geodesic residuals; NoiseError if a group has no degree of freedom.

    ``joint`` is the covariance of the unknowns at the current factors. ``consistency`` is the share of its variance
    that a residual keeps when residuals beyond a threshold are left out.
    """
    sums: dict[Group, _Sums] = {}
    alike: dict[tuple[Group, int], list[tuple[Array, ...]]] = {}  # pairs of a group, some together
    chunks = np.cumsum([item.count for item in data]) // AT_ONCE
    for item, chunk in zip(data, chunks.tolist(), strict=True):
        pair, linear = item.pair, at[item.pair]
        C = residual_covariance(item, linear, factors[pair])
        J, rows = jacobian_of(item, linear, variables, joint)
        left = C - J @ joint.finite[np.ix_(rows, rows)] @ J.transpose(0, 2, 1)  # the expectation of r r'
        d = np.sqrt(np.repeat(factors[pair], 3))
        parts = C, left, item.measured * d[:, None] * d, linear.residual
        alike.setdefault((group_of(pair, groups), chunk), []).append(parts)
    for (group, _), found in alike.items():
        C, left, whole, residual = (np.concatenate(each) for each in zip(*found, strict=True))
        inverse = np.linalg.inv(C)
        whitened = np.einsum("nij,nj->ni", inverse, residual)
        total = sums.setdefault(group, _Sums())
        scaled = []
        for k, block in enumerate((slice(0, 3), slice(3, 6))):
            # d (D Sigma D) / d log f_k: half of the block's rows plus half of its columns.
            S = np.zeros_like(whole)
            S[:, block] += 0.5 * whole[:, block]
            S[:, :, block] += 0.5 * whole[:, :, block]
            scaled.append(inverse @ S)
            total.found[k] += float(np.einsum("ni,nij,nj->", whitened, S, whitened))
            total.expected[k] += float(np.einsum("nij,nji->", scaled[k], inverse @ left))
        total.fisher += np.einsum("knij,mnji->km", scaled, scaled)
    steps = {group: _step(group, total, consistency) for group, total in sums.items()}
    return VarianceComponents(
        {
            pair: VarianceFactors(*np.maximum(np.array(old) * steps[group_of(pair, groups)], SMALLEST).tolist())
            for pair, old in factors.items()
        },
        {
            (group, component): float(total.expected[k])
            for group, total in sums.items()
            for k, component in enumerate(COMPONENTS)
        },
    )


def _step(group: Group, total: _Sums, consistency: float) -> Array:
    """The numbers (2,) that multiply the factors of rotation and translation."""
    has = np.diagonal(total.fisher) > 0.0  # of points no rotation is measured
    for k, component in enumerate(COMPONENTS):
        if has[k]:
            _check(group, component, float(total.expected[k]), float(total.fisher.sum()))
    found = total.found / consistency
    ratios = np.where(has, found / np.where(has, total.expected, 1.0), 1.0)
    size = np.sqrt(np.diagonal(total.fisher))
    if not has.all():
        return np.maximum(ratios, 1e-12)
    if abs(total.fisher[0, 1]) < 0.05 * size[0] * size[1]:
        # A sum below zero (rotation and translation are correlated, far from their sizes) has no ratio: a step down.
        result: Array = np.where(ratios < 0.0, 0.5, np.maximum(ratios, 1e-12))
        return result
    # Correlated: each factor changes both components' residuals. First their common size, then Fisher scoring on both.
    common = float(found.sum() / total.expected.sum())
    if not 0.5 < common < 2.0:
        return np.full(2, max(common, 1e-12))
    information = total.fisher * (total.expected.sum() / total.fisher.sum())
    step: Array = np.exp(np.clip(np.linalg.solve(information, found - total.expected), -1.0, 0.5))
    return step


def from_moments(
    parts: list[Part],
    costs: dict[Pair, tuple[float, float]],
    fitted: dict[Pair, tuple[float, float]],
    groups: NoiseGroups,
) -> VarianceComponents:
    """The next factors, from moments; NoiseError if a group has no degree of freedom.

    ``costs`` are (J_R, J_t) of each pair at the weights as given. ``fitted`` are tr(Cov Lambda) of its rotation and
    translation residuals: the number of equations that the unknowns take up.
    """
    sums: dict[tuple[Group, str], list[float]] = {}
    for part in parts:
        for pair, count in zip(part.pairs, part.moments.count, strict=True):
            for i, component in enumerate(COMPONENTS):
                total = sums.setdefault((group_of(pair, groups), component), [0.0, 0.0])
                total[0] += 2.0 * costs[pair][i]
                total[1] += 3.0 * float(count) - fitted[pair][i]
    ratios = {}
    for (group, kind), (found, expected) in sums.items():
        _check(group, kind, expected, expected)
        ratios[group, kind] = max(found / expected, SMALLEST)
    return VarianceComponents(
        {
            pair: VarianceFactors(*(ratios[group_of(pair, groups), component] for component in COMPONENTS))
            for part in parts
            for pair in part.pairs
        },
        {key: expected for key, (_, expected) in sums.items()},
    )


def _check(group: Group, component: str, degrees_of_freedom: float, weighed: float) -> None:
    """Refuse to estimate without degrees of freedom; ``weighed`` is the part of the residuals' variance from B."""
    if degrees_of_freedom > 0.5:
        return
    where = group_label(group)
    if weighed < 0.5:
        raise NoiseError(
            f"the {component} noise of {where} cannot be estimated: the noise given for A already explains the "
            "residuals. Give less noise of A, or give sigma and kappa of B (noise='given')"
        )
    joined = "" if group is None else "join groups (noise_groups='all'), "
    raise NoiseError(
        f"the {component} noise of {where} cannot be estimated: the measurements are hardly more than the unknowns "
        f"({degrees_of_freedom:.2g} degrees of freedom). "
        f"Measure more, {joined}give less noise of A if you gave any, or give sigma and kappa (noise='given')"
    )
