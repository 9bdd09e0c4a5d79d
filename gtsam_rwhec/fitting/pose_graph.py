"""The factor graph of a refinement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from rwhec_factors.batch import Together, robot_world_hand_eye_batch_factor
from rwhec_factors.edge_summary import EdgeSummary, edge_summary_factor, hand_eye_summary_factor
from rwhec_factors.measurement import pose_robot_world_hand_eye_factor, robot_world_hand_eye_factor
from rwhec_factors.priors import position_prior_factor, rotation_prior_factor, shifted_pose_prior_factor

from gtsam_rwhec.errors import NoiseError
from gtsam_rwhec.fitting.fit_options import ResidualKind, Robust
from gtsam_rwhec.fitting.pair_data import (
    FactorsByPair,
    PairData,
    PoseComponent,
    measurement_covariance,
    square_root_information,
)
from gtsam_rwhec.fitting.unknowns import Variables, carrier_key, rows_of, slots_of
from gtsam_rwhec.geometry.poses import Array, to_pose3
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import VarianceFactors
from gtsam_rwhec.solver.full_form import edge_forms
from gtsam_rwhec.solver.parts import Part

#: GTSAM's losses and their tuning constants, with 95 % efficiency for Gaussian noise in six dimensions. (GTSAM weighs a
#: factor by the length of its whitened residual. Its defaults have 95 % in one dimension, and 40 to 93 % in six.)
LOSSES: dict[str, tuple[Any, float]] = {
    "huber": (gtsam.noiseModel.mEstimator.Huber, 1.869),
    "cauchy": (gtsam.noiseModel.mEstimator.Cauchy, 2.862),
    "tukey": (gtsam.noiseModel.mEstimator.Tukey, 6.356),
    "geman_mcclure": (gtsam.noiseModel.mEstimator.GemanMcClure, 4.846),
}

Isotropic = gtsam.noiseModel.Isotropic

#: A step that lowers the cost by less than this is the last: what is left is far below a thousandth of a deviation.
LAST_STEP = 1e-9
#: What means nothing of a target stays within this (rad, m), and all else of it is free within this.
MEANS_NOTHING, WEIGHTLESS = 1e-4, 1e8
#: Steps of variables that are held have this standard deviation (rad, m, s).
HELD = 10.0


@dataclass(frozen=True)
class CarrierVariables:
    """Carrier poses that are variables: one for each distinct (stamp, A) of the problem.

    Sensors with an unknown time offset share no carrier pose with other sensors.
    """

    #: (N,): the carrier pose of each measurement.
    index: dict[Pair, np.ndarray]
    #: The first measurement at each of the M carrier poses.
    first: list[tuple[Pair, int]]
    #: (M, 4, 4): the poses as given, T_sensorcarrier_targetcarrier.
    A: Array
    #: (M, 6, 6): their noise.
    covariance: Array

    @property
    def is_shared(self) -> bool:
        """Whether two measurements have one carrier pose."""
        return sum(len(index) for index in self.index.values()) > len(self.A)

    @staticmethod
    def of(data: list[PairData]) -> CarrierVariables:
        """Measurements with one stamp and one A share a variable; without stamps, measurements with one A."""
        place: dict[tuple[int, bytes, str], int] = {}
        index: dict[Pair, np.ndarray] = {}
        A: list[Array] = []
        covariance: list[Array] = []
        first: list[tuple[Pair, int]] = []
        for item in data:
            if item.carrier is None or item.pair.is_motion:
                continue
            of_pair = np.empty(item.count, dtype=np.int64)
            for i, pose in enumerate(item.residuals.A):
                stamp = -1 if item.stamps_ns is None else int(item.stamps_ns[i])
                # Rounded well below any noise, as two interpolations of one pose differ by rounding.
                clock = item.pair.sensor if item.paths is not None else ""
                key = (stamp, np.round(pose[:3], 9).tobytes(), clock)
                if key not in place:
                    place[key] = len(A)
                    A.append(pose)
                    covariance.append(item.carrier[i])
                    first.append((item.pair, i))
                elif not np.allclose(covariance[place[key]], item.carrier[i], rtol=1e-6, atol=0.0):
                    raise NoiseError(
                        f"{first[place[key]][0]} and {item.pair} share a carrier pose (its measurement {i}), "
                        "but CarrierNoise.covariances differ there; give equal covariances for one pose"
                    )
                of_pair[i] = place[key]
            index[item.pair] = of_pair
        return CarrierVariables(index, first, np.array(A), np.array(covariance))


def add_summary(
    graph: gtsam.NonlinearFactorGraph,
    variables: Variables,
    part: Part,
    pair_index: int,
    factors: VarianceFactors,
    component: PoseComponent | None = None,
) -> None:
    """One chordal factor for all measurements of a pair, or for one component of them, from moments (design fact 2).

    Variances are multiplied by the factors.
    """
    moments, pair = part.moments, part.pairs[pair_index]
    one = slice(pair_index, pair_index + 1)
    translation, rotation = edge_forms(moments.translations(one), moments.rotations(one), moments.kappa[one])
    form = np.zeros((25, 25))
    if component != "translation":
        form += rotation[0] / factors.rotation
    if component != "rotation":
        form += translation[0] / factors.translation
    # The form has measured lengths, the factor true lengths.
    unit = np.r_[np.full(7, part.fixed_scales.get(pair.target, 1.0)), np.ones(18)]
    summary = EdgeSummary(
        form=form * unit[:, None] * unit,
        count=int(moments.count[pair_index]),
        target_origin=part.frame_shift(pair.target),
        sensor_origin=part.frame_shift(pair.sensor),
    )
    target, sensor = variables.ends(pair)
    scale_key = variables.scale_key(pair)
    if pair.is_motion:
        graph.add(hand_eye_summary_factor(sensor, summary, scale_key=scale_key))
    else:
        graph.add(edge_summary_factor(target, sensor, summary, scale_key=scale_key))


def add_batches(
    graph: gtsam.NonlinearFactorGraph,
    variables: Variables,
    data: list[PairData],
    covariances: dict[Pair, Array],
    robust: Robust = "none",
) -> None:
    """One geodesic factor for each pair, in which every measurement has its own weight; there is no loss."""
    together = Together()
    for item in data:
        graph.add(
            robot_world_hand_eye_batch_factor(
                *variables.ends(item.pair),
                item.residuals.A,
                item.residuals.B,
                square_root_information(covariances[item.pair]),
                scale_key=variables.scale_key(item.pair),
                time_offset_key=variables.offset_key(item.pair),
                twists=item.residuals.twists,
                together=together,
            )
        )


def robust_noise(covariance: Array, robust: Robust) -> gtsam.noiseModel.Base:
    """The noise model of a covariance (6, 6), under one of GTSAM's losses if ``robust`` names one."""
    gaussian = gtsam.noiseModel.Gaussian.Covariance(covariance)
    return gtsam.noiseModel.Robust.Create(loss_of(robust), gaussian) if robust in LOSSES else gaussian


def loss_of(robust: Robust) -> Any:  # GTSAM's stubs leave out the base class's methods
    """One of GTSAM's losses, by name."""
    loss, constant = LOSSES[robust]
    return loss.Create(constant)


def add_single(
    graph: gtsam.NonlinearFactorGraph,
    variables: Variables,
    data: list[PairData],
    covariances: dict[Pair, Array],
    robust: Robust,
) -> None:
    """One geodesic factor for each measurement, so that GTSAM's losses weigh each measurement."""
    for item in data:
        twists = item.residuals.twists
        for i, (A, B) in enumerate(zip(item.residuals.A, item.residuals.B, strict=True)):
            graph.add(
                robot_world_hand_eye_factor(
                    *variables.ends(item.pair),
                    to_pose3(A[:3, :3], A[:3, 3]),
                    to_pose3(B[:3, :3], B[:3, 3]),
                    robust_noise(covariances[item.pair][i], robust),
                    scale_key=variables.scale_key(item.pair),
                    time_offset_key=variables.offset_key(item.pair),
                    twist=None if twists is None else twists[i],
                )
            )


def add_with_carriers(
    graph: gtsam.NonlinearFactorGraph,
    variables: Variables,
    data: list[PairData],
    carriers: CarrierVariables,
    factors: FactorsByPair,
    robust: Robust,
) -> None:
    """Carrier poses as variables, each with a prior at its measured pose; one factor for each measurement.

    With a time offset the variable is the pose at the true time, and its prior moves along the carrier's path.
    """
    of_pair = {item.pair: item for item in data}
    for i, ((pair, place), covariance) in enumerate(zip(carriers.first, carriers.covariance, strict=True)):
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        residuals, offset_key = of_pair[pair].residuals, variables.offset_key(pair)
        A = to_pose3(residuals.A[place, :3, :3], residuals.A[place, :3, 3])
        if offset_key is None or residuals.twists is None:
            graph.add(gtsam.PriorFactorPose3(carrier_key(i), A, noise))
        else:
            graph.add(shifted_pose_prior_factor(carrier_key(i), offset_key, A, residuals.twists[place], noise))
    for item in data:
        if item.pair not in carriers.index:
            continue
        covariance = measurement_covariance(item, factors[item.pair])
        for i, B in enumerate(item.residuals.B):
            graph.add(
                pose_robot_world_hand_eye_factor(
                    carrier_key(int(carriers.index[item.pair][i])),
                    *variables.ends(item.pair),
                    to_pose3(B[:3, :3], B[:3, 3]),
                    robust_noise(covariance[i], robust),
                    scale_key=variables.scale_key(item.pair),
                    pose="targetcarrier_in_sensorcarrier",
                )
            )


def add_knowledge(
    graph: gtsam.NonlinearFactorGraph, variables: Variables, problem: Problem, residual: ResidualKind
) -> None:
    """Priors, and fixed frames as hard constraints."""
    add_priors(graph, variables, problem, residual)
    add_fixed(graph, variables, problem)


def add_fixed(graph: gtsam.NonlinearFactorGraph, variables: Variables, problem: Problem) -> None:
    """Fixed frames as hard constraints."""
    for name, T in problem.fixed.items():
        graph.add(gtsam.NonlinearEqualityPose3(variables.frames[name], to_pose3(T[:3, :3], T[:3, 3])))


def add_priors(
    graph: gtsam.NonlinearFactorGraph, variables: Variables, problem: Problem, residual: ResidualKind
) -> None:
    """Priors: |t - t_0|^2 / sigma_0^2, and kappa_0 |R - R_0|_F^2 (design fact 11) or 2 kappa_0 theta^2 of the angle.

    And a target stays, in directions in which all its measurements slide, where these were slid to: they fit as well
    there as anywhere.
    """
    for name, priors in problem.priors.items():
        if name in problem.fixed:
            continue
        for prior in priors:
            pose = to_pose3(prior.transform[:3, :3], prior.transform[:3, 3])
            key = variables.frames[name]
            if prior.kappa is not None:
                noise = Isotropic.Sigma(3, np.sqrt(0.5 / prior.kappa))
                graph.add(rotation_prior_factor(key, pose.rotation(), noise, residual=residual))
            if prior.sigma is not None:
                graph.add(position_prior_factor(key, pose.translation(), Isotropic.Sigma(3, prior.sigma)))
    for name, (T, slides) in problem.held.items():
        if name in variables.frames and slides.shape[1]:
            root = slides @ slides.T / MEANS_NOTHING + np.eye(6) / WEIGHTLESS
            by_direction = gtsam.noiseModel.Gaussian.SqrtInformation(root)
            graph.add(gtsam.PriorFactorPose3(variables.frames[name], to_pose3(T[:3, :3], T[:3, 3]), by_direction))


@dataclass(frozen=True)
class Optimum:
    """Values at the optimum, their cost, and the optimiser's number of iterations."""

    values: gtsam.Values
    cost: float
    iterations: int


def optimise(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    max_iterations: int,
    held: Mapping[int, int] | None = None,
    share: float = 0.0,
) -> Optimum:
    """The optimum, to the last digits, by Gauss and Newton's steps; by Levenberg and Marquardt's where these fail.

    With a ``share`` the last step is one that lowers the cost by less than this share of it.

    The start is nearly optimal, and a call of a factor in Python costs the most: GTSAM's optimisers call more often.
    Variables of ``held``, key and dimension, take no longer steps than ``HELD`` allows: where directions are free.
    """
    start, cost = values, graph.error(values)
    for iteration in range(1, max_iterations + 1):
        linear = graph.linearize(values)
        for key, size in (held or {}).items():
            noise = Isotropic.Sigma(size, HELD)
            linear.add(gtsam.JacobianFactor(key, np.eye(size), np.zeros(size), noise))
        try:
            step = linear.optimize()
        except RuntimeError:  # GTSAM's IndeterminantLinearSystemException
            break
        gain = linear.error(values.zeroVectors()) - linear.error(step)  # under a loss, the cost is not of these factors
        moved = values.retract(step)
        after = graph.error(moved)
        if not after <= cost * (1.0 + 1e-12) + 1e-12:
            break
        values, cost = moved, after
        if gain < max(LAST_STEP, share * cost):
            return Optimum(values, cost, iteration)
    else:
        return Optimum(values, cost, max_iterations)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(max_iterations)
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(1e-12)
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters)
    return Optimum(optimiser.optimize(), optimiser.error(), optimiser.iterations())


def information_of(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, variables: Variables) -> Array:
    """Gauss-Newton information (d, d) of ``variables.unknowns`` in their order, with all other variables marginalised.

    ``graph`` has no constraints of fixed frames: their rows are left out here.
    """
    return normal_equations_of(graph, values, variables)[0]


def normal_equations_of(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, variables: Variables
) -> tuple[Array, Array]:
    """The information as of ``information_of``, and the cost's gradient (d,) by the same unknowns."""
    linear = graph.linearize(values)
    keys = variables.keys
    present = set(linear.keyVector())
    others = present - set(keys.values())
    if others:  # carrier poses
        try:
            linear = linear.marginal([key for key in keys.values() if key in present])
        except RuntimeError as error:  # GTSAM's IndeterminateSystemException
            raise NoiseError(
                "the carrier poses cannot be computed in double precision: A's rotation noise, about the origin that "
                "it is given about, moves frames far away by very much. Give the noise about the other carrier "
                "(CarrierNoise.about), or take a world origin near the measurements"
            ) from error
    slots = slots_of(variables.unknowns)
    seen = [unknown for unknown in slots if keys.get(unknown) in present]
    size = sum(unknown.dimension for unknown in slots)
    information, gradient = np.zeros((size, size)), np.zeros(size)
    if seen:
        ordering = gtsam.Ordering()
        for unknown in [*seen, *(u for u, key in keys.items() if key in present and u not in slots)]:
            ordering.push_back(keys[unknown])
        rows = rows_of(slots, seen)
        whole, right = linear.hessian(ordering)
        information[np.ix_(rows, rows)], gradient[rows] = whole[: len(rows), : len(rows)], -right[: len(rows)]
    return information, gradient
