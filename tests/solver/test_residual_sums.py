"""Sums of residuals in plain doubles are near the exact ones, and are not taken where they are not near enough."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from small_problems import optimum

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.solver import residual_sums as plain_residuals
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.parts import parts_of
from gtsam_rwhec.solver.residual_sums import Coefficients, Measured, Sums, weighted_sums


def inputs(scale: rw.ScaleMode, *, uniform: bool, offset_m: float, sigma_m: float) -> tuple[Measured, Coefficients]:
    """What the sums of the answer of a problem with two targets and two sensors are made of."""
    noise = Noise(sigma_m=sigma_m, kappa=0.5 / sigma_m**2)
    simulated = general(2, 2, seed=3, noise=noise, number_of_measurements=3000, scale=scale).problem
    generator = np.random.default_rng(4)
    problem = rw.Problem(scale)
    left = np.eye(4)
    left[:3, 3] = offset_m, -offset_m, offset_m
    for pair in simulated.pairs:
        raw = simulated.measurements(*pair)
        many = 1.0 if uniform else generator.uniform(0.5, 2.0, len(raw.A))
        problem.add(*pair, left @ raw.A, raw.B, noise.sigma_m * many, noise.kappa * many)
    (part,) = parts_of(problem)
    form = PartForm.of(part)
    _, evaluation = form.answer_near(optimum(problem).R)
    whole = slice(0, len(part.pairs))
    return form.cost._coefficients(evaluation.ends(whole), whole)


def off_by(first: Sums, second: Sums) -> float:
    """The largest difference of two sums, in terms of both bounds together."""
    worst = 0.0
    for name in (field.name for field in fields(Sums) if not field.name.endswith("_error")):
        bound = getattr(first, f"{name}_error") + getattr(second, f"{name}_error")
        difference = np.abs(getattr(first, name) - getattr(second, name))
        worst = max(worst, float((difference / np.maximum(bound, 1e-300)).max()))
    return worst


@pytest.mark.parametrize("scale", ["known", "shared", "per_target"])
@pytest.mark.parametrize("uniform", [True, False])
def test_within_their_bounds_of_the_exact_sums(scale: rw.ScaleMode, uniform: bool) -> None:
    measured, coefficients = inputs(scale, uniform=uniform, offset_m=5.0, sigma_m=0.01)
    plain, exact = plain_residuals.plain_sums(measured, coefficients), weighted_sums(measured, coefficients)
    assert plain is not None
    assert off_by(plain, exact) <= 1.0
    assert plain.products_error.sum() <= plain_residuals.KNOWN * plain.products.sum()


def test_bounds_hold_where_doubles_tell_little(monkeypatch: pytest.MonkeyPatch) -> None:
    measured, coefficients = inputs("known", uniform=True, offset_m=1e6, sigma_m=1e-6)
    assert plain_residuals.plain_sums(measured, coefficients) is None
    monkeypatch.setattr(plain_residuals, "KNOWN", np.inf)
    plain, exact = plain_residuals.plain_sums(measured, coefficients), weighted_sums(measured, coefficients)
    assert plain is not None
    assert off_by(plain, exact) <= 1.0
    assert np.abs(plain.products - exact.products).sum() > exact.products_error.sum()


def test_few_measurements_are_summed_exactly() -> None:
    measured, coefficients = inputs("known", uniform=True, offset_m=0.0, sigma_m=0.01)
    few = Measured(measured.batches[:1], measured.a, measured.c, measured.is_swapped)
    assert plain_residuals.plain_sums(few, coefficients) is None
