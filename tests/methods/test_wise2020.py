"""Wise 2020: its cost, its proof, monocular scale, motions."""

from __future__ import annotations

import numpy as np
import pytest
from method_problems import four_targets, one_pair
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.errors import FrameError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods import run
from gtsam_rwhec.methods.global_rotations import UnitForm, certified_rotations
from gtsam_rwhec.simulate import Noise
from gtsam_rwhec.solver.rotations import random_rotations


def cost_of(problem: rw.Problem, X: Array, Y: Array, scale: float) -> float:
    """Half the sum of squares, translations in the measured unit."""
    ((target, sensor),) = problem.pairs
    raw = problem.measurements(target, sensor)
    R = raw.A[:, :3, :3] @ X[:3, :3] - Y[:3, :3] @ raw.B[:, :3, :3]
    lengths = scale * (raw.A[:, :3, :3] @ X[:3, 3] + raw.A[:, :3, 3] - Y[:3, 3]) - raw.B[:, :3, 3] @ Y[:3, :3].T
    return 0.5 * float((R**2).sum() + (lengths**2).sum())


def motions(noise_m: float, noise_rad: float, alpha: float, seed: int) -> tuple[rw.Problem, Array]:
    generator = np.random.default_rng(seed)
    Y = se3.expmap(np.array([[0.4, -1.0, 0.3, 0.2, -0.1, 0.5]]))
    A = se3.expmap(generator.standard_normal((40, 6)))
    noise = np.concatenate([noise_rad * generator.standard_normal((40, 3)), np.zeros((40, 3))], axis=1)
    B = se3.inverse(Y) @ A @ Y @ se3.expmap(noise)
    B[:, :3, 3] = alpha * (B[:, :3, 3] + noise_m * generator.standard_normal((40, 3)))
    problem = rw.Problem("known" if alpha == 1.0 else "shared")
    problem.add_motion("camera", A, B)
    return problem, Y[0]


@pytest.mark.parametrize("monocular", [False, True])
def test_the_answer_is_the_proven_optimum_of_its_cost(monocular: bool) -> None:
    simulation = one_pair(Noise(0.02, 60.0), monocular=monocular)
    problem = simulation.problem
    found = certified_rotations(UnitForm.of(problem))
    assert found.eigenvalue_ratio < 1e-6
    assert 0.0 <= found.gap < 1e-9
    estimate = run("wise2020", problem)
    assert "tight" in estimate.notes[0]
    X, Y = estimate.X["camera"].matrix(), estimate.Y["marker"].matrix()
    assert isinstance(estimate.scale, float)
    assert cost_of(problem, X, Y, estimate.scale) == pytest.approx(found.cost, rel=1e-8)
    generator = np.random.default_rng(0)
    for size in (1e-1, 1e-3):
        for _ in range(10):
            moved = np.stack([X, Y]) @ se3.expmap(size * generator.standard_normal((2, 6)))
            scale = estimate.scale * (1.0 + (size * generator.standard_normal() if monocular else 0.0))
            assert cost_of(problem, *moved, scale) > found.cost


def test_the_bound_is_below_every_descent() -> None:
    form = UnitForm.of(one_pair(Noise(0.3, 2.0), seed=4).problem)
    found = certified_rotations(form)
    from gtsam_rwhec.solver.descent import descend

    generator = np.random.default_rng(0)
    for _ in range(10):
        assert descend(form.reduced, random_rotations(2, generator), 100).cost >= found.lower_bound


def test_unit_weights_are_the_certified_solvers_cost_with_weights_of_one() -> None:
    problem = one_pair(Noise(0.02, 60.0)).problem
    raw = problem.measurements("camera", "marker")
    plain = rw.Problem()
    plain.add("camera", "marker", raw.A, raw.B, 1.0, 1.0)
    solution, estimate = rw.solve(plain), run("wise2020", problem)
    np.testing.assert_allclose(estimate.X["camera"].matrix(), solution.X["camera"].matrix(), atol=1e-8)
    assert certified_rotations(UnitForm.of(problem)).cost == pytest.approx(solution.certificate.cost, rel=1e-9)


@pytest.mark.parametrize("alpha", [1.0, 0.3])
def test_motions_of_one_sensor(alpha: float) -> None:
    problem, truth = motions(0.0, 0.0, alpha, 0)
    exact = run("wise2020", problem)
    np.testing.assert_allclose(exact.Y["camera"].matrix(), truth, atol=1e-6)
    assert exact.scale == pytest.approx(alpha, rel=1e-6)
    noisy, truth = motions(0.01, 0.02, alpha, 1)
    found = certified_rotations(UnitForm.of(noisy))
    assert found.gap < 1e-8
    estimate = run("wise2020", noisy)
    np.testing.assert_allclose(estimate.Y["camera"].matrix(), truth, atol=0.05)
    assert estimate.scale == pytest.approx(alpha, rel=0.05)


def test_more_frames_are_refused_by_name() -> None:
    with pytest.raises(FrameError, match="4 targets"):
        run("wise2020", four_targets().problem)
    problem = one_pair().problem
    raw = problem.measurements("camera", "marker")
    problem.add_motion("marker", raw.A, raw.B)
    with pytest.raises(FrameError, match="the problem has 1 target, 1 sensor and 2 pairs"):
        run("wise2020", problem)
