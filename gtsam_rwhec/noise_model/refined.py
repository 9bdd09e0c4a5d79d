"""The settled noise model as a ``Refined``: the optimum of its GTSAM graph, for further factors."""

from __future__ import annotations

import warnings

import gtsam
import numpy as np

from gtsam_rwhec.errors import NotConvergedWarning
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.noise_model.components import C
from gtsam_rwhec.noise_model.graph import graph_of, optimum_of
from gtsam_rwhec.noise_model.likelihood import NoiseModel
from gtsam_rwhec.noise_model.settling import Settled, Task
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.refinement.joint_covariance import JointCovariance
from gtsam_rwhec.refinement.options import RefineOptions
from gtsam_rwhec.refinement.pair_data import PairData
from gtsam_rwhec.refinement.refined import PairNoise, Refined
from gtsam_rwhec.refinement.refining import movements, scale_of
from gtsam_rwhec.refinement.unknowns import UnknownKind
from gtsam_rwhec.refinement.variables import State
from gtsam_rwhec.solving.solution import Solution

#: The graph's optimum and the linear model's may differ by this part of a standard deviation: linearisation's share.
AGREES = 0.1


def refined_of(
    task: Task,
    settled: Settled,
    joint: JointCovariance,
    degrees_of_freedom: float,
    inliers: dict[Pair, np.ndarray],
    solution: Solution,
    options: RefineOptions,
) -> Refined:
    """The answer with its graph, at the graph's optimum.

    ``Refined.keys`` has the effects too: "drift:INSTANT", "systematic" and "carrier:INSTANT" (``noise_model.graph``).
    The graph has the components at their most probable values; the ``joint`` covariance also has their uncertainty
    and the constant error of an arm, so that the graph's own marginals are a little smaller.

    Parameters
    ----------
    joint : JointCovariance
        The final covariance of the unknowns.
    degrees_of_freedom : float
        Those of the quantile that fits the ellipsoids; infinite for chi-square.
    inliers : dict of Pair to (N,) booleans
        Of all measurements; empty where none was left out.
    solution : Solution
        The certified start.

    Warns
    -----
    NotConvergedWarning
        If the optimiser stopped at its limit, or its optimum is not that of the linear model.
    """
    sigma = settled.fit.sizes.values(settled.fit.logs)
    made = graph_of(settled.model, sigma, task.data, task.variables, settled.state, task.problem)
    optimum = optimum_of(
        made, task.variables, has_free=bool(task.layout.free.shape[1]), max_iterations=options.max_iterations
    )
    state = task.variables.state(optimum.values)
    if optimum.iterations >= options.max_iterations:
        warnings.warn(
            f"GTSAM stopped after {optimum.iterations} iterations without converging; raise "
            "RefineOptions.max_iterations",
            NotConvergedWarning,
            stacklevel=3,
        )
    share = disagreement(task, settled, sigma, state)
    if share > AGREES:
        warnings.warn(
            f"the graph's optimum is {share:.2g} standard deviations from that of the linear model, to which the "
            "covariance belongs: residuals are too large for a linear model; look for outliers (robust='gnc')",
            NotConvergedWarning,
            stacklevel=3,
        )
    start = gtsam.Values(made.values)
    start.update(task.variables.values(task.variables.start(solution)))
    keys = {str(unknown): key for unknown, key in task.variables.keys.items()}
    return Refined(
        X=state.X,
        Y=state.Y,
        scale=scale_of(task.problem, state),
        scale_mode=task.problem.scale,
        time_offsets_s=state.offsets_s,
        graph=made.graph,
        values=optimum.values,
        keys=keys | made.keys,
        noise_source="estimated",
        noise=noise_of_pairs(settled.model, sigma, task.data, degrees_of_freedom),
        cost=optimum.cost,
        initial_cost=made.graph.error(start),
        iterations=optimum.iterations,
        moved=movements(solution, state.X, state.Y),
        inlier_counts={pair: (int(kept.sum()), len(kept)) for pair, kept in inliers.items()},
        inliers=inliers,
        free_directions=task.free_directions,
        solution=solution,
        options=options,
        joint=joint,
    )


def noise_of_pairs(
    model: NoiseModel, sigma: dict[C, float], data: list[PairData], degrees_of_freedom: float
) -> dict[Pair, PairNoise]:
    """The noise of each pair's B: root mean square over measurements and axes, depth included, jitter not."""
    variances = np.einsum("nii->ni", model.white(sigma | {C.JITTER: 0.0}))
    in_order = np.empty_like(variances)
    in_order[model.rows.instants.order] = variances
    result, first = {}, 0
    for item in data:
        mean = in_order[first : first + item.count].mean(axis=0)
        rotation, translation = float(np.sqrt(mean[:3].mean())), float(np.sqrt(mean[3:].mean()))
        result[item.pair] = PairNoise(rotation, translation, (degrees_of_freedom, degrees_of_freedom))
        first += item.count
    return result


def disagreement(task: Task, settled: Settled, sigma: dict[C, float], state: State) -> float:
    """The largest difference of an estimate from the linear model's optimum, in its standard deviations."""
    estimate, basis = settled.model.evaluate(sigma), settled.model.basis
    if not basis.shape[1]:
        return 0.0
    away = np.linalg.lstsq(basis, change_between(task, settled.state, state), rcond=None)[0] - estimate.step
    return float(np.abs(away / np.sqrt(np.diagonal(estimate.covariance))).max())


def change_between(task: Task, before: State, after: State) -> Array:
    """The change (d,) of the unknowns that ``settling.moved`` makes of one estimate the other."""
    change = np.zeros(len(task.layout.unit))
    poses, moved = before.X | before.Y, after.X | after.Y
    for unknown, place in task.layout.slots.items():
        owner = unknown.owner
        if unknown.kind is UnknownKind.FRAME:
            change[place] = gtsam.Pose3.Logmap(poses[owner].between(moved[owner]))
        elif unknown.kind is UnknownKind.SCALE:
            change[place] = before.scales[unknown] * np.log(after.scales[unknown] / before.scales[unknown])
        else:
            change[place] = after.offsets_s[owner] - before.offsets_s[owner]
    return change
