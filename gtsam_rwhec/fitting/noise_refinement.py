"""``refine_under_noise``: from the certified solution to the answer under the noise that the data have."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtri

from gtsam_rwhec.errors import CountError, ScaleError
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.fitting.block_agreement import scatter_of_blocks, too_much
from gtsam_rwhec.fitting.clock_rates import clocks_with_rate, rates_found
from gtsam_rwhec.fitting.component_posterior import FEWEST
from gtsam_rwhec.fitting.drift import drift_columns
from gtsam_rwhec.fitting.fit_options import C, NoiseOptions, RefineOptions
from gtsam_rwhec.fitting.joint_covariance import JointCovariance, free_space_of
from gtsam_rwhec.fitting.lasting_errors import lasting_errors
from gtsam_rwhec.fitting.noise_graph import refined_of
from gtsam_rwhec.fitting.noise_in_data import NoiseInData, is_drift_doubted, mixed, noise_in, settled
from gtsam_rwhec.fitting.noise_rows import Instants
from gtsam_rwhec.fitting.noise_search import SETTLED, Settled, Task, moved
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.refinement_from_poses import check_inputs, data_of, sensors_with_offset
from gtsam_rwhec.fitting.unknowns import UnknownKind, Variables
from gtsam_rwhec.fitting.weighted_fit import as_of_six
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import aligned_at
from gtsam_rwhec.solver.answers import parts_about
from gtsam_rwhec.solver.solution import Solution

#: The Jacobian of all measurements may have this many numbers: 160 MB.
MOST_NUMBERS = 20_000_000
#: Without so many equations more than unknowns the components cannot be told apart.
SPARE_EQUATIONS = 6
#: No better weights change a scale by such a factor, unless the motion does not tell it.
RUNAWAY = 2.0


@dataclass(frozen=True)
class UnderNoise:
    """The answer under the noise that the data have, before its covariance is made."""

    task: Task
    #: The model at its optimum; for nearly the same measurements it is a start.
    settled: Settled
    #: The certified start.
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
        scatter = scatter_of_blocks(task, found)
        worst = too_much(scatter, is_drift_doubted=is_drift_doubted(task, found))
        lasting = lasting_errors(task, found)
        larger = max(1.0 if one is None else one.ratio for one in (worst, lasting))
        joint, mixture, constant = mixed(task, found, larger)
        layout = task.layout
        best = moved(found.state, task.variables, layout, found.model.basis @ mixture.step)
        clocks = rates_found(joint, best)
        frames = [
            layout.slots[unknown]
            for unknown in layout.slots
            if unknown.kind is UnknownKind.FRAME and not layout.free[layout.slots[unknown]].any()
        ]
        freedom = min((mixture.degrees_of_freedom(found.model.basis[rows]) for rows in frames), default=float(np.inf))
        # Two kinds of noise at least share what equations there are to spare.
        spare = task.problem.number_of_equations - len(layout.unit)
        freedom = min(freedom, max(0.5 * spare, FEWEST))
        freedom = freedom if worst is None else min(freedom, worst.freedom)
        task.tell("covariances: the graph of the answer")
        refined = refined_of(task, found, joint.without(clocks), freedom, inliers or {}, self.solution, self.how)
        noise = replace(
            noise_in(task, found, mixture, constant, scatter, worst, lasting), clocks=tuple(clocks.values())
        )
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
    before : Settled, optional
        The model of nearly the same measurements: its side and drift are kept.

    Raises
    ------
    CountError
        There are too few measurements for such a model, or so many that it does not fit into memory.
    ScaleError
        Under that noise a scale runs away from the certified one.
    """
    how, options, tell = how or RefineOptions(noise="estimate"), options or NoiseOptions(), progress or silent
    check_inputs(problem, solution, how)
    problem = aligned_at(problem, solution.X, solution.Y, solution.scale)
    offsets = sensors_with_offset(problem, how)
    variables = Variables.of(problem, offsets, clocks_with_rate(problem, offsets, how.carrier_path))
    unknowns = sum(unknown.dimension for unknown in variables.unknowns)
    equations = problem.number_of_equations
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
    parts = parts_about(problem, solution.X, solution.Y, solution.scale)
    space = free_space_of(parts, variables, state, data)
    layout = JointCovariance.of(variables.unknowns, np.eye(len(space.unit)), space.basis, space.unit)
    task = Task(problem, data, variables, layout, Instants.of(data), options, space.directions, tell)
    task = task.cut_at_jumps(state)
    task, found = task.without_false_jumps(settled(task, state, tell, before))
    task, found = task.without_noise(found)
    for unknown, scale in found.state.scales.items():
        first = state.scales[unknown]
        if max(scale / first, first / scale) > RUNAWAY:
            of = f"the scale of {unknown.owner}" if unknown.owner else "the scale"
            words = f"it went from {first:.3g} to {scale:.3g} under the noise that the residuals show"
            raise ScaleError(f"the motion does not tell {of}: {words}")
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


#: A good measurement is left out in so many of a hundred logs.
FALSE_ALARM = 0.05
#: A measurement that is left out keeps this part of its weight.
WEIGHTLESS = 1e-8
#: The unknowns are settled in at most so many steps, with the measurements that are left out.
STEPS = 4
#: A track without any kept measurement is this many steps from one.
LONGEST = 1e6


def agreeing(
    whole: Problem, inliers: dict[Pair, np.ndarray], task: Task, found: Settled, how: RefineOptions
) -> dict[Pair, np.ndarray]:
    """By pair, (N,) booleans: the measurements that agree. Those of frames that the answer lacks stay left out.

    Parameters
    ----------
    whole : Problem
        With all measurements.
    inliers : dict of (target, sensor) to (N,) booleans
        Those from which the answer comes.
    """
    known = set(found.state.X) | set(found.state.Y)
    pairs = [pair for pair in whole.pairs if known.issuperset(pair)]
    judged = whole.with_measurements({pair: whole.measurements(*pair) for pair in pairs})
    sigma, there, state, data = found.fit.sizes.values(found.fit.logs), found.model, found.state, task.data
    if not all(inliers[pair].all() for pair in whole.pairs):
        variables = Variables.of(judged, tuple(task.variables.offsets), task.variables.rates)
        data = [
            replace(
                item, covariance=np.where(inliers[item.pair][:, None, None], 1.0, 1.0 / WEIGHTLESS) * item.covariance
            )
            for item in data_of(judged, variables, how)
        ]
        everything = replace(
            task, problem=judged, data=data, variables=variables, instants=Instants.of(data), noisy=None
        )
        everything = everything.cut_at_jumps(state)
        for _ in range(STEPS):
            there = everything.model_like(found.model, state)
            step = there.evaluate(sigma)
            if step.farthest < SETTLED:
                break
            state = moved(state, variables, task.layout, there.basis @ step.step)
    eliminated = there.eliminated(sigma)
    rows = there.rows
    left = eliminated.left(eliminated.measured.of.columns)
    keep = np.concatenate([inliers[item.pair] for item in data])[rows.instants.order]
    honest = replace(there, rows=replace(rows, given=rows.given * np.where(keep, 1.0, WEIGHTLESS)[:, None, None]))
    E = there.carrier(sigma)
    estimate = found.model.evaluate(sigma)
    J = rows.by_unknowns
    covariance = honest.white(sigma) + E @ E.transpose(0, 2, 1)
    # A measurement that is left out also has the unknowns' error.
    of_unknowns = found.model.basis @ estimate.covariance @ found.model.basis.T
    blocks = of_unknowns[J.places[:, :, None], J.places[:, None]]
    covariance += np.where(keep, 0.0, 1.0)[:, None, None] * (J.values @ blocks @ J.values.transpose(0, 2, 1))
    if there.drift is not None:  # the drift is not known where nothing was measured
        # A rotation's error on the way moves the sensor by the way's length.
        way = 2.0 * float(rows.length.var(axis=0).sum()) if there.drift.correlation == 1.0 else 0.0
        lengthened = float(np.hypot(sigma[C.DRIFT_TRANSLATION], np.sqrt(way) * sigma[C.DRIFT_ROTATION]))
        G = drift_columns(rows, sigma | {C.DRIFT_TRANSLATION: lengthened}, there.drift)
        away = steps_from_kept(rows.instants, keep)
        if there.drift.correlation < 1.0:
            away = 1.0 - there.drift.correlation ** (2.0 * away)
        covariance += away.reshape(-1, 1, 1) * (G @ G.transpose(0, 2, 1))
    squares = np.einsum("ni,ni->n", left, np.linalg.solve(covariance, left[:, :, None])[:, :, 0])
    freedom = max(6 * int(keep.sum()) - found.model.basis.shape[1], 1)
    told = np.concatenate([item.told for item in data])[rows.instants.order]
    agrees = as_of_six(squares, told) <= 6.0 * fdtri(6, freedom, 1.0 - FALSE_ALARM / len(squares))
    in_order = np.empty(len(agrees), dtype=bool)
    in_order[rows.instants.order] = agrees
    result = {pair: np.zeros(len(inliers[pair]), dtype=bool) for pair in whole.pairs}
    for item, mask in zip(data, np.split(in_order, np.cumsum([item.count for item in data])[:-1]), strict=True):
        result[item.pair] = mask
    return result


def steps_from_kept(instants: Instants, keep: np.ndarray) -> Array:
    """How many steps (N,) each measurement is from the nearest of its track that is kept."""
    walked = np.cumsum(instants.step)[instants.index]
    track = np.cumsum(instants.step == 0.0)[instants.index] if instants.chains == 1 else instants.chain
    result = np.zeros(len(keep))
    for own in (np.flatnonzero(track == each) for each in np.unique(track)):
        kept = walked[own[keep[own]]]
        if not len(kept):
            result[own] = np.inf
            continue
        after = (
            np.clip(np.searchsorted(kept, walked[own]), 1, len(kept) - 1) if len(kept) > 1 else np.zeros(len(own), int)
        )
        nearest = np.minimum(np.abs(kept[after] - walked[own]), np.abs(kept[after - 1] - walked[own]))
        result[own] = nearest
    return np.where(np.isfinite(result), result, LONGEST)
