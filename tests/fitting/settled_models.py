"""Small problems with noise models settled at known components."""

from __future__ import annotations

import numpy as np

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.component_posterior import Fitted, Sizes
from gtsam_rwhec.fitting.fit_options import About, Component, NoiseOptions, RefineOptions, Walk
from gtsam_rwhec.fitting.joint_covariance import JointCovariance, free_space_of
from gtsam_rwhec.fitting.noise_rows import Instants
from gtsam_rwhec.fitting.noise_search import Settled, Task, moved
from gtsam_rwhec.fitting.pair_data import PairData, local_paths
from gtsam_rwhec.fitting.unknowns import Variables
from gtsam_rwhec.solver.parts import parts_of

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
