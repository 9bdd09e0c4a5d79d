"""The information that motions give, against residuals differentiated numerically."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
import pytest
from rwhec_factors.se3 import inverse

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.simulate.simulated_noise import random_poses
from gtsam_rwhec.solver.answers import Answer, PairPoses, costs_of_pairs
from gtsam_rwhec.solver.information import PartInformation, pair_information, prior_information
from gtsam_rwhec.solver.parts import Part, parts_of

NOISE = Noise(0.02, 300.0)
STEP = 1e-5

CASES: dict[str, dict[str, Any]] = {
    "known": dict(scale="known"),
    "shared": dict(scale="shared"),
    "per_target": dict(scale="per_target"),
    "per_target, one known": dict(scale="per_target", known_sizes=("target1",)),
    "more sensors": dict(scale="shared", targets=2, sensors=3),
    "a star": dict(scale="known", targets=1, sensors=4),
    "sparse": dict(scale="known", targets=3, sensors=3, graph="random"),
    "motions": dict(scale="known", odometry=5, odometry_noise=NOISE),
    "motions, shared": dict(scale="shared", odometry=5, odometry_noise=NOISE),
    "motions, per_target": dict(scale="per_target", odometry=5, odometry_noise=NOISE),
    "motions only": dict(scale="known", targets=0, sensors=1, odometry=8, odometry_noise=NOISE),
}


def an_answer(part: Part, scale: Any, seed: int) -> tuple[Answer, dict[str, np.ndarray]]:
    """Any poses (the information is asked where the answer is, optimal or not), and as the user's frames see them."""
    T = random_poses(len(part.free), 1.5, np.random.default_rng(seed))
    own = np.array([scale[name] if name in part.scale_owners else np.nan for name in part.free])
    shared = scale if part.scale == "shared" else 1.0
    shift = np.array([part.frame_shift(name) for name in part.free])
    absolute = T.copy()
    absolute[:, :3, 3] += shift
    return Answer(T[:, :3, :3], T[:, :3, 3], own, shared), dict(zip(part.free, absolute, strict=True))


def expected_residuals(
    problem: rw.Problem, poses: dict[str, np.ndarray], scales: dict[str, float], predicted: dict[Any, np.ndarray]
) -> np.ndarray:
    """Residuals over their standard deviations, with B by its prediction; measurement by measurement."""
    rows = []
    for pair in problem.pairs:
        data = problem.measurements(*pair)
        T_X, T_Y, alpha = poses[pair[0]], poses[pair[1]], scales[pair[0]]
        for A, B, sigma, kappa in zip(data.A, predicted[pair], data.sigma, data.kappa, strict=True):
            left, right = A @ T_X, T_Y @ B
            translation = alpha * (left[:3, 3] - T_Y[:3, 3]) - T_Y[:3, :3] @ B[:3, 3]
            rotation = left[:3, :3] - right[:3, :3]
            rows += [translation / sigma, np.sqrt(kappa) * rotation.ravel()]
    for name, priors in problem.priors.items():
        for prior in priors:
            if prior.sigma is not None:
                rows.append((poses[name] - prior.transform)[:3, 3] / prior.sigma)
    return np.concatenate(rows)


def numeric_information(problem: rw.Problem, part: Part, poses: dict[str, np.ndarray], scale: Any) -> np.ndarray:
    """J'J over [omega, v, log own scale] of each free frame and the log of the shared scale, by central differences."""
    names = dict.fromkeys(name for pair in problem.pairs for name in pair)
    scales = {
        name: scale[name] if isinstance(scale, dict) else scale
        for name in names
        if not isinstance(scale, dict) or name in scale
    }
    predicted = {}
    for pair in problem.pairs:
        B = inverse(poses[pair[1]]) @ problem.measurements(*pair).A @ poses[pair[0]]
        B[:, :3, 3] *= scales[pair[0]]
        predicted[pair] = B
    columns = []
    for name in part.free:
        for axis in range(7):
            ends = []
            for step in (STEP, -STEP):
                moved, resized = dict(poses), dict(scales)
                if axis < 6:
                    moved[name] = gtsam.Pose3(poses[name]).retract(step * np.eye(6)[axis]).matrix()
                elif name in part.scale_owners:
                    resized[name] *= np.exp(step)
                ends.append(expected_residuals(problem, moved, resized, predicted))
            columns.append((ends[0] - ends[1]) / (2.0 * STEP))
    ends = [
        expected_residuals(problem, poses, {n: s * np.exp(step) for n, s in scales.items()}, predicted)
        for step in (STEP, -STEP)
    ]
    columns.append((ends[0] - ends[1]) / (2.0 * STEP) * (part.scale == "shared"))
    J = np.array(columns).T
    return J.T @ J


def our_information(part: Part, answer: Answer) -> np.ndarray:
    pairs = pair_information(part, PairPoses.of(part, answer))
    told = PartInformation.of(part, pairs)
    full = told.together.dense()
    return np.where(told.used[:, None] & told.used, full, 0.0)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("knowledge", ["none", "fixed", "priors"])
def test_information_is_that_of_the_residuals(case: str, knowledge: str) -> None:
    options = {"targets": 2, "sensors": 2, "number_of_measurements": 4} | CASES[case]
    simulation = general(**options, seed=21, noise=NOISE)
    problem = simulation.problem
    if knowledge == "fixed":
        problem.fix(problem.sensors[-1], random_poses(1, 1.0, np.random.default_rng(1))[0])
        if problem.scale == "per_target" and "motions" in case:
            problem.fix_scale(problem.sensors[-1], 1.4)
        if not problem.targets:  # the only frame
            return
    if knowledge == "priors":
        problem.add_prior(
            (problem.targets + problem.sensors)[0], random_poses(1, 1.0, np.random.default_rng(2))[0], sigma=0.1
        )
    (part,) = parts_of(problem)
    generator = np.random.default_rng(5)
    scale: Any = {"known": 1.0, "shared": 0.6}.get(problem.scale)
    if problem.scale == "per_target":
        scale = {name: float(generator.uniform(0.5, 2.0)) for name in dict.fromkeys(t for t, _ in problem.pairs)}
        scale |= problem.fixed_scales
    answer, poses = an_answer(part, scale, 8)
    numeric = numeric_information(problem, part, {**poses, **problem.fixed}, scale)
    got = our_information(part, answer)
    np.testing.assert_allclose(got, numeric, rtol=0.0, atol=1e-7 * np.abs(numeric).max())


def test_a_prior_of_a_rotation_counts_twice_kappa_an_axis() -> None:
    """kappa |R - R_0|_F^2 is 2 kappa theta^2 near R_0: an information of 2 kappa."""
    problem = general(1, 1, seed=1, noise=NOISE).problem
    (part,) = parts_of(problem)
    rotation, translation = prior_information(part)
    assert not rotation.any()
    assert not translation.any()
    problem.add_prior("sensor0", np.eye(4), sigma=0.5, kappa=7.0)
    problem.add_prior("sensor0", np.eye(4), kappa=3.0)
    (part,) = parts_of(problem)
    rotation, translation = prior_information(part)
    at = part.free.index("sensor0")
    np.testing.assert_allclose(rotation[at], [20.0, 20.0, 20.0, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(translation[at], [0.0, 0.0, 0.0, 4.0, 4.0, 4.0, 0.0])
    assert not rotation[1 - at].any()


def test_costs_of_pairs_add_up_to_the_cost() -> None:
    """In the physical model, which is the form's own where the scale is not one for each target."""
    for scale in ("known", "shared"):
        problem = general(2, 2, seed=3, noise=NOISE, scale=scale).problem
        (part,) = parts_of(problem)
        solution = rw.solve(problem)
        T = np.array([{**solution.X, **solution.Y}[name].matrix() for name in part.free])
        shift = np.array([part.frame_shift(name) for name in part.free])
        shared = solution.scale if scale == "shared" else 1.0
        assert isinstance(shared, float)
        answer = Answer(T[:, :3, :3], T[:, :3, 3] - shift, np.full(len(T), np.nan), shared)
        J_t, J_R = costs_of_pairs(part, PairPoses.of(part, answer))
        assert J_t.sum() + J_R.sum() == pytest.approx(solution.cost, rel=1e-9)
