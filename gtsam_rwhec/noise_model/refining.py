"""``refine_under_noise``: from the certified solution to the answer under the noise that the data have."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.errors import CountError
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.noise_model.agreement import agreeing
from gtsam_rwhec.noise_model.found import NoiseInData
from gtsam_rwhec.noise_model.mixture import FEWEST
from gtsam_rwhec.noise_model.modelled import mixed, noise_in, settled
from gtsam_rwhec.noise_model.options import NoiseOptions
from gtsam_rwhec.noise_model.refined import refined_of
from gtsam_rwhec.noise_model.rows import Instants
from gtsam_rwhec.noise_model.settling import Settled, Task
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.refinement.free_space import free_space_of
from gtsam_rwhec.refinement.input_checks import check_inputs, sensors_with_offset
from gtsam_rwhec.refinement.joint_covariance import JointCovariance
from gtsam_rwhec.refinement.options import RefineOptions
from gtsam_rwhec.refinement.refined import Refined
from gtsam_rwhec.refinement.refining import data_of
from gtsam_rwhec.refinement.unknowns import UnknownKind
from gtsam_rwhec.refinement.variables import Variables
from gtsam_rwhec.solver.parts import parts_of
from gtsam_rwhec.solving.solution import Solution

#: The Jacobian of all measurements may have this many numbers: 160 MB.
MOST_NUMBERS = 20_000_000
#: Without so many equations more than unknowns the components cannot be told apart.
SPARE_EQUATIONS = 6


@dataclass(frozen=True)
class UnderNoise:
    """The answer under the noise that the data have, before its covariance is made.

    Attributes
    ----------
    task : Task
    settled : Settled
        The model at its optimum; for nearly the same measurements it is a start.
    solution : Solution
        The certified start.
    how : RefineOptions
    """

    task: Task
    settled: Settled
    solution: Solution
    how: RefineOptions

    def agreeing(self, whole: Problem, inliers: dict[Pair, np.ndarray]) -> dict[Pair, np.ndarray]:
        """Which measurements of the whole problem agree, by pair (N,) booleans; ``inliers`` made this answer."""
        return agreeing(whole, inliers, self.task, self.settled, self.how)

    def refined(self, inliers: dict[Pair, np.ndarray] | None = None) -> tuple[Refined, NoiseInData]:
        """The answer with its covariance and its graph, and what the data say of their noise.

        The covariance has the uncertainty of the noise itself, and the constant error of an arm. ``inliers`` are for
        the record.
        """
        task, found = self.task, self.settled
        task.tell("covariances: with the uncertainty of the noise itself")
        joint, mixture, constant = mixed(task, found)
        layout = task.layout
        frames = [
            layout.slots[unknown]
            for unknown in layout.slots
            if unknown.kind is UnknownKind.FRAME and not layout.free[layout.slots[unknown]].any()
        ]
        freedom = min((mixture.degrees_of_freedom(found.model.basis[rows]) for rows in frames), default=float(np.inf))
        # Two kinds of noise at least share what equations there are to spare.
        spare = 6 * task.problem.number_of_measurements - len(layout.unit)
        freedom = min(freedom, max(0.5 * spare, FEWEST))
        task.tell("covariances: the graph of the answer")
        refined = refined_of(task, found, joint, freedom, inliers or {}, self.solution, self.how)
        noise = noise_in(task, found, mixture, constant)
        return replace(refined, noise_sentences=noise.sentences), noise


def under_noise(
    problem: Problem,
    solution: Solution,
    how: RefineOptions | None = None,
    options: NoiseOptions | None = None,
    *,
    before: Settled | None = None,
    progress: Progress | None = None,
) -> UnderNoise:
    """The answer under the noise of B, of A, in time and over the configuration, each estimated from the residuals.

    Parameters
    ----------
    problem : Problem
        With its raw measurements, all of which count.
    solution : Solution
        Its certified solution.
    how : RefineOptions, optional
        Time offsets and the carriers' path.
    options : NoiseOptions, optional
    before : Settled, optional
        The model of nearly the same measurements: its side and drift are kept.
    progress : callable, optional

    Raises
    ------
    CountError
        There are too few measurements for such a model, or so many that it does not fit into memory.
    """
    how, options, tell = how or RefineOptions(noise="estimate"), options or NoiseOptions(), progress or silent
    check_inputs(problem, solution, how)
    variables = Variables.of(problem, sensors_with_offset(problem, how))
    unknowns = sum(unknown.dimension for unknown in variables.unknowns)
    equations = 6 * problem.number_of_measurements
    if equations - unknowns < SPARE_EQUATIONS:
        raise CountError(
            f"{equations} equations for {unknowns} unknowns leave {equations - unknowns} to estimate the noise of A "
            f"and B from, and {SPARE_EQUATIONS} are needed; measure more"
        )
    if equations * unknowns > MOST_NUMBERS:
        raise CountError(
            f"{problem.number_of_measurements} measurements of {unknowns} unknowns are too many for a model of the "
            "noise of A, drift and systematic errors"
        )
    data = data_of(problem, variables, how)
    state = variables.start(solution)
    space = free_space_of(parts_of(problem), variables, state, data)
    layout = JointCovariance.of(variables.unknowns, np.eye(len(space.unit)), space.basis, space.unit)
    task = Task(problem, data, variables, layout, Instants.of(data), options, space.directions, tell)
    found = settled(task, state, tell, before)
    return UnderNoise(task, found, solution, how)


def refine_under_noise(
    problem: Problem,
    solution: Solution,
    how: RefineOptions | None = None,
    options: NoiseOptions | None = None,
    *,
    progress: Progress | None = None,
) -> tuple[Refined, NoiseInData]:
    """``under_noise`` and its ``refined``: the refined calibration, and what the data say of their noise."""
    return under_noise(problem, solution, how, options, progress=progress).refined()
