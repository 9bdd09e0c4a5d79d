"""Moments against the measurements they stand for, and the forms Q and Q' against the papers' matrices."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from naive_cost import naive_cost
from rwhec_factors.se3 import pose

import gtsam_rwhec as rw
from gtsam_rwhec.problem.many_measurements import Sorted
from gtsam_rwhec.problem.measurements import Measurements, Pair
from gtsam_rwhec.problem.moment_stack import MomentStack
from gtsam_rwhec.problem.moments import BLOCK, Gauge, Moments
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.simulate.simulated_noise import random_poses
from gtsam_rwhec.solver.answers import Answer, as_point
from gtsam_rwhec.solver.full_form import edge_forms
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.parts import Part, parts_of

NOISE = Noise(0.02, 200.0)


def with_uneven_weights(problem: rw.Problem, generator: np.random.Generator) -> rw.Problem:
    """The same measurements, each with a sigma and a kappa of its own, in two batches a pair."""
    uneven = rw.Problem(problem.scale)
    for target, sensor in problem.pairs:
        data = problem.measurements(target, sensor)
        half = len(data.A) // 2
        for part in (slice(half), slice(half, None)):
            A, B = data.A[part], data.B[part]
            weights = {"sigma": generator.uniform(0.01, 1.0, len(A)), "kappa": generator.uniform(1.0, 1e3, len(A))}
            if target == sensor:
                uneven.add_motion(sensor, A, B, **weights)
            else:
                uneven.add(target, sensor, A, B, **weights)
    for name, scale in problem.fixed_scales.items():
        uneven.fix_scale(name, scale)
    return uneven


def cost_from_moments(
    part: Part, X: dict[str, np.ndarray], Y: dict[str, np.ndarray], scale: float | dict[str, float]
) -> float:
    """J at poses that have nothing to do with the optimum, by the library's forms."""
    T = np.array([{**X, **Y}[name] for name in part.free]).reshape(-1, 4, 4)
    shift = np.array([part.frame_shift(name) for name in part.free]).reshape(-1, 3)
    own = [scale[name] if isinstance(scale, dict) and name in part.scale_owners else np.nan for name in part.free]
    answer = Answer(T[:, :3, :3], T[:, :3, 3] - shift, np.array(own), scale if isinstance(scale, float) else 1.0)
    return PartForm.of(part).cost.at(as_point(part, answer)).cost


CASES = {
    "known": dict(scale="known"),
    "shared": dict(scale="shared"),
    "per_target": dict(scale="per_target"),
    "per_target, one known": dict(scale="per_target", known_sizes=("target1",)),
    "with motions": dict(scale="known", odometry=7, odometry_noise=NOISE),
    "shared, with motions": dict(scale="shared", odometry=7, odometry_noise=NOISE),
    "per_target, with motions": dict(scale="per_target", odometry=7, odometry_noise=NOISE),
    "motions only": dict(targets=0, sensors=2, odometry=9, odometry_noise=NOISE),
    "more sensors": dict(targets=1, sensors=4),
    "star of targets": dict(targets=5, sensors=1, scale="shared"),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("known", ["nothing", "fixed", "priors"])
def test_cost_from_moments_is_the_cost_of_the_measurements(case: str, known: str) -> None:
    options = {"targets": 3, "sensors": 2, "number_of_measurements": 6} | CASES[case]
    generator = np.random.default_rng(7)
    simulation = general(**options, seed=3, noise=NOISE)
    problem = with_uneven_weights(simulation.problem, generator)
    names = problem.targets + problem.sensors
    poses = dict(zip(names, random_poses(len(names), 2.0, generator), strict=True))
    if known == "fixed":
        problem.fix(problem.sensors[0], poses[problem.sensors[0]])
        if problem.targets:
            problem.fix(problem.targets[-1], poses[problem.targets[-1]])
        if problem.scale == "per_target":  # a fixed frame of unknown scale is more than the form can hold
            problem.fix_scale(problem.targets[-1], 1.3)
            if "motions" in case:
                problem.fix_scale(problem.sensors[0], 0.8)
    if known == "priors":
        T_prior = random_poses(3, 1.0, generator)
        problem.add_prior(names[0], T_prior[0], sigma=0.3, kappa=5.0)
        problem.add_prior(names[-1], T_prior[1], kappa=0.4)
        problem.add_prior(names[-1], T_prior[2], sigma=2.0)
    X, Y = ({name: poses[name] for name in side} for side in (problem.targets, problem.sensors))
    scale: float | dict[str, float] = {"known": 1.0, "shared": 0.7}.get(problem.scale, 1.0)
    if problem.scale == "per_target":
        scale = {name: float(generator.uniform(0.5, 2.0)) for name in dict.fromkeys(t for t, _ in problem.pairs)}
        scale |= problem.fixed_scales
    parts = parts_of(problem)
    kind = parts[0].kind
    assert kind == (
        "inverse" if problem.scale == "per_target" or (known, problem.scale) == ("priors", "shared") else "direct"
    )
    got = sum(cost_from_moments(part, X, Y, scale) for part in parts)
    expected = naive_cost(problem, X, Y, scale, kind, parts[0].gauge)
    assert got == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("scale", "form"), [("known", "direct"), ("shared", "direct"), ("per_target", "inverse")])
def test_certify_costs_what_the_measurements_cost(scale: str, form: str) -> None:
    simulation = general(2, 2, seed=5, noise=NOISE, scale=scale, number_of_measurements=9)
    off = random_poses(4, 0.1, np.random.default_rng(0))
    X = {name: T @ off[i] for i, (name, T) in enumerate(simulation.X.items())}
    Y = {name: T @ off[2 + i] for i, (name, T) in enumerate(simulation.Y.items())}
    certificate = rw.certify(simulation.problem, X=X, Y=Y, scale=simulation.scale)
    gauge = parts_of(simulation.problem)[0].gauge
    expected = naive_cost(simulation.problem, X, Y, simulation.scale, form, gauge)
    assert certificate.cost == pytest.approx(expected, rel=1e-12)


def kronecker_rows(A: np.ndarray, B: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """M_t (eq. 30) and M_R (eq. 25) of one measurement over [t_X, t_Y, alpha, vec R_X, vec R_Y]."""
    eye = np.eye(3)
    R_A, t_A, R_B, t_B = A[:3, :3], A[:3, 3:], B[:3, :3], B[:3, 3:]
    M_t = np.hstack([R_A, -eye, t_A, np.zeros((3, 9)), -np.kron(t_B.T, eye)])
    M_R = np.hstack([np.zeros((9, 7)), np.kron(eye, R_A), -np.kron(R_B.T, eye)])
    return M_t, M_R


def naive_edge_form(A: np.ndarray, B: np.ndarray, sigma: np.ndarray, kappa: np.ndarray) -> np.ndarray:
    form = np.zeros((25, 25))
    for i in range(len(A)):
        M_t, M_R = kronecker_rows(A[i], B[i])
        form += 0.5 * M_t.T @ M_t / sigma[i] ** 2 + 0.5 * kappa[i] * M_R.T @ M_R
    return form


def stack_of(
    A: np.ndarray, B: np.ndarray, sigma: np.ndarray, kappa: np.ndarray, gauge: Gauge | None = None
) -> MomentStack:
    return Sorted.of(Pair("t", "s"), Measurements(A, B, sigma, kappa)).moments(gauge or Gauge(), with_R_B=True)


def moments_of(*data: Any) -> Moments:
    return stack_of(*data).one(0)


def random_measurements(count: int, seed: int) -> tuple[np.ndarray, ...]:
    generator = np.random.default_rng(seed)
    A, B = random_poses(count, 2.0, generator), random_poses(count, 2.0, generator)
    return A, B, generator.uniform(0.01, 1.0, count), generator.uniform(1.0, 500.0, count)


def close(got: np.ndarray, expected: np.ndarray, relative: float = 1e-12) -> None:
    """Equal to a part of the largest entry."""
    np.testing.assert_allclose(got, expected, rtol=0.0, atol=relative * np.abs(expected).max())


@given(st.integers(1, 12), st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_an_edges_form_is_made_of_the_papers_matrices(count: int, seed: int) -> None:
    data = random_measurements(count, seed)
    moments = moments_of(*data)
    forms = edge_forms(moments.translation[None], moments.rotation[None], np.array([moments.kappa]))
    close(forms[0][0] + forms[1][0], naive_edge_form(*data))
    # J_t and J_R apart: no rotation residual in the first, no translation in the second.
    assert not forms[1][0][:7].any()


def order_of_variables(part: Part) -> dict[str, int]:
    return {name: 13 * i for i, name in enumerate(part.free)}


def dense_form(part: Part) -> np.ndarray:
    """The library's Q over [t, s, vec R of each free frame; alpha, h], from its blocks."""
    return PartForm.of(part).full.dense()


def naive_form(problem: rw.Problem, part: Part) -> np.ndarray:
    """Q of eq. 42 from the measurements one by one, for a known or shared scale and frames that are all free."""
    offset = order_of_variables(part)
    size = 13 * len(offset) + 2
    scale_column = size - 2 if problem.scale == "shared" else size - 1
    a, c = (np.eye(4) for _ in range(2))
    a[:3, 3], c[:3, 3] = -part.gauge.sensor_carrier, part.gauge.target_carrier
    Q = np.zeros((size, size))
    for target, sensor in part.pairs:
        data = problem.measurements(target, sensor)
        moved = a @ data.A @ np.linalg.inv(a) if target == sensor else a @ data.A @ c
        X, Y = offset[target], offset[sensor]
        columns = np.r_[X : X + 3, Y : Y + 3, scale_column, X + 4 : X + 13, Y + 4 : Y + 13]
        rows = np.zeros((25, size))
        np.add.at(rows, (np.arange(25), columns), 1.0)  # both ends of a motion are one frame
        Q += rows.T @ naive_edge_form(moved, data.B, data.sigma, data.kappa) @ rows
    return Q


GRAPHS = {
    "2 x 3": dict(targets=2, sensors=3),
    "3 x 2, shared": dict(targets=3, sensors=2, scale="shared"),
    "star": dict(targets=4, sensors=1),
    "other star, shared": dict(targets=1, sensors=4, scale="shared"),
    "sparse": dict(targets=4, sensors=3, graph="random"),
    "motions beside": dict(targets=2, sensors=2, odometry=5, odometry_noise=NOISE),
    "motions only": dict(targets=0, sensors=1, odometry=8, odometry_noise=NOISE),
}


@pytest.mark.parametrize("graph", GRAPHS)
def test_the_full_form_is_that_of_the_paper(graph: str) -> None:
    simulation = general(**GRAPHS[graph], seed=11, noise=NOISE, number_of_measurements=5)
    problem = with_uneven_weights(simulation.problem, np.random.default_rng(2))
    (part,) = parts_of(problem)
    close(dense_form(part), naive_form(problem, part))


def eliminated_by_pinv(part: Part, Q: np.ndarray) -> np.ndarray:
    """Q' of eq. 48 over [vec R of each free frame, h], by the Moore-Penrose inverse of the dense matrix."""
    rotations = np.array([13 * i + 4 + k for i in range(len(part.free)) for k in range(9)])
    kept = np.r_[rotations, len(Q) - 1]
    gone = np.setdiff1d(np.arange(len(Q)), kept)
    return (
        Q[np.ix_(kept, kept)]
        - Q[np.ix_(kept, gone)] @ np.linalg.pinv(Q[np.ix_(gone, gone)], rcond=1e-12) @ Q[np.ix_(gone, kept)]
    )


@pytest.mark.parametrize("graph", GRAPHS)
def test_the_reduced_form_is_that_of_the_paper(graph: str) -> None:
    simulation = general(**GRAPHS[graph], seed=13, noise=NOISE, number_of_measurements=5)
    problem = with_uneven_weights(simulation.problem, np.random.default_rng(3))
    (part,) = parts_of(problem)
    reduced = PartForm.of(part).reduced
    expected = eliminated_by_pinv(part, naive_form(problem, part))
    close(reduced.Q, expected, 1e-10)
    x = np.random.default_rng(0).standard_normal(reduced.size)
    close(reduced.apply(x), expected @ x, 1e-10)


@pytest.mark.parametrize("options", [dict(scale="per_target"), dict(scale="per_target", known_sizes=("target0",))])
def test_the_form_turned_round_is_reduced_alike(options: dict) -> None:
    (part,) = parts_of(general(3, 2, **options, seed=17, noise=NOISE, number_of_measurements=5).problem)
    close(PartForm.of(part).reduced.Q, eliminated_by_pinv(part, dense_form(part)), 1e-10)


@pytest.mark.parametrize("scale", ["known", "shared"])
def test_free_translations_take_the_pseudo_inverse(scale: str) -> None:
    """Planar motion leaves a translation open: eq. 48's inverse does not exist, its pseudo-inverse does."""
    problem = general(2, 2, seed=19, motion="planar", noise=NOISE, scale=scale, number_of_measurements=6).problem
    (part,) = parts_of(problem)
    close(PartForm.of(part).reduced.Q, eliminated_by_pinv(part, naive_form(problem, part)), 1e-9)


@pytest.mark.parametrize("scale", ["known", "shared"])
def test_forms_of_the_real_dataset(utias_folder: Path, scale: Any) -> None:
    problem = rw.read_csv(utias_folder, scale=scale, sigma=1.0, kappa=1.0)
    (part,) = parts_of(problem)
    Q = naive_form(problem, part)
    close(dense_form(part), Q)
    close(PartForm.of(part).reduced.Q, eliminated_by_pinv(part, Q), 1e-10)


@given(st.integers(0, 2**32 - 1), st.integers(1, 9), st.integers(1, 9))
@settings(max_examples=30, deadline=None)
def test_moments_add(seed: int, first: int, second: int) -> None:
    data = random_measurements(first + second, seed)
    gauge = Gauge(np.array([0.3, -1.0, 2.0]), np.array([-0.5, 0.1, 0.7]))
    whole = moments_of(*data, gauge)
    stack = stack_of(*(d[:first] for d in data), gauge)
    stack.add_to(np.zeros(1, dtype=int), stack_of(*(d[first:] for d in data), gauge))
    parts = stack.one(0)
    assert parts.count == whole.count == first + second
    assert parts.kappa == pytest.approx(whole.kappa, rel=1e-14)
    close(parts.translation, whole.translation, 1e-14)
    close(parts.rotation, whole.rotation, 1e-14)


@pytest.mark.parametrize("count", [BLOCK - 1, BLOCK, BLOCK + 1, 2 * BLOCK + 3])
def test_blocks_lose_nothing(count: int) -> None:
    A, B, sigma, kappa = random_measurements(count, count)
    got = moments_of(A, B, sigma, kappa)
    features = np.concatenate(
        [T[:, :3, :].transpose(0, 2, 1).reshape(count, 12) for T in (A, B)] + [np.ones((count, 1))], axis=1
    )
    close(got.translation, (features / sigma[:, None] ** 2).T @ features, 1e-13)
    close(got.rotation, (features[:, :9] * kappa[:, None]).T @ features[:, 12:21], 1e-13)
    assert got.kappa == pytest.approx(kappa.sum())
    one_weight = moments_of(A, B, np.array(0.5), np.array(3.0))
    close(one_weight.translation, 4.0 * features.T @ features, 1e-13)
    assert one_weight.kappa == 3.0 * count


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_shifted_moments_are_those_about_the_other_gauge(seed: int) -> None:
    data = random_measurements(6, seed)
    generator = np.random.default_rng(seed)
    first, step = (Gauge(*generator.uniform(-3.0, 3.0, (2, 3))) for _ in range(2))
    second = first.moved_by(step.sensor_carrier, step.target_carrier)
    shifted = stack_of(*data, first).shifted(step.sensor_carrier, step.target_carrier).as_summed().one(0)
    close(shifted.translation, moments_of(*data, second).translation)
    close(shifted.rotation, moments_of(*data, second).rotation)


@pytest.mark.parametrize("motion", [False, True])
def test_the_gauge_centres_far_translations(motion: bool) -> None:
    generator = np.random.default_rng(4)
    far = np.array([3e5, -1e6, 2e5])
    near = random_poses(50, 1.0, generator)
    eye = np.eye(3)
    if motion:  # motions of a carrier whose own frame is far from where it turns
        A = pose(eye, far) @ near @ pose(eye, -far)
        gauge = Gauge.of(A, np.ones(len(A), dtype=bool))
        moved = pose(eye, -gauge.sensor_carrier) @ A @ pose(eye, gauge.sensor_carrier)
    else:
        A = pose(eye, far) @ near @ pose(eye, -2.0 * far)
        gauge = Gauge.of(A, np.zeros(len(A), dtype=bool))
        moved = pose(eye, -gauge.sensor_carrier) @ A @ pose(eye, gauge.target_carrier)
    assert np.abs(moved[:, :3, 3]).max() < 3.0
