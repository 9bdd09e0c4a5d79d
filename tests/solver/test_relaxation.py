"""Choosing the solver, rounding its solution, and Section 4.3's inequality."""

from __future__ import annotations

import numpy as np
import pytest
from small_problems import GROSS_NOISE, optimum, reduced, simulated, true_rotations

from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.solver.nonnegative import scale_row, scale_spread
from gtsam_rwhec.solver.relaxation import (
    CLARABEL_SIZE,
    round_to_rotations,
    solve_by_clarabel,
    solve_relaxation,
    solve_with_scale,
)


@pytest.mark.parametrize(("sides", "solver"), [((1, 1), "Clarabel"), ((3, 2), "Clarabel"), ((3, 3), "interior point")])
def test_clarabel_where_its_cone_fits(sides: tuple[int, int], solver: str) -> None:
    Q = reduced(simulated(*sides).problem).Q
    assert (len(Q) <= CLARABEL_SIZE) == (solver == "Clarabel")
    assert solver in solve_relaxation(Q, 1e-9, 100).solver


@pytest.mark.parametrize("scale", ["known", "shared", "per_target"])
@pytest.mark.parametrize("sides", [(1, 1), (2, 2), (4, 3)])
def test_tight_solutions_round_to_the_optimum(sides: tuple[int, int], scale: ScaleMode) -> None:
    problem = simulated(*sides, 1, scale=scale).problem
    relaxation = solve_relaxation(reduced(problem).Q, 1e-9, 100)
    best = optimum(problem).R
    for R in round_to_rotations(relaxation):
        np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
        np.testing.assert_allclose(R, best, atol=1e-2)
    assert any(np.abs(R - best).max() < 1e-4 for R in round_to_rotations(relaxation))


def test_data_without_noise_round_to_the_truth() -> None:
    simulation = simulated(2, 2, 3, noise=None)
    starts = round_to_rotations(solve_relaxation(reduced(simulation.problem).Q, 1e-9, 100))
    assert min(np.abs(R - true_rotations(simulation)).max() for R in starts) < 1e-3


@pytest.mark.parametrize("seed", range(8))
def test_the_scales_inequality_only_raises_the_optimum(seed: int) -> None:
    """Where the scale is positive anyway it changes nothing; where it holds, its multiplier is positive."""
    form = reduced(simulated(1, 1, seed, noise=GROSS_NOISE, number_of_measurements=4, scale="shared").problem)
    free = solve_by_clarabel(form.Q, 1e-9, 100)
    held = solve_with_scale(form.Q, scale_row(form), scale_spread(form), 1e-9, 100)
    assert held.X.shape == free.X.shape
    assert held.dual >= free.dual - 1e-5 * abs(free.dual)
    if scale_row(form) @ free.X[:-1, -1] > 1e-3:
        assert held.dual == pytest.approx(free.dual, rel=1e-5)
        assert held.scale_multiplier == pytest.approx(0.0, abs=1e-4 * form.magnitude)
    else:
        assert held.scale_multiplier > 0.0
