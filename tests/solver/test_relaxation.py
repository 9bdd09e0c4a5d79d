"""Choosing the solver, rounding its solution, and Section 4.3's inequality."""

from __future__ import annotations

from pathlib import Path

import clarabel
import numpy as np
import pytest
import scipy.sparse
from small_problems import GROSS_NOISE, bound_at, optimum, reduced, simulated, true_rotations, whole

import gtsam_rwhec as rw
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.simulate import Motion, Noise
from gtsam_rwhec.solver.nonnegative import scale_row, scale_spread
from gtsam_rwhec.solver.relaxation import (
    CLARABEL_SIZE,
    Relaxation,
    round_to_rotations,
    solve_by_blocks,
    solve_by_clarabel,
    solve_conic,
    solve_relaxation,
    solve_with_scale,
    stacked,
    unstacked,
)
from gtsam_rwhec.solver.rotations import CONSTRAINTS
from gtsam_rwhec.solver.small_dual import scatter


def test_the_stacked_triangle_keeps_inner_products_and_is_undone() -> None:
    M, N = (M + M.T for M in np.random.default_rng(0).standard_normal((2, 5, 5)))
    assert stacked(M) @ stacked(N) == pytest.approx(np.vdot(M, N), rel=1e-14)
    np.testing.assert_allclose(unstacked(np.r_[stacked(M), 7.0], 5), M, atol=1e-15)


def test_the_smallest_eigenvalue_is_the_largest_shift_that_stays_semidefinite() -> None:
    M = np.random.default_rng(1).standard_normal((6, 6))
    M = M + M.T
    A = scipy.sparse.csc_matrix(stacked(np.eye(6))[:, None])
    x, z, iterations = solve_conic(np.array([-1.0]), A, stacked(M), [clarabel.PSDTriangleConeT(6)], 1e-10, 100)
    assert x[0] == pytest.approx(np.linalg.eigvalsh(M)[0], rel=1e-8)
    assert np.trace(unstacked(z, 6)) == pytest.approx(1.0, rel=1e-8)
    assert 0 < iterations < 100


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


SIDES = {1: (1, 1), 2: (1, 1), 3: (2, 1), 4: (2, 2), 5: (3, 2)}


def problem_of(frames: int, scale: ScaleMode, seed: int = 0, gross: bool = False) -> rw.Problem:
    options = {"noise": GROSS_NOISE, "number_of_measurements": 4} if gross else {}
    simulation = simulated(*SIDES[frames], seed, scale=scale, **options)
    if frames == 1:
        simulation.problem.fix("sensor0", simulation.Y["sensor0"])
    return simulation.problem


def accuracy(Q: Array) -> float:
    """What an interior-point method reaches in double precision where X has rank one, absolutely."""
    return 1e-6 * float(np.abs(Q).max())


def infeasibility(Q: Array, relaxation: Relaxation) -> tuple[float, float, float, float]:
    """How far X and Z are from feasible, relative: X's constraints, its eigenvalues, Z's eigenvalues, <X, Z>."""
    n = len(relaxation.multipliers)
    Z = Q - scatter(np.einsum("nk,kpq->npq", relaxation.multipliers, CONSTRAINTS))
    Z[-1, -1] -= relaxation.dual
    X = relaxation.X
    violations = [
        np.vdot(scatter(np.where(np.arange(n)[:, None, None] == i, A, 0.0)), X) for i in range(n) for A in CONSTRAINTS
    ]
    size = float(np.abs(Q).max())
    return (
        float(np.abs(violations).max()),
        float(np.linalg.eigvalsh(X)[0]),
        float(np.linalg.eigvalsh(Z)[0]) / size,
        float(np.vdot(X, Z)) / size,
    )


@pytest.mark.parametrize("gross", [False, True])
@pytest.mark.parametrize("scale", ["known", "shared"])
@pytest.mark.parametrize("frames", SIDES)
def test_it_agrees_with_clarabel(frames: int, scale: ScaleMode, gross: bool) -> None:
    Q = reduced(problem_of(frames, scale, gross=gross)).Q
    ours, theirs = solve_by_blocks(Q, 1e-9, 100), solve_by_clarabel(Q, 1e-9, 100)
    assert ours.solver != theirs.solver
    for relaxation in (ours, theirs):
        assert relaxation.primal == pytest.approx(relaxation.dual, abs=accuracy(Q))
    assert ours.dual == pytest.approx(theirs.dual, abs=accuracy(Q))
    assert ours.iterations < 60


@pytest.mark.parametrize("scale", ["known", "shared"])
@pytest.mark.parametrize("frames", SIDES)
def test_its_solutions_are_feasible_and_complementary(frames: int, scale: ScaleMode) -> None:
    Q = reduced(problem_of(frames, scale)).Q
    relaxation = solve_by_blocks(Q, 1e-9, 100)
    constraints, smallest_of_X, smallest_of_Z, product = infeasibility(Q, relaxation)
    assert constraints < 1e-9
    assert smallest_of_X > -1e-12
    assert smallest_of_Z > -1e-14
    assert abs(product * float(np.abs(Q).max()) - (relaxation.primal - relaxation.dual)) < accuracy(Q)
    assert 0.0 < product < 1e-6


@pytest.mark.parametrize("scale", ["known", "shared"])
@pytest.mark.parametrize("frames", SIDES)
def test_tight_relaxations_reach_the_certified_optimum(frames: int, scale: ScaleMode) -> None:
    for seed in range(3):
        problem = problem_of(frames, scale, seed)
        form, end = reduced(problem), optimum(problem)
        bound, _ = bound_at(whole(problem), end.R)
        assert end.cost - bound.lower_bound < 1e-6 * end.cost
        relaxation = solve_by_blocks(form.Q, 1e-9, 100)
        assert relaxation.dual == pytest.approx(end.cost, abs=accuracy(form.Q))
        # Rank one, and its h column is x: with unknown scale too, since the handedness couples to h.
        values = np.linalg.eigvalsh(relaxation.X)
        assert values[-2] < 1e-3 * values[-1]


@pytest.mark.parametrize("frames", [1, 2, 4])
def test_data_without_noise_end_at_zero(frames: int) -> None:
    simulation = simulated(*SIDES[frames], noise=None)
    form = reduced(simulation.problem)
    relaxation = solve_by_blocks(form.Q, 1e-9, 100)
    assert abs(relaxation.dual) < 1e-8 * form.magnitude


@pytest.mark.parametrize("seeds", [range(600, 604), pytest.param(range(604, 620), marks=pytest.mark.campaign)])
def test_the_end_of_double_precision_is_no_error(seeds: range) -> None:
    """Two measurements a pair, hardly any turning, a scale each: X or Z loses its definiteness on the way."""
    for seed in seeds:
        simulation = simulated(
            *(4, 3),
            seed,
            graph="star",
            motion=Motion(max_angle_rad=0.05),
            number_of_measurements=2,
            scale="per_target",
            noise=Noise(0.0126, 66000.0),
        )
        relaxation = solve_by_blocks(reduced(simulation.problem).Q, 0.0, 300)
        assert relaxation.iterations < 300
        assert np.isfinite(relaxation.multipliers).all()


def test_it_reports_as_it_goes() -> None:
    said: list[str] = []
    solve_by_blocks(reduced(problem_of(3, "known")).Q, 1e-9, 100, said.append)
    assert len(said) >= 2
    assert all("semidefinite relaxation, iteration" in each for each in said)


def test_real_dataset(utias_folder: Path) -> None:
    """24 frames, a 217 x 217 cone, which Clarabel does not hold."""
    problem = rw.read_csv(utias_folder, scale="known", sigma=1.0, kappa=1.0)
    Q = reduced(problem).Q
    assert Q.shape == (217, 217)
    relaxation = solve_by_blocks(Q, 1e-9, 100)
    assert relaxation.dual == pytest.approx(8.2812454, rel=1e-5)
    assert relaxation.primal == pytest.approx(8.2812454, rel=1e-3)
    assert relaxation.iterations <= 40
