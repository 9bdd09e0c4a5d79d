"""Sums of residuals in plain doubles are near the exact ones, and are not taken where they are not near enough."""

from __future__ import annotations

import numpy as np
import pytest
from small_problems import optimum

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.solver import residual_sums
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.parts import parts_of
from gtsam_rwhec.solver.residual_sums import Coefficients, Measured, Sums, cost_sums, weighted_sums


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
    differences = [np.abs(a - b) for a, b in zip(_values(first), _values(second), strict=True)]
    bounds = [a + b for a, b in zip(_errors(first), _errors(second), strict=True)]
    return max(float((off / np.maximum(bound, 1e-300)).max()) for off, bound in zip(differences, bounds, strict=True))


def _values(sums: Sums) -> list[np.ndarray]:
    return [sums.products, *sums.by_features]


def _errors(sums: Sums) -> list[np.ndarray]:
    return [sums.products_error, *sums.by_features_error]


@pytest.mark.parametrize("scale", ["known", "shared", "per_target"])
@pytest.mark.parametrize("uniform", [True, False])
def test_within_their_bounds_of_the_exact_sums(scale: rw.ScaleMode, uniform: bool) -> None:
    measured, coefficients = inputs(scale, uniform=uniform, offset_m=5.0, sigma_m=0.01)
    plain, exact = cost_sums(measured, coefficients), weighted_sums(measured, coefficients)
    assert 0.0 < off_by(plain, exact) <= 1.0
    assert exact.products_error.sum() < plain.products_error.sum() <= residual_sums.KNOWN * plain.products.sum()


def test_bounds_hold_where_doubles_tell_little() -> None:
    measured, coefficients = inputs("known", uniform=True, offset_m=1e6, sigma_m=1e-6)
    plain, exact = weighted_sums(measured, coefficients, exact=False), weighted_sums(measured, coefficients)
    assert plain.products_error.sum() > residual_sums.KNOWN * plain.products.sum()
    assert off_by(plain, exact) <= 1.0
    assert np.abs(plain.products - exact.products).sum() > exact.products_error.sum()
    assert off_by(cost_sums(measured, coefficients), exact) == 0.0


def test_few_measurements_are_summed_exactly() -> None:
    measured, coefficients = inputs("known", uniform=True, offset_m=0.0, sigma_m=0.01)
    few = Measured(measured.batches[:1], measured.a, measured.c, measured.is_swapped)
    assert off_by(cost_sums(few, coefficients), weighted_sums(few, coefficients)) == 0.0
