"""LOM, the RWHEC paper's local on-manifold method (Appendix C): the baseline that needs a good start.

Its residual is not the refinement's: it has rotation and translation as separate terms (eq. 76),

    e_R = log(R_X' R_A' R_Y R_B),    e_t = R_A t_X + alpha t_A - R_Y t_B - t_Y,

and so are its variables, with t_X and t_Y in the measured unit (alpha times metres). Its weights are the paper's:
sigma_R = 1/sqrt(kappa), where this library's noise model has 1/sqrt(2 kappa).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import gtsam
import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import NoiseError, OptionError, ScaleError
from gtsam_rwhec.geometry.poses import Array, PoseLike, one_transform
from gtsam_rwhec.methods.applicability import check_problem
from gtsam_rwhec.methods.certified import SOURCE
from gtsam_rwhec.methods.estimate import Outcome, Poses
from gtsam_rwhec.methods.linear_methods import start_of
from gtsam_rwhec.methods.method import Method, MethodOptions, Properties, Takes, checked_start
from gtsam_rwhec.problem.measurements import Measurements
from gtsam_rwhec.problem.problem import Problem

LomWeights = Literal["paper", "matched"]


@dataclass(frozen=True)
class LomOptions:
    """Weights and the step limit.

    Attributes
    ----------
    weights : "paper", "matched" or (float, float)
        "paper": sigma_R = 1/sqrt(kappa), as in Appendix C. "matched": 1/sqrt(2 kappa), the standard deviation about
        each axis that belongs to kappa. Both use each measurement's own sigma. Two numbers: (sigma_R rad, sigma_t m)
        of all measurements.
    max_iterations : int
        1000, as in Section 8; from a start near the answer ten suffice.
    """

    weights: LomWeights | tuple[float, float] = "paper"
    max_iterations: int = 1000

    def __post_init__(self) -> None:
        if isinstance(self.weights, tuple):
            if len(self.weights) != 2 or not all(np.isfinite(s) and s > 0.0 for s in self.weights):
                raise OptionError(f"LomOptions.weights={self.weights!r}; give (sigma_R rad, sigma_t m), both positive")
        elif self.weights not in ("paper", "matched"):
            raise OptionError(
                f"LomOptions.weights={self.weights!r} is not 'paper', 'matched' or (sigma_R rad, sigma_t m)"
            )
        if self.max_iterations < 1:
            raise OptionError(f"LomOptions.max_iterations={self.max_iterations!r}; give a positive number")


@dataclass(frozen=True)
class LomSolution:
    """Where the local solver stopped; it proves nothing.

    Attributes
    ----------
    X, Y : dict of str to gtsam.Pose3
        T_targetcarrier_target by target, T_sensorcarrier_sensor by sensor; metres, divided by the scale.
    scale : float
        alpha, t_B = alpha * (true length). A negative scale is a local minimum far from the answer: the poses are
        wrong.
    initial_cost, cost : float
        Half of eq. 78, before and after.
    iterations : int
        Levenberg-Marquardt steps.
    """

    X: dict[str, gtsam.Pose3]
    Y: dict[str, gtsam.Pose3]
    scale: float
    initial_cost: float
    cost: float
    iterations: int


def local_on_manifold(
    problem: Problem,
    X: Mapping[str, PoseLike],
    Y: Mapping[str, PoseLike],
    scale: float = 1.0,
    options: LomOptions | None = None,
) -> LomSolution:
    """Solve Problem 9 of the RWHEC paper (eq. 78) from a start, by Levenberg-Marquardt with Ceres' settings.

    Parameters
    ----------
    problem : Problem
        Known or shared scale, raw measurements, no fixed frames, no priors.
    X, Y : dict of str to pose
        The start, T_targetcarrier_target by target and T_sensorcarrier_sensor by sensor, in true metres.
    scale : float
        The start's alpha; not used when the scale is known.
    options : LomOptions, optional

    Raises
    ------
    FrameError
        When a frame has no start, or a sensor has motions (A Y = Y B).
    ScaleError, NoiseError, PriorError
        For a scale for each target, full covariances, fixed frames or priors: Problem 9 has none of them.
    MeasurementsNotKeptError
        When the problem has moments only.
    """
    chosen = LomOptions() if options is None else options
    check_problem(METHOD, problem)
    X, Y, scale = checked_start(problem.targets, problem.sensors, (X, Y, scale))
    scale_key = gtsam.symbol("s", 0) if problem.scale == "shared" else None
    alpha = 1.0 if scale_key is None else scale
    frames = {name: FrameKeys(gtsam.symbol("x", i), gtsam.symbol("u", i)) for i, name in enumerate(problem.targets)}
    frames |= {name: FrameKeys(gtsam.symbol("y", i), gtsam.symbol("v", i)) for i, name in enumerate(problem.sensors)}
    values = gtsam.Values()
    for name, keys in frames.items():
        T = one_transform((X if name in problem.targets else Y)[name], f"start of {name}")
        values.insert(keys.rotation, gtsam.Rot3(T[:3, :3]))
        values.insert(keys.translation, alpha * T[:3, 3])
    if scale_key is not None:
        values.insert(scale_key, np.array([alpha]))

    graph = gtsam.NonlinearFactorGraph()
    for pair in problem.pairs:
        raw = problem.measurements(*pair)
        sigma_R, sigma_t = standard_deviations(raw, chosen.weights)
        graph.add(lom_factor(frames[pair.target], frames[pair.sensor], scale_key, raw.A, raw.B, sigma_R, sigma_t))

    # Ceres' trust region (radius 1e4, Nielsen's rule, damping by the Hessian's diagonal) and the paper's tolerance.
    parameters = gtsam.LevenbergMarquardtParams.CeresDefaults()
    parameters.setMaxIterations(chosen.max_iterations)
    parameters.setRelativeErrorTol(1e-15)
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    initial_cost = optimiser.error()
    optimum = optimiser.optimize()
    if scale_key is not None:
        alpha = float(optimum.atVector(scale_key)[0])
    poses = {
        name: gtsam.Pose3(optimum.atRot3(keys.rotation), optimum.atVector(keys.translation) / alpha)
        for name, keys in frames.items()
    }
    return LomSolution(
        X={name: poses[name] for name in problem.targets},
        Y={name: poses[name] for name in problem.sensors},
        scale=alpha,
        initial_cost=initial_cost,
        cost=optimiser.error(),
        iterations=optimiser.iterations(),
    )


def refuse_covariances(problem: Problem) -> None:
    """Raise NoiseError for a problem with covariances: Problem 9 has sigma and kappa only."""
    if problem.has_covariances:
        raise NoiseError(
            "this method weighs by sigma and kappa, and the problem has covariances; use refine(residual='geodesic')"
        )


def standard_deviations(raw: Measurements, weights: LomWeights | tuple[float, float]) -> tuple[Array, Array]:
    """Standard deviations of each measurement: sigma_R (N,) in rad and sigma_t (N,) in the measured unit."""
    if isinstance(weights, tuple):
        return np.full(len(raw.A), weights[0]), np.full(len(raw.A), weights[1])
    sigma_R: Array = 1.0 / np.sqrt(raw.kappa if weights == "paper" else 2.0 * raw.kappa)
    return sigma_R, raw.sigma


@dataclass(frozen=True)
class FrameKeys:
    """A frame's two variables: its Rot3 and its translation, a 3-vector in the measured unit."""

    rotation: int
    translation: int


def lom_factor(
    X: FrameKeys, Y: FrameKeys, scale_key: int | None, A: Array, B: Array, sigma_R: Array, sigma_t: Array
) -> gtsam.CustomFactor:
    """The factor of one pair's residuals (eq. 76) over their standard deviations: six rows a measurement, unit noise.

    The keys are R_X, t_X, R_Y, t_Y, alpha. Jacobians are by right perturbations R Expmap(omega). Unlike eq. 77 they
    have the inverse right Jacobian of the logarithm. Without it the gradient (J_r(e)' e = e) and the minima are the
    same, but the Gauss-Newton Hessian is wrong.
    """
    R_A, t_A, R_B, t_B = A[:, :3, :3], A[:, :3, 3], B[:, :3, :3], B[:, :3, 3]
    rows = 6 * len(A)
    weight = np.concatenate([np.repeat(1.0 / sigma_R[:, None], 3, 1), np.repeat(1.0 / sigma_t[:, None], 3, 1)], 1)
    keys = [X.rotation, X.translation, Y.rotation, Y.translation]

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Any] | None) -> se3.Array:
        R_X, R_Y = values.atRot3(X.rotation).matrix(), values.atRot3(Y.rotation).matrix()
        alpha = 1.0 if scale_key is None else values.atVector(scale_key)[0]
        e_R = se3.so3_logmap((R_A @ R_X).transpose(0, 2, 1) @ R_Y @ R_B)
        e_t = R_A @ values.atVector(X.translation) + alpha * t_A - t_B @ R_Y.T - values.atVector(Y.translation)
        if jacobians is not None:
            J_left_inverse = se3.so3_left_jacobian_inverse(e_R)
            # log(Expmap(-w) E): -J_l^-1; log(E Expmap(R_B' w)): J_r^-1 R_B', and J_r^-1 is J_l^-1 transposed
            zero = np.zeros_like(R_A)
            jacobians[0] = _stacked(-J_left_inverse, zero, weight)
            jacobians[1] = _stacked(zero, R_A, weight)
            jacobians[2] = _stacked((R_B @ J_left_inverse).transpose(0, 2, 1), R_Y @ se3.hat(t_B), weight)
            jacobians[3] = _stacked(zero, np.broadcast_to(-np.eye(3), R_A.shape), weight)
            if scale_key is not None:
                jacobians[4] = _stacked(np.zeros((*t_A.shape, 1)), t_A[:, :, None], weight)
        residual: se3.Array = (weight * np.concatenate([e_R, e_t], axis=1)).ravel()
        return residual

    return gtsam.CustomFactor(
        gtsam.noiseModel.Unit.Create(rows), keys + ([] if scale_key is None else [scale_key]), error
    )


def _stacked(rotation: Array, translation: Array, weight: Array) -> Array:
    """Weighed rows of e_R over rows of e_t, measurement by measurement: (6 N, d) in GTSAM's layout."""
    stacked = np.concatenate([rotation, translation], axis=1) * weight[:, :, None]
    return np.asfortranarray(stacked.reshape(-1, stacked.shape[2]))


def lom(problem: Problem, options: MethodOptions) -> Outcome[Poses]:
    """Solve Problem 9 with the paper's weights, from the given start or from a closed form's answer."""
    X, Y, scale, starts_from = start_of(problem, options)
    found = local_on_manifold(problem, X, Y, scale, LomOptions(max_iterations=options.max_iterations))
    if found.scale <= 0.0:
        raise ScaleError(
            f"LOM, started from {starts_from}, ended at scale {found.scale:.6g}, but a scale is positive: a wrong "
            "local minimum; give another start"
        )
    return Outcome(found.X, found.Y, found.scale, starts_from=starts_from)


METHOD = Method(
    name="lom",
    function=lom,
    properties=Properties("SE(3)", probabilistic=True, multiple="Xs and Ys", monocular=True),
    source=f"{SOURCE}, Appendix C",
    assumes="A start near the answer; isotropic noise on B, exact A.",
    takes=frozenset({Takes.SHARED_SCALE}),
    check=refuse_covariances,
)
