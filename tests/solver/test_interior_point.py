"""The block interior-point method against Clarabel, against certified optima, and on the real dataset."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_problems import GROSS_NOISE, bound_at, optimum, reduced, simulated, whole

import gtsam_rwhec as rw
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.simulate import Motion, Noise
from gtsam_rwhec.solver.relaxation import Relaxation, solve_by_blocks, solve_by_clarabel
from gtsam_rwhec.solver.rotations import CONSTRAINTS
from gtsam_rwhec.solver.small_dual import scatter

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
