"""Rows of small problems as the noise model has them, and noise models that are settled at known components."""

from __future__ import annotations

import numpy as np
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.component_posterior import Fitted, Sizes
from gtsam_rwhec.fitting.fit_options import About, Component, NoiseOptions, RefineOptions, Walk
from gtsam_rwhec.fitting.joint_covariance import JointCovariance, free_space_of
from gtsam_rwhec.fitting.noise_rows import Instants, Rows
from gtsam_rwhec.fitting.noise_search import Settled, Task, moved
from gtsam_rwhec.fitting.pair_data import PairData, local_paths
from gtsam_rwhec.fitting.unknowns import Variables
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.solver.parts import parts_of


def random_poses(chance: np.random.Generator, count: int, angle: float = 1.0, length: float = 0.5) -> np.ndarray:
    return se3.expmap(np.hstack([angle * chance.normal(size=(count, 3)), length * chance.normal(size=(count, 3))]))


def problem_of(
    targets: int = 1, sensors: int = 1, count: int = 12, *,
    seed: int = 0, scale: ScaleMode = "known", shared: bool = True, missing: int = 0,
) -> rw.Problem:  # fmt: skip
    """Every sensor sees every target from the same carrier poses (``shared``), or from poses of its own.

    The first pair has no measurements at the last ``missing`` poses.
    """
    chance = np.random.default_rng(seed)
    problem = rw.Problem(scale=scale)
    X, Y = random_poses(chance, targets), random_poses(chance, sensors)
    A = random_poses(chance, count)
    for i in range(targets):
        for j in range(sensors):
            if not shared:
                A = random_poses(chance, count)
            B = np.linalg.inv(Y[j]) @ A @ X[i] @ random_poses(chance, count, 0.01, 0.004)
            kept = slice(0, count if i or j else count - missing)
            stamps = np.arange(count) * 100_000_000
            problem.add(f"tag_{i}", f"cam_{j}", A[kept], B[kept], stamps_ns=stamps[kept])
    return problem


def rows_of(problem: rw.Problem) -> tuple[Rows, list[PairData], Variables, JointCovariance]:
    """The rows at the certified answer."""
    variables = Variables.of(problem, ())
    data = [PairData.of(problem, pair, RefineOptions(), None) for pair in problem.pairs]
    size = sum(unknown.dimension for unknown in variables.unknowns)
    layout = JointCovariance.of(variables.unknowns, np.eye(size), np.zeros((size, 0)), np.ones(size))
    state = variables.start(rw.solve(problem))
    return Rows.of(data, variables, state, layout, Instants.of(data)), data, variables, layout


C = Component
SIGMA = {
    C.ROTATION: 0.01, C.TRANSLATION: 0.004, C.DEPTH: 0.007, C.CARRIER_ROTATION: 0.003, C.CARRIER_TRANSLATION: 0.002,
    C.JITTER: 0.004, C.DRIFT_ROTATION: 0.001, C.DRIFT_TRANSLATION: 0.0007, C.DRIFT_SCALE: 0.002,
    C.SYSTEMATIC_ROTATION: 0.02, C.SYSTEMATIC_TRANSLATION: 0.01,
}  # fmt: skip


def task_of(
    problem: rw.Problem, solution: rw.Solution, offsets: tuple[str, ...] = (), rates: dict[str, int] | None = None
) -> Task:
    variables = Variables.of(problem, offsets, rates)
    paths = local_paths(problem, offsets)
    data = [PairData.of(problem, pair, RefineOptions(), paths.get(pair)) for pair in problem.pairs]
    space = free_space_of(parts_of(problem), variables, variables.start(solution), data)
    layout = JointCovariance.of(variables.unknowns, np.eye(len(space.unit)), space.basis, space.unit)
    return Task(problem, data, variables, layout, Instants.of(data), NoiseOptions(), space.directions)


def settled_at(task: Task, solution: rw.Solution, side: About, walk: Walk | None, *, systematic: bool) -> Settled:
    """The optimum at ``SIGMA``, as ``Task.settle`` leaves it at the components that it finds."""
    sizes = Sizes.of(SIGMA, {})
    state = task.variables.start(solution)
    for _ in range(3):
        model = task.model(state, side, walk, systematic=systematic)
        estimate = model.evaluate(SIGMA)
        state = moved(state, task.variables, task.layout, model.basis @ estimate.step)
    fit = Fitted(sizes, np.log(list(SIGMA.values())), estimate.minus_two_log, estimate)
    return Settled(state, task.model(state, side, walk, systematic=systematic), fit)
