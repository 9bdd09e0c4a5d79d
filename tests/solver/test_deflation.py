"""The eigenvalue that deflation proves, and Z x in extended precision, against exact arithmetic."""

from __future__ import annotations

import dataclasses
from fractions import Fraction

import exact_arithmetic as exact
import numpy as np
import pytest
from small_problems import flat, multipliers_at, optimum, reduced, simulated

from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.simulate import Motion, Noise
from gtsam_rwhec.solver import arrow
from gtsam_rwhec.solver.bound import lower_bound
from gtsam_rwhec.solver.deflation import deflated_eigenvalue
from gtsam_rwhec.solver.lagrangian import lagrangian
from gtsam_rwhec.solver.local_blocks import scatter
from gtsam_rwhec.solver.reduced_form import ReducedForm
from gtsam_rwhec.solver.rotations import CONSTRAINTS, random_rotations
from gtsam_rwhec.solver.verified import cholesky_allowance


def proven(form: ReducedForm) -> float:
    """What it proves of Q' itself, whose forming rounds nothing: all multipliers zero."""
    arrow_part = arrow.dense(form.D, form.C, form.E)[:-1, :-1]
    slack = 2.0 * cholesky_allowance(np.diagonal(arrow_part), len(arrow_part) + len(form.G)).reshape(-1, 9)
    multipliers = np.zeros((form.rotations, 20))
    return deflated_eigenvalue(form, multipliers, arrow_part, np.zeros(len(arrow_part)), slack)


def is_exactly_above(form: ReducedForm, eigenvalue: float) -> bool:
    """Whether Q'_rr - eigenvalue I is positive definite, in fractions."""
    Q = exact.stored_matrix(form)[:-1, :-1]
    shift = np.array([[Fraction(eigenvalue) if i == j else Fraction(0) for j in range(len(Q))] for i in range(len(Q))])
    return exact.is_positive_definite(Q - shift)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("kind", "scale"),
    [("planar", "known"), ("planar", "shared"), ("none", "shared"), ("general", "shared"), ("single_axis", "shared")],
)
def test_no_eigenvalue_is_below(kind: str, scale: ScaleMode, seed: int) -> None:
    """Forms of exact data with one zero eigenvalue or two; and tight: a thousandth of the plain test's slack."""
    form = reduced(simulated(1, 1, seed, motion=kind, noise=None, scale=scale).problem)
    below = proven(form)
    assert -1e-16 * form.magnitude < below <= 0.0
    assert is_exactly_above(form, below - 1e-30 * form.magnitude)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("depth", [1e-15, 1e-14, 1e-13])
def test_a_negative_eigenvalue_is_not_hidden(depth: float, seed: int) -> None:
    """The smallest eigenvalue moved below zero by less than the verified test can tell from zero."""
    form = reduced(simulated(1, 1, seed, motion="planar", noise=None).problem)
    shift = depth * form.magnitude
    form = dataclasses.replace(form, D=form.D - shift * np.eye(9), E=form.E - shift * np.eye(10))
    below = proven(form)
    assert below <= -0.9 * shift
    assert below == -np.inf or is_exactly_above(form, below)


def test_nothing_small_to_take_out_is_nothing_proven() -> None:
    """It is asked only where Z is singular."""
    form = reduced(simulated(1, 1, motion=Motion("general"), noise=Noise(0.1, 100.0)).problem)
    assert proven(form) == -np.inf


@pytest.mark.parametrize("scale", ["known", "shared"])
@pytest.mark.parametrize("seed", range(3))
def test_free_answers_lose_next_to_nothing(seed: int, scale: str) -> None:
    problem = simulated(4, 3, seed, motion="planar", scale=scale).problem
    form, end = reduced(problem), optimum(problem)
    bound = lower_bound(form, multipliers_at(form, end.R), flat(end.R))
    assert bound.semidefinite
    assert not bound.definite
    assert end.cost - bound.lower_bound <= 1e-14 * form.magnitude


@pytest.mark.parametrize("last", [0.0, 1.0])
@pytest.mark.parametrize("seed", range(5))
def test_extended_precision_keeps_within_its_stated_rounding(seed: int, last: float) -> None:
    form = reduced(simulated(2, 1, seed, odometry=4, noise=Noise(0.01, 1e4)).problem)
    generator = np.random.default_rng(seed)
    multipliers = form.magnitude * generator.standard_normal((3, 20))
    for r in (flat(random_rotations(3, generator)), 10.0 ** generator.uniform(-8, 8, 27)):
        x = np.append(r, last)
        value, Zx, value_error, Zx_error = lagrangian(form, multipliers, x)
        Lambda = np.einsum("nk,kpq->npq", exact.fractions(multipliers), exact.fractions(CONSTRAINTS))
        full = np.full((28, 28), Fraction(0), dtype=object)
        for i, block in enumerate(Lambda):
            at = np.r_[9 * i : 9 * i + 9, 27]
            full[np.ix_(at, at)] += block
        assert np.abs(full.astype(float) - scatter(Lambda.astype(float))).max() < 1e-9 * form.magnitude
        product = (exact.stored_matrix(form) - full) @ exact.fractions(x)
        for ours, error, true in zip(Zx, Zx_error, product, strict=True):
            assert abs(Fraction(float(ours)) + Fraction(float(ours - np.longdouble(float(ours)))) - true) <= error
        assert abs(Fraction(float(value)) - exact.fractions(x) @ product) <= value_error + 2.0**-53 * abs(float(value))
