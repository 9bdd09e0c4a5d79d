"""Wise 2020: its cost, its proof, monocular scale, motions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from method_problems import one_pair
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.errors import OptionError, ScaleError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods import global_rotations, run
from gtsam_rwhec.methods.global_rotations import (
    PRODUCTS,
    Parameterisation,
    UnitForm,
    _moment_places,
    certified_rotations,
    global_minimum,
)
from gtsam_rwhec.simulate import Noise
from gtsam_rwhec.solver.descent import descend
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


METHODS_AND_SCALES = [("wise2020", 1.0), ("wise2020", 0.3), ("heller2014", 1.0), ("heller2014_matrix", 1.0)]


@pytest.mark.parametrize(("name", "alpha"), METHODS_AND_SCALES)
def test_motions_of_one_sensor(name: str, alpha: float) -> None:
    problem, truth = motions(0.0, 0.0, alpha, 0)
    exact = run(name, problem)
    np.testing.assert_allclose(exact.Y["camera"].matrix(), truth, atol=1e-6)
    assert exact.scale == pytest.approx(alpha, rel=1e-6)
    noisy, truth = motions(0.01, 0.02, alpha, 1)
    estimate = run(name, noisy)
    np.testing.assert_allclose(estimate.Y["camera"].matrix(), truth, atol=0.05)
    assert estimate.scale == pytest.approx(alpha, rel=0.05)
    assert "tight" in estimate.notes[0]
    if name != "wise2020":
        with pytest.raises(ScaleError):
            run(name, motions(0.01, 0.02, 0.5, 1)[0])


BOTH: tuple[Parameterisation, ...] = ("quaternion", "matrix")


def unrelated(seed: int) -> UnitForm:
    """Poses that have nothing to do with one another: the hardest problems there are."""
    generator = np.random.default_rng(seed)
    size = np.array([2.0, 2.0, 2.0, 1.0, 1.0, 1.0])
    A, B = (se3.expmap(size * generator.standard_normal((4, 6))) for _ in range(2))
    problem = rw.Problem()
    problem.add("target", "sensor", A, B)
    return UnitForm.of(problem)


def test_moments_of_one_pair_of_quaternions_fulfil_everything() -> None:
    table = _moment_places(2)
    equations, count = table.equations, table.equations.shape[1]
    assert count == 1 + 20 + 2 * 35 + 100  # even in each, of degrees 0, 2 and 4
    generator = np.random.default_rng(1)
    q = generator.standard_normal((2, 4))
    q /= np.linalg.norm(q, axis=1)[:, None]
    y = np.concatenate([[1.0], *[[one[a] * one[b] for a, b in PRODUCTS] for one in q]])
    z = np.outer(*np.roll(q, 1, axis=1)).ravel()  # the scalar first, as in PRODUCTS
    mu = np.full(count, np.nan)
    mu[table.even] = np.outer(y, y)
    np.testing.assert_allclose(mu[table.even], np.outer(y, y), atol=1e-15)  # equal monomials have one place
    np.testing.assert_allclose(mu[table.odd], np.outer(z, z), atol=1e-15)
    np.testing.assert_allclose(equations @ mu, np.eye(equations.shape[0])[0], atol=1e-15)  # first: the moment of 1 is 1


@pytest.mark.parametrize("noise", [Noise(0.01, 125.0), Noise(0.2, 2.0)])
@pytest.mark.parametrize("parameterisation", BOTH)
def test_the_answer_is_the_proven_minimum_of_the_cost(noise: Noise, parameterisation: Parameterisation) -> None:
    simulation = one_pair(noise)
    problem = simulation.problem
    found, is_tight = global_minimum(UnitForm.of(problem), parameterisation)
    assert is_tight
    name = "heller2014" if parameterisation == "quaternion" else "heller2014_matrix"
    estimate = run(name, problem)
    assert "is tight" in estimate.notes[0]
    (X,), (Y,) = ([pose.matrix() for pose in poses.values()] for poses in (estimate.X, estimate.Y))
    assert cost_of(problem, X, Y, 1.0) == pytest.approx(found.cost, rel=1e-8)
    generator = np.random.default_rng(0)
    for size in (1e-1, 1e-3):
        for _ in range(10):
            moved = np.stack([X, Y]) @ se3.expmap(size * generator.standard_normal((2, 6)))
            assert cost_of(problem, *moved, 1.0) > found.cost


@pytest.mark.parametrize(
    "seeds", [(0, 25, 37), pytest.param(range(40), marks=pytest.mark.campaign)], ids=["few", "all"]
)
def test_over_quaternions_it_is_tight_where_over_matrices_it_is_not(seeds: Sequence[int]) -> None:
    loose = 0
    for seed in seeds:
        form = unrelated(seed)
        (quaternion, is_proven), (matrix, is_tight) = (global_minimum(form, one) for one in BOTH)
        assert is_proven
        assert quaternion.lower_bound >= matrix.lower_bound - 1e-5 * quaternion.cost
        assert quaternion.cost <= matrix.cost + 1e-9
        generator = np.random.default_rng(seed)
        for _ in range(3):
            assert descend(form.reduced, random_rotations(2, generator), 100).cost >= quaternion.lower_bound
        if not is_tight:
            loose += 1
            assert matrix.cost - matrix.lower_bound > 1e-3
    assert 0 < loose < 10


def test_a_wrong_solver_cannot_make_a_wrong_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    """The bound is of the multipliers, whatever they are: that of a solver stopped early is lower, never higher."""
    form = unrelated(0)
    best = global_minimum(form)[0].cost
    for steps in (3, 6, 9):
        monkeypatch.setattr(global_rotations, "STEPS", steps)
        assert global_rotations.solve_moments(form.reduced.Q).lower_bound <= best


def test_other_parameterisations_are_refused_by_name() -> None:
    with pytest.raises(OptionError, match="euler"):
        global_minimum(unrelated(0), "euler")  # type: ignore[arg-type]
