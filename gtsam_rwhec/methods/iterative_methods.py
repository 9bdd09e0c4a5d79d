"""Methods that descend from a start: LOM (RWHEC paper, Appendix C), Strobl 2006, Tabb 2017, Dornaika 1998.

LOM is the baseline that needs a good start: rotation and translation are separate terms (eq. 76).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import gtsam
import numpy as np
from rwhec_factors import se3
from scipy.linalg import block_diag

from gtsam_rwhec.errors import NoiseError, OptionError, ScaleError
from gtsam_rwhec.geometry.poses import Array, PoseLike, one_transform
from gtsam_rwhec.geometry.quaternions import ROTATION, of_rotations, to_rotations
from gtsam_rwhec.methods.certified import SOURCE
from gtsam_rwhec.methods.closed_forms import DORNAIKA_SOURCE, start_of
from gtsam_rwhec.methods.global_rotations import UnitForm
from gtsam_rwhec.methods.levenberg_marquardt import Chart, descend_on_chart, unit_quaternions
from gtsam_rwhec.methods.linear_systems import Stack, plain_form, poses_of
from gtsam_rwhec.methods.method import (
    UNWEIGHTED,
    Method,
    MethodOptions,
    Outcome,
    Poses,
    Properties,
    Takes,
    check_problem,
    checked_start,
)
from gtsam_rwhec.problem.measurements import Measurements
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.descent import homogeneous
from gtsam_rwhec.solver.reduced_form import ReducedForm
from gtsam_rwhec.solver.rotations import vec

LomWeights = Literal["paper", "matched"]


@dataclass(frozen=True)
class LomOptions:
    """Weights and the step limit."""

    #: "paper": sigma_R = 1/sqrt(kappa), as in Appendix C. "matched": 1/sqrt(2 kappa), the standard deviation about each
    #: axis that belongs to kappa. Both use each measurement's own sigma. Two numbers: (sigma_R rad, sigma_t m) of all
    #: measurements.
    weights: LomWeights | tuple[float, float] = "paper"
    max_iterations: int = 1000  #: 1000, as in Section 8; from a start near the answer ten suffice

    def __post_init__(self) -> None:
        w = self.weights
        is_pair = isinstance(w, tuple) and len(w) == 2 and all(np.isfinite(s) and s > 0.0 for s in w)
        if not is_pair and w not in ("paper", "matched"):
            words = "is not 'paper', 'matched' or (sigma_R rad, sigma_t m), both positive"
            raise OptionError(f"LomOptions.weights={w!r} {words}")
        if self.max_iterations < 1:
            raise OptionError(f"LomOptions.max_iterations={self.max_iterations!r}; give a positive number")


@dataclass(frozen=True)
class LomSolution:
    """Where the local solver stopped; it proves nothing."""

    #: T_targetcarrier_target by target, T_sensorcarrier_sensor by sensor; metres, divided by the scale
    X: dict[str, gtsam.Pose3]
    Y: dict[str, gtsam.Pose3]
    #: alpha, t_B = alpha * (true length). A negative scale is a local minimum far from the answer: the poses are wrong.
    scale: float
    #: Half of eq. 78, before and after.
    initial_cost: float
    cost: float
    iterations: int  #: Levenberg-Marquardt steps


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
    check_problem(LOM, problem)
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


LOM = Method(
    name="lom",
    function=lom,
    properties=Properties("SE(3)", probabilistic=True, multiple="Xs and Ys", monocular=True),
    source=f"{SOURCE}, Appendix C",
    assumes="A start near the answer; isotropic noise on B, exact A.",
    takes=frozenset({Takes.SHARED_SCALE}),
    check=refuse_covariances,
)


#: The weights rest when their ratio changes by less than this share.
SETTLED = 1e-6
#: There are at most this many rounds.
ROUNDS = 50
#: Standard deviations (rad and m) below this are rounding error: exact data have no variance to weigh by.
SMALLEST = 1e-9


@dataclass(frozen=True)
class Weighed:
    """Poses X, Y (4, 4), metres; standard deviations, rad and m an axis; rounds, and whether the weights rest."""

    X: Array
    Y: Array
    sigma_R: float
    sigma_t: float
    rounds: int
    settled: bool


def strobl2006(problem: Problem, options: MethodOptions) -> Outcome[Poses]:
    """One X and one Y, with errors of unknown sigma_R (rad an axis) and sigma_t (m an axis), estimated in turn."""
    target, sensor = problem.targets[0], problem.sensors[0]
    of_X, of_Y, _, starts_from = start_of(problem, options)
    X, Y = one_transform(of_X[target], f"start of {target}"), one_transform(of_Y[sensor], f"start of {sensor}")
    found = reweighed(Stack.of(problem), X, Y, options.max_iterations)
    notes = [f"estimated errors: {np.degrees(found.sigma_R):.3g} deg and {1e3 * found.sigma_t:.3g} mm an axis"]
    if not found.settled:
        notes.append(f"the weights still changed after {found.rounds} rounds")
    return Outcome({target: found.X}, {sensor: found.Y}, starts_from=starts_from, notes=tuple(notes))


def reweighed(stack: Stack, X: Array, Y: Array, max_iterations: int) -> Weighed:
    """Estimate poses and variances in turn, from X, Y (4, 4); each round's poses are LOM's with the round's weights."""
    A = stack.A.copy()
    A[:, :3, 3] = stack.centred_t_A
    X, Y = X.copy(), Y.copy()
    X[:3, 3] -= stack.gauge.target_carrier
    Y[:3, 3] -= stack.gauge.sensor_carrier
    centred = Problem()
    centred.add("X", "Y", A, stack.B)
    # Both errors have three numbers a measurement and share twelve unknowns; these cancel in the ratio of the weights.
    degrees = max(3.0 * len(A) - 6.0, 1.0)
    ratio, settled, rounds = 0.0, False, 0
    while rounds < ROUNDS:
        rounds += 1
        e_R, e_t = errors(A, stack.B, X, Y)
        sigma_R = max(float(np.sqrt(np.vdot(e_R, e_R) / degrees)), SMALLEST)
        sigma_t = max(float(np.sqrt(np.vdot(e_t, e_t) / degrees)), SMALLEST)
        previous, ratio = ratio, sigma_t / sigma_R
        settled = abs(ratio - previous) <= SETTLED * ratio
        if settled:
            break
        options = LomOptions((sigma_R, sigma_t), max_iterations)
        found = local_on_manifold(centred, {"X": X}, {"Y": Y}, options=options)
        X, Y = found.X["X"].matrix(), found.Y["Y"].matrix()
    X[:3, 3] += stack.gauge.target_carrier
    Y[:3, 3] += stack.gauge.sensor_carrier
    return Weighed(X, Y, sigma_R, sigma_t, rounds, settled)


def errors(A: Array, B: Array, X: Array, Y: Array) -> tuple[Array, Array]:
    """Rotation vectors of (Y B)^-1 A X and R_A t_X + t_A - R_Y t_B - t_Y, (N, 3) each."""
    AX, YB = A @ X, Y @ B
    return se3.so3_logmap(YB[:, :3, :3].transpose(0, 2, 1) @ AX[:, :3, :3]), AX[:, :3, 3] - YB[:, :3, 3]


STROBL = Method(
    name="strobl2006",
    properties=Properties("SE(3)", probabilistic=True),
    source="K. Strobl and G. Hirzinger, Optimal hand-eye calibration, IROS 2006",
    assumes="All measurements equally accurate; the method estimates the accuracy and ignores sigma and kappa. A start "
    "near the answer.",
    function=strobl2006,
)


Cost = Literal["c1", "c2"]
Mode = Literal["simultaneous", "separable"]
#: Euler angles about x, y and z (R = R_z R_y R_x), the rotation vector, the quaternion divided by its length.
Parameterisation = Literal["euler", "axis-angle", "quaternion"]


def tabb2017(
    problem: Problem,
    options: MethodOptions,
    cost: Cost = "c1",
    mode: Mode = "simultaneous",
    parameterisation: Parameterisation = "axis-angle",
) -> Outcome[Poses]:
    """Minimise c1 = sum |A_i X - Y B_i|_F^2 or c2 = sum |A_i - Y B_i X^-1|_F^2, from a start, by Levenberg-Marquardt.

    c2 is c1 of the inverted equation, since a left multiplication by a pose changes no Frobenius norm. "separable"
    minimises the rotation part first, then finds the translations. OptionError for an unknown variant.
    """
    for value, known in ((cost, ("c1", "c2")), (mode, ("simultaneous", "separable")), (parameterisation, CHARTS)):
        if value not in known:
            raise OptionError(f"tabb2017: {value!r} is not one of {', '.join(map(repr, known))}")
    turned = cost == "c2"
    X, Y, _, starts_from = start_of(problem, options)
    form = UnitForm.of(problem, turned=turned)
    R = form.rotations_of(X, Y)
    cost_of_rotations = form.reduced if mode == "simultaneous" else form.rotations_alone
    return form.outcome(least(cost_of_rotations, R, parameterisation, options.max_iterations), starts_from)


def least(form: ReducedForm, R: Array, parameterisation: Parameterisation, max_iterations: int) -> Array:
    """Rotations (n, 3, 3) of a local minimum of x'Q'x, from the rotations R."""
    to_parameters, chart = CHARTS[parameterisation]
    n, k = to_parameters(R).shape

    def point(p: Array) -> tuple[Array, Array]:
        rotations, by_parameter = chart(p.reshape(n, k))
        derivatives = np.zeros((9 * n + 1, n * k))  # of x = [vec R_1, ..., vec R_n, 1]
        for frame in range(n):
            derivatives[9 * frame : 9 * frame + 9, k * frame : k * frame + k] = by_parameter[frame]
        return homogeneous(rotations), derivatives

    found = descend_on_chart(form.Q, point, to_parameters(R).ravel(), max_iterations)
    return chart(found.reshape(n, k))[0]


def from_euler(p: Array) -> tuple[Array, Array]:
    """R_z R_y R_x of angles (n, 3) about x, y, z."""
    x, y, z = (from_rotation_vectors(p[:, k, None] * np.eye(3)[k])[0] for k in range(3))
    hat_x, hat_y, hat_z = se3.hat(np.eye(3))
    columns = [z @ y @ x @ hat_x, z @ y @ hat_y @ x, z @ hat_z @ y @ x]
    return z @ y @ x, np.stack([vec(column) for column in columns], axis=2)


def to_euler(R: Array) -> Array:
    """Angles (n, 3) about x, y, z; at the poles, where x and z turn about one axis, x is zero."""
    y = np.arcsin(np.clip(-R[:, 2, 0], -1.0, 1.0))
    pole = np.abs(R[:, 2, 0]) > 1.0 - 1e-12
    x = np.where(pole, 0.0, np.arctan2(R[:, 2, 1], R[:, 2, 2]))
    z = np.where(pole, np.arctan2(-R[:, 0, 1], R[:, 1, 1]), np.arctan2(R[:, 1, 0], R[:, 0, 0]))
    return np.stack([x, y, z], axis=1)


def from_rotation_vectors(p: Array) -> tuple[Array, Array]:
    """The exponential of rotation vectors (n, 3), and its derivative by the right Jacobian."""
    R = se3.expmap(np.concatenate([p, np.zeros_like(p)], axis=1))[:, :3, :3]
    right_jacobian = np.linalg.inv(se3.so3_left_jacobian_inverse(-p))
    columns = [vec(R @ se3.hat(right_jacobian[:, :, k])) for k in range(3)]
    return R, np.stack(columns, axis=2)


def from_quaternions(p: Array) -> tuple[Array, Array]:
    """Rotations of quaternions (n, 4), scalar last, divided by their lengths."""
    q, tangent = unit_quaternions(p)
    by_q = 2.0 * np.einsum("nd,cdik->ncik", q, ROTATION)
    derivative = np.einsum("ncik,ncm->nkim", by_q, tangent).reshape(len(p), 9, 4)
    return to_rotations(q), derivative


CHARTS: dict[str, tuple[Callable[[Array], Array], Chart]] = {
    "euler": (to_euler, from_euler),
    "axis-angle": (se3.so3_logmap, from_rotation_vectors),
    "quaternion": (of_rotations, from_quaternions),
}


TABB_SOURCE = (
    "A. Tabb and K. Ahmad Yousef, Solving the robot-world hand-eye(s) calibration problem with iterative methods, "
    "Machine Vision and Applications 28, 2017"
)


def _method(cost: Cost, mode: Mode) -> Method[[Problem, MethodOptions]]:
    return Method(
        name=f"tabb2017_{cost}" + ("_separable" if mode == "separable" else ""),
        properties=Properties(
            "Euler angles, rotation vectors or quaternions", joint=mode == "simultaneous", multiple="Xs or Ys"
        ),
        source=TABB_SOURCE,
        assumes=f"{UNWEIGHTED} A start near the answer.",
        function=partial(tabb2017, cost=cost, mode=mode),
    )


C1 = _method("c1", "simultaneous")
C2 = _method("c2", "simultaneous")
C1_SEPARABLE = _method("c1", "separable")
C2_SEPARABLE = _method("c2", "separable")


#: |R R' - I|^2 has this weight; the residuals have weight 1.
PENALTY = 1e6


def dornaika1998(problem: Problem, options: MethodOptions) -> Outcome[Poses]:
    """Minimise |R_A R_X - R_Y R_B|^2 + |R_A t_X + t_A - R_Y t_B - t_Y|^2 + 1e6 (|R_X R_X' - I|^2 + |R_Y R_Y' - I|^2).

    Levenberg-Marquardt varies the 24 entries. The first two sums are one quadratic form in the entries, so an
    iteration's time does not grow with the number of measurements. The matrices found are projected to rotations.
    """
    stack = Stack.of(problem)
    X, Y, _, starts_from = start_of(problem, options)
    starts = (X[stack.targets[0]], Y[stack.sensors[0]])
    T = np.array([one_transform(pose, f"start of {name}") for name, pose in zip(stack.names, starts, strict=True)])
    start = np.concatenate([(T[:, :3, 3] - stack.origins).ravel(), T[:, :3, :3].transpose(0, 2, 1).ravel()])
    form = block_diag(2.0 * plain_form(stack), PENALTY * np.eye(18))
    x = descend_on_chart(form, _with_deviations, start, options.max_iterations)
    return stack.outcome(*poses_of(stack, x), starts_from=starts_from)


def _with_deviations(p: Array) -> tuple[Array, Array]:
    """[t_X, t_Y, 1, vec R_X, vec R_Y, R_X R_X' - I, R_Y R_Y' - I] (43,) of its 24 entries, and its derivatives."""
    R = p[6:].reshape(2, 3, 3).transpose(0, 2, 1)
    point = np.concatenate([p[:6], [1.0], p[6:], (R @ R.transpose(0, 2, 1) - np.eye(3)).ravel()])
    derivatives = np.zeros((43, 24))
    derivatives[:6, :6], derivatives[7:25, 6:] = np.eye(6), np.eye(18)
    for frame in range(2):
        # d(R R')_ij / dR_ab = delta_ia R_jb + delta_ja R_ib; entry (a, b) is at 3 b + a
        half = np.einsum("ia,jb->ijba", np.eye(3), R[frame]).reshape(3, 3, 9)
        of_deviation = (half + half.transpose(1, 0, 2)).reshape(9, 9)
        derivatives[25 + 9 * frame : 34 + 9 * frame, 6 + 9 * frame : 15 + 9 * frame] = of_deviation
    return point, derivatives


DORNAIKA = Method(
    name="dornaika1998",
    properties=Properties("matrices", probabilistic=True),
    source=DORNAIKA_SOURCE,
    assumes="A start near the answer. A radian weighs as much as a metre (times the square root of two).",
    function=dornaika1998,
)
