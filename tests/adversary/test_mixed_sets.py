"""Certificates of mixed sets: tags, points, planes, registrations that slide and motions, in exact arithmetic."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from mixed_sets import exact_cost, mixed_set, solved
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.solver.answers import parts_about

RUN = 10
#: Mixed sets are proven to this relative gap.
PROVEN = 1e-12


@pytest.mark.parametrize("first", range(0, 40, RUN))
def test_random_mixed_sets_are_proven(first: int) -> None:
    for seed in range(first, first + RUN):
        found = solved(mixed_set(seed).problem)
        assert found.certificate.is_optimal, (seed, str(found.certificate))
        assert found.certificate.relative_gap <= PROVEN or found.certificate.region is not None, seed


@pytest.mark.parametrize("seed", range(6))
def test_what_a_certificate_says_is_true_in_exact_arithmetic(seed: int) -> None:
    things = [
        ("point_0",),
        ("plane_0", "point_1"),
        ("spread_0", "plane_1"),
        ("slide_0",),
        ("plane_0",),
        ("slide_0", "point_1"),
    ]
    of = mixed_set(seed, things[seed], count=8)
    found = solved(of.problem)
    scale = float(found.scale)
    said = rw.certify(of.problem, found.X, found.Y, scale)
    (part,) = parts_about(of.problem, found.X, found.Y, scale)

    def cost(move: np.ndarray) -> Fraction:
        total = Fraction(0)
        poses = {n: T.matrix() for n, T in (found.X | found.Y).items()}
        moved = {n: T @ se3.expmap(move[None, 6 * i : 6 * i + 6])[0] for i, (n, T) in enumerate(poses.items())}
        for pair in part.directed:
            target, sensor = part.pairs[pair.e]
            total += exact_cost(pair, moved[target], moved[sensor], scale)
        return total

    size = 6 * len(found.X | found.Y)
    assert cost(np.zeros(size)) <= said.cost
    rng = np.random.default_rng(seed)
    for step in (1e-9, 1e-6, 1e-3, 1.0):
        # Rotations are those of doubles: they meet their constraints to rounding, and the bound allows for that.
        assert said.lower_bound <= cost(step * rng.normal(size=size)) * (1 + Fraction(1, 10**12))
    assert found.certificate.relative_gap <= PROVEN
    assert said.relative_gap <= 1e-7  # its directions are those of the answer, not of the round before


@pytest.mark.campaign
@pytest.mark.parametrize("first", range(1000, 2000, 250))
def test_a_thousand_mixed_sets_are_proven(first: int) -> None:
    open_ones = [
        (seed, str(found.certificate))
        for seed in range(first, first + 250)
        for found in [solved(mixed_set(seed).problem)]
        if not found.certificate.is_optimal
    ]
    assert open_ones == []
