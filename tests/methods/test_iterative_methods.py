"""LOM: the paper's residual and weights (Appendix C), and where it ends from close and from poor starts."""

from __future__ import annotations

import math
from typing import Any

import gtsam
import numpy as np
import pytest
from method_problems import exchanged, four_targets, largest_errors, one_pair
from refinement_problems import rig
from rwhec_factors import se3
from rwhec_factors.se3 import pose

import gtsam_rwhec as rw
from gtsam_rwhec.errors import FrameError, NoiseError, OptionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods import MethodOptions, run
from gtsam_rwhec.methods.iterative_methods import (
    C1,
    CHARTS,
    STROBL,
    Cost,
    FrameKeys,
    LomOptions,
    LomSolution,
    Mode,
    Parameterisation,
    errors,
    local_on_manifold,
    lom_factor,
    reweighed,
    tabb2017,
)
from gtsam_rwhec.methods.levenberg_marquardt import Linearised, descend
from gtsam_rwhec.methods.linear_systems import Stack
from gtsam_rwhec.methods.method import Outcome, Poses
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.simulate import Noise, Simulation, frame_distance, sphere
from gtsam_rwhec.simulate.simulated_noise import random_directions, random_poses, rotations_of_vectors
from gtsam_rwhec.solver.rotations import random_rotations, vec

X, Y, SCALE = FrameKeys(0, 1), FrameKeys(2, 3), 4


def from_near(simulation: Simulation, seed: int = 0, **options: Any) -> LomSolution:
    """Started up to 10 cm and 10 degrees from the truth, with a scale of 1."""
    generator = np.random.default_rng(seed)
    starts = []
    for frames in (simulation.X, simulation.Y):
        truth = np.array([*frames.values()])
        turns = random_directions(len(truth), generator) * generator.uniform(0.0, math.radians(10.0), (len(truth), 1))
        moves = random_directions(len(truth), generator) * generator.uniform(0.0, 0.1, (len(truth), 1))
        near = pose(truth[:, :3, :3] @ rotations_of_vectors(turns), truth[:, :3, 3] + moves)
        starts.append(dict(zip(frames, near, strict=True)))
    return local_on_manifold(simulation.problem, *starts, options=LomOptions(**options))


def largest_distance(a: Any, b: Any) -> tuple[float, float]:
    """Over all frames, in metres and rad."""
    pairs = [(a.X[name], b.X[name]) for name in b.X] + [(a.Y[name], b.Y[name]) for name in b.Y]
    distances = [frame_distance(p.matrix(), q.matrix()) for p, q in pairs]
    return max(d.translation_m for d in distances), max(d.rotation_rad for d in distances)


@pytest.mark.parametrize("monocular", [False, True])
def test_cost_is_half_of_equation_78(monocular: bool) -> None:
    simulation = sphere(Noise(0.05, 12.0), 0, monocular=monocular, number_of_measurements=8)
    T_X, T_Y = random_poses(2, 1.0, np.random.default_rng(1))
    alpha = 0.7 if monocular else 1.0
    found = local_on_manifold(simulation.problem, {"camera": T_X}, {"marker": T_Y}, alpha, LomOptions(max_iterations=1))
    raw = simulation.problem.measurements("camera", "marker")
    expected = 0.0
    for A, B in zip(raw.A, raw.B, strict=True):
        e_R = gtsam.Rot3.Logmap(gtsam.Rot3(T_X[:3, :3].T @ A[:3, :3].T @ T_Y[:3, :3] @ B[:3, :3]))
        # eq. 76's t_X and t_Y are in B's unit
        e_t = A[:3, :3] @ (alpha * T_X[:3, 3]) + alpha * A[:3, 3] - T_Y[:3, :3] @ B[:3, 3] - alpha * T_Y[:3, 3]
        expected += 0.5 * (12.0 * e_R @ e_R + e_t @ e_t / 0.05**2)
    assert found.initial_cost == pytest.approx(expected, rel=1e-12)
    assert found.cost < found.initial_cost


@pytest.mark.parametrize("spread", [1.0, 1e-4])
def test_jacobians(spread: float) -> None:
    """At random poses and near a residual of zero; and the gradient is that of eq. 77, which lacks J_r^-1."""
    generator = np.random.default_rng(2)
    A = random_poses(5, 1.0, generator)
    T_X, T_Y = random_poses(2, 1.0, generator)
    B = np.linalg.inv(T_Y) @ A @ T_X
    noise = generator.normal(0.0, spread, (5, 6))
    B = B @ pose(rotations_of_vectors(noise[:, :3]), noise[:, 3:])
    factor = lom_factor(X, Y, SCALE, A, B, np.linspace(0.5, 2.0, 5), np.linspace(0.1, 3.0, 5))
    values = gtsam.Values()
    for keys, T in ((X, T_X), (Y, T_Y)):
        values.insert(keys.rotation, gtsam.Rot3(T[:3, :3]))
        values.insert(keys.translation, T[:3, 3])
    values.insert(SCALE, np.array([1.1]))

    def moved(key: int, step: np.ndarray) -> np.ndarray:
        delta = gtsam.VectorValues()
        delta.insert(key, step)
        return factor.unwhitenedError(values.retract(delta))

    h = 1e-6
    numeric = np.column_stack(
        [
            (moved(key, h * axis) - moved(key, -h * axis)) / (2.0 * h)
            for key in (0, 1, 2, 3, 4)
            for axis in np.eye(1 if key == SCALE else 3)
        ]
    )
    jacobian, negative = factor.linearize(values).jacobian()
    np.testing.assert_allclose(jacobian, numeric, atol=1e-7)

    # eq. 77 by left perturbations, here turned to right ones: de_R / dpsi_Y = R_B' R_Y' R_Y
    weight = 1.0 / np.linspace(0.5, 2.0, 5)
    papers = (weight[:, None, None] * B[:, :3, :3].transpose(0, 2, 1)).reshape(-1, 3)
    rows = np.arange(30).reshape(5, 6)[:, :3].ravel()
    np.testing.assert_allclose(papers.T @ negative[rows], jacobian[rows][:, 6:9].T @ negative[rows], atol=1e-9)


@pytest.mark.parametrize("scale", ["known", "shared"])
def test_close_start_ends_at_the_truth_without_noise(scale: str) -> None:
    simulation = rig(3, 2, scale=scale, noise=None)
    found = from_near(simulation)
    errors = simulation.errors(found)
    assert max(e.translation_m for e in [*errors.X.values(), *errors.Y.values()]) < 1e-7
    assert max(e.rotation_rad for e in [*errors.X.values(), *errors.Y.values()]) < 1e-7
    assert errors.relative_scale < 1e-7


@pytest.mark.parametrize("monocular", [False, True])
def test_close_start_ends_at_the_certified_answer_within_noise(monocular: bool) -> None:
    """With kappa's own weights; the two noise models differ by the angle's third order."""
    simulation = sphere(Noise(0.005, 0.5 / math.radians(1.0) ** 2), 3, monocular=monocular)
    certified = rw.solve(simulation.problem)
    refined = rw.refine(simulation.problem, certified, rw.RefineOptions(noise="given"))
    found = from_near(simulation, weights="matched")
    translation_m, rotation_rad = largest_distance(found, certified)
    variances = [np.diag(refined.covariance(name)) for name in ("camera", "marker")]
    assert rotation_rad < 0.05 * math.sqrt(min(v[:3].max() for v in variances))
    assert translation_m < 0.05 * math.sqrt(min(v[3:].max() for v in variances))
    # the paper's weights give another answer, as good
    other_m, other_rad = largest_distance(from_near(simulation), certified)
    assert other_rad > rotation_rad
    assert other_m < 0.02
    assert other_rad < math.radians(1.0)


def test_papers_weights_are_matched_ones_of_half_the_kappa() -> None:
    full, half = sphere(Noise(0.01, 50.0), 0).problem, rw.Problem()
    raw = full.measurements("camera", "marker")
    half.add(target="camera", sensor="marker", A=raw.A, B=raw.B, sigma=raw.sigma, kappa=raw.kappa / 2.0)
    start = ({"camera": np.eye(4)}, {"marker": np.diag([-1.0, -1.0, 1.0, 1.0])})
    papers = local_on_manifold(full, *start)
    matched = local_on_manifold(half, *start, options=LomOptions("matched"))
    assert papers.cost == pytest.approx(matched.cost, rel=1e-12)
    assert max(largest_distance(papers, matched)) < 1e-9


def test_poor_start_ends_in_a_local_minimum_of_negative_scale() -> None:
    simulation = sphere(Noise(0.01, 125.0), 0, monocular=True)
    good = from_near(simulation)
    ends = []
    for seed in range(12):
        T_X, T_Y = random_poses(2, 1.0, np.random.default_rng(seed))
        ends.append(local_on_manifold(simulation.problem, {"camera": T_X}, {"marker": T_Y}))
    wrong = [end for end in ends if end.scale < 0.0]
    assert 0 < len(wrong) < len(ends)
    assert all(end.cost > 2.0 * good.cost for end in wrong)
    assert all(simulation.errors(end).Y["marker"].rotation_deg > 90.0 for end in wrong)
    assert min(end.cost for end in ends) == pytest.approx(good.cost, rel=1e-9)


def test_bad_input() -> None:
    simulation = rig()
    start = (simulation.X, simulation.Y)
    with pytest.raises(FrameError, match="start's Y has no sensor0; it has sensor1"):
        local_on_manifold(simulation.problem, simulation.X, {"sensor1": simulation.Y["sensor1"]})
    full = rw.Problem()
    raw = simulation.problem.measurements("target0", "sensor0")
    full.add(target="target0", sensor="sensor0", A=raw.A, B=raw.B, covariances=np.eye(6))
    with pytest.raises(NoiseError, match="covariances"):
        local_on_manifold(full, *start)
    for weights in ("ours", (1.0,), (0.0, 1.0), (1.0, math.inf)):
        with pytest.raises(OptionError, match="weights"):
            LomOptions(weights=weights)  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="max_iterations"):
        LomOptions(max_iterations=0)


def test_the_errors_sizes_are_found() -> None:
    noise = Noise(0.02, 200.0)  # stated: Gaussian, 1/sqrt(2 kappa) rad an axis
    simulation = one_pair(noise)
    found = reweighed(Stack.of(simulation.problem), simulation.X["camera"], simulation.Y["marker"], 100)
    assert found.settled
    assert found.sigma_R == pytest.approx(0.05, rel=0.15)
    # noise of B's rotation acts on no translation of R_A t_X + t_A - R_Y t_B - t_Y
    assert found.sigma_t == pytest.approx(0.02, rel=0.15)


def test_the_answer_is_a_fixed_point_and_a_minimum() -> None:
    simulation = one_pair(Noise(0.02, 50.0), seed=3)
    stack = Stack.of(simulation.problem)
    found = reweighed(stack, simulation.X["camera"], simulation.Y["marker"], 100)
    from_elsewhere = run("strobl2006", simulation.problem)
    np.testing.assert_allclose(from_elsewhere.X["camera"].matrix(), found.X, atol=1e-5)
    np.testing.assert_allclose(from_elsewhere.Y["marker"].matrix(), found.Y, atol=1e-5)

    def cost(X: np.ndarray, Y: np.ndarray) -> float:
        e_R, e_t = errors(stack.A, stack.B, X, Y)
        return float((e_R**2).sum() / found.sigma_R**2 + (e_t**2).sum() / found.sigma_t**2)

    generator = np.random.default_rng(1)
    least = cost(found.X, found.Y)
    for _ in range(20):
        moved = np.stack([found.X, found.Y]) @ se3.expmap(1e-3 * generator.standard_normal((2, 6)))
        assert cost(*moved) > least


def test_weights_given_with_the_problem_are_not_used() -> None:
    simulation = one_pair(seed=2)
    other = one_pair(seed=2)
    raw = other.problem.measurements("camera", "marker")
    weighed = rw.Problem()
    weighed.add("camera", "marker", raw.A, raw.B, 3.0, 0.5)
    ours, theirs = run("strobl2006", simulation.problem), run("strobl2006", weighed)
    np.testing.assert_allclose(ours.X["camera"].matrix(), theirs.X["camera"].matrix(), atol=1e-12)


def test_a_given_start_is_taken_and_named() -> None:
    simulation = one_pair()
    start = (simulation.X, simulation.Y, 1.0)
    found = run("strobl2006", simulation.problem, MethodOptions(start=start))
    assert found.starts_from == "the given start"
    assert run("strobl2006", simulation.problem).starts_from == "wang2022"
    assert "deg" in found.notes[0]
    assert largest_errors(simulation, found)[0] < 0.05
    assert STROBL.properties.joint
    assert STROBL.properties.probabilistic


NOISE = Noise(0.05, 30.0)
PARAMETERISATIONS: tuple[Parameterisation, ...] = ("euler", "axis-angle", "quaternion")


def cost_of(problem: Problem, X: dict[str, Array], Y: dict[str, Array], cost: Cost) -> float:
    """As the paper writes it."""
    total = 0.0
    for target, sensor in problem.pairs:
        raw = problem.measurements(target, sensor)
        x, y = np.asarray(X[target]), np.asarray(Y[sensor])
        residual = raw.A @ x - y @ raw.B if cost == "c1" else raw.A - y @ raw.B @ np.linalg.inv(x)
        total += float((residual**2).sum())
    return total


def nearby(
    found: Outcome[Poses], generator: np.random.Generator, size: float
) -> tuple[dict[str, Array], dict[str, Array]]:
    def moved(poses: dict[str, Array]) -> dict[str, Array]:
        return {name: T @ se3.expmap(size * generator.standard_normal((1, 6)))[0] for name, T in poses.items()}

    return moved(dict(found.X)), moved(dict(found.Y))  # type: ignore[arg-type]


@pytest.mark.parametrize("name", PARAMETERISATIONS)
def test_charts_and_their_derivatives(name: Parameterisation) -> None:
    to_parameters, chart = CHARTS[name]
    R = random_rotations(20, np.random.default_rng(0))
    R[0] = np.eye(3)
    p = to_parameters(R)
    again, derivative = chart(p)
    np.testing.assert_allclose(again, R, atol=1e-12)
    for k in range(p.shape[1]):
        step = np.zeros_like(p)
        step[:, k] = 1e-6
        numeric = (vec(chart(p + step)[0]) - vec(chart(p - step)[0])) / 2e-6
        np.testing.assert_allclose(derivative[:, :, k], numeric, atol=1e-8)
    at_pole = np.array([[[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]])
    np.testing.assert_allclose(chart(to_parameters(at_pole))[0], at_pole, atol=1e-12)


@pytest.mark.parametrize("cost", ["c1", "c2"])
@pytest.mark.parametrize("parameterisation", PARAMETERISATIONS)
def test_simultaneous_is_a_minimum_of_the_cost_in_every_parameterisation(
    cost: Cost, parameterisation: Parameterisation
) -> None:
    problem = four_targets(NOISE).problem
    found = tabb2017(problem, MethodOptions(), cost, "simultaneous", parameterisation)
    least = cost_of(problem, found.X, found.Y, cost)  # type: ignore[arg-type]
    generator = np.random.default_rng(0)
    for size in (1e-2, 1e-4):
        for _ in range(10):
            assert cost_of(problem, *nearby(found, generator, size), cost) > least
    other = tabb2017(problem, MethodOptions(), cost)
    assert least == pytest.approx(cost_of(problem, other.X, other.Y, cost), rel=1e-9)  # type: ignore[arg-type]


@pytest.mark.parametrize("cost", ["c1", "c2"])
def test_separable_is_a_minimum_of_each_part_in_turn(cost: Cost) -> None:
    problem = one_pair(NOISE).problem
    found = tabb2017(problem, MethodOptions(), cost, "separable")
    whole = tabb2017(problem, MethodOptions(), cost)
    X, Y = np.asarray(found.X["camera"]), np.asarray(found.Y["marker"])
    raw = problem.measurements("camera", "marker")

    def of_rotations(R_X: Array, R_Y: Array) -> float:
        return float(((raw.A[:, :3, :3] @ R_X - R_Y @ raw.B[:, :3, :3]) ** 2).sum())

    least, least_whole = (cost_of(problem, f.X, f.Y, cost) for f in (found, whole))  # type: ignore[arg-type]
    assert least > least_whole
    generator = np.random.default_rng(1)
    for _ in range(10):
        turn = se3.expmap(np.concatenate([1e-3 * generator.standard_normal((2, 3)), np.zeros((2, 3))], axis=1))
        assert of_rotations(X[:3, :3] @ turn[0, :3, :3], Y[:3, :3] @ turn[1, :3, :3]) > of_rotations(
            X[:3, :3], Y[:3, :3]
        )
        shift = np.tile(np.eye(4), (2, 1, 1))
        shift[:, :3, 3] = 1e-3 * generator.standard_normal((2, 3))
        assert cost_of(problem, {"camera": X @ shift[0]}, {"marker": Y @ shift[1]}, cost) > least


@pytest.mark.parametrize("mode", ["simultaneous", "separable"])
def test_c2_is_c1_of_the_equation_turned_round(mode: Mode) -> None:
    simulation = four_targets(NOISE)
    problem = simulation.problem
    swapped = Problem()
    for target, sensor in problem.pairs:
        raw = problem.measurements(target, sensor)
        swapped.add(target, sensor, raw.B, raw.A)
    here, there = tabb2017(problem, MethodOptions(), "c2", mode), tabb2017(swapped, MethodOptions(), "c1", mode)
    for name in problem.targets:
        np.testing.assert_allclose(here.X[name], np.linalg.inv(np.asarray(there.X[name])), atol=1e-6)
    # Exchanging the roles of X and Y is another matter: A^-1 Y = X B^-1 measures translations elsewhere.
    turned = exchanged(simulation)
    other = tabb2017(turned.problem, MethodOptions(), "c1", mode)
    assert np.abs(np.asarray(other.Y["camera0"]) - here.X["camera0"]).max() > 1e-5


def test_what_is_not_there_is_refused_in_words() -> None:
    problem = one_pair().problem
    with pytest.raises(FrameError, match="reprojection"):
        run("tabb2017_rp1", problem)
    with pytest.raises(OptionError, match="c3"):
        tabb2017(problem, MethodOptions(), "c3")  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="euler"):
        tabb2017(problem, MethodOptions(), parameterisation="mrp")  # type: ignore[arg-type]
    assert C1.properties.joint


def rosenbrock(p: Array) -> Linearised:
    residual = np.array([10.0 * (p[1] - p[0] ** 2), 1.0 - p[0]])
    J = np.array([[-20.0 * p[0], 10.0], [-1.0, 0.0]])
    return Linearised(0.5 * float(residual @ residual), J.T @ residual, J.T @ J)


def test_a_curved_valley_is_followed_to_its_end() -> None:
    found = descend(rosenbrock, lambda p, step: p + step, np.array([-1.2, 1.0]), 100)
    assert found.converged
    assert found.iterations < 40
    np.testing.assert_allclose(found.point, [1.0, 1.0], atol=1e-9)


def test_the_step_limit_is_kept_and_told() -> None:
    found = descend(rosenbrock, lambda p, step: p + step, np.array([-1.2, 1.0]), 3)
    assert not found.converged
    assert found.iterations == 3
    assert found.cost < rosenbrock(np.array([-1.2, 1.0])).cost


def test_steps_to_an_infinite_cost_are_not_taken() -> None:
    def half_line(p: Array) -> Linearised:
        here = float(np.log(p[0])) if p[0] > 0.0 else np.inf
        return Linearised(0.5 * here**2, np.array([here / p[0]]), np.array([[1.0 / p[0] ** 2]]))

    found = descend(half_line, lambda p, step: p + step, np.array([20.0]), 100)
    np.testing.assert_allclose(found.point, [1.0], atol=1e-9)
