"""This library's own method as one of the methods: the certified global optimum (RWHEC paper, Algorithm 1)."""

from __future__ import annotations

import warnings

import numpy as np
from rwhec_factors.se3 import pose

from gtsam_rwhec.errors import NotCertifiedWarning, NotUniqueWarning, WeightsWarning
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods.hand_eye_request import Request
from gtsam_rwhec.methods.method import Method, MethodOptions, Outcome, Poses, Properties, Takes
from gtsam_rwhec.methods.opencv_methods import Stations
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.solution import Solution, solve
from gtsam_rwhec.solver.solve_options import SolveOptions

SOURCE = (
    "E. Wise et al., A certifiably correct algorithm for generalized robot-world and hand-eye calibration, "
    "arXiv 2507.23045"
)


def certified(problem: Problem, options: MethodOptions) -> Outcome[Poses]:
    """Solve by ``gtsam_rwhec.solve``; the notes give the certificate if it does not prove the answer."""
    return outcome_of(quiet_solution(problem, options))


def quiet_solution(problem: Problem, options: MethodOptions) -> Solution:
    """Solve by ``gtsam_rwhec.solve`` without its warnings: the solution states the same facts."""
    with warnings.catch_warnings():
        for category in (NotUniqueWarning, NotCertifiedWarning, WeightsWarning):
            warnings.simplefilter("ignore", category)
        return solve(problem, options=SolveOptions(seed=options.seed))


def outcome_of(solution: Solution) -> Outcome[Poses]:
    """A solution as a method's answer."""
    notes = () if solution.certificate.is_certified else (str(solution.certificate),)
    return Outcome(
        solution.X,
        solution.Y,
        solution.scale,
        cost=solution.cost,
        cost_name=str(solution.certificate.objective),
        lower_bound=solution.certificate.lower_bound,
        is_optimal=solution.certificate.is_certified,
        notes=notes,
    )


CERTIFIED = Method(
    name="certified",
    properties=Properties("SE(3)", probabilistic=True, certifiable=True, multiple="Xs and Ys", monocular=True),
    source=SOURCE,
    assumes="Isotropic noise on B, exact A. The answer says whether it is proven optimal.",
    function=certified,
    takes=frozenset({Takes.SHARED_SCALE, Takes.SCALE_PER_TARGET, Takes.MOTIONS, Takes.PRIORS, Takes.MOMENTS}),
)


def certified_motions(request: Request) -> Outcome[Array]:
    """Certified minimum of sum |R_C R - R R_H|^2 + alpha^2 |(R_C - 1) T - R T_H + T_C|^2 (eq. 30, first).

    The library's cost J is this cost when a motion of weight w has 1 / sigma^2 = 2 alpha^2 w and kappa = 2 w. An
    unknown scale has t_C = scale * (true length). The equation is then inverted, H X^-1 = X^-1 C, so that the measured
    side has the scale: the cost is that of X^-1. Raises ScaleError when the scale at the optimum is not positive.
    """
    w = np.ones(len(request.motions)) if request.weights is None else request.weights
    used = w > 0.0
    C, H, w = request.motions.C[used], request.motions.H[used], w[used]
    sigma, kappa = 1.0 / (request.alpha * np.sqrt(2.0 * w)), 2.0 * w
    known = request.scale == "known"
    problem = Problem(scale="known" if known else "shared", keep_measurements=False)
    name = "h" if known else "c"  # the name of the problem's only sensor
    problem.add_motion(name, *((C, H) if known else (H, C)), sigma, kappa)
    solution = quiet_solution(problem, MethodOptions())
    Y, scale = solution.Y[name], solution.scale
    if isinstance(scale, dict):
        scale = scale[name]
    return Outcome(
        X=(Y if known else Y.inverse()).matrix(),
        cost=solution.cost,
        cost_name="eq. 30, chordal" if known else "eq. 30, chordal, of X^-1 with t_C / scale",
        lower_bound=solution.certificate.lower_bound,
        free_directions=solution.identifiability.free_directions,
        scale=scale,
    )


#: Residuals (radians, or lengths over the spread of the translations) below this are rounding error of exact poses.
LEAST_RESIDUAL = 1e-6


def certified_hand_eye(stations: Stations) -> tuple[Array, Array]:
    """The certified pose of the camera in the gripper.

    The translations are taken about the target's own origin again, since the camera measures its position. About
    another origin each rotation error would move the position.
    """
    R_A = stations.R_G.transpose(0, 2, 1)  # gripper_T_base
    t_A = -np.einsum("nab,nb->na", R_A, stations.t_G)
    t_C = stations.t_C + stations.R_C @ stations.origin
    _, Y = certified_poses(R_A, t_A, stations.R_C, t_C)
    return Y[:3, :3], Y[:3, 3]


def certified_robot_world(R_A: Array, t_A: Array, R_B: Array, t_B: Array) -> tuple[Array, Array, Array, Array]:
    """The certified base2world and gripper2cam, from world2cam (A, the measurement) and base2gripper (B)."""
    X, Z = (np.linalg.inv(T) for T in certified_poses(R_B, t_B, R_A, t_A))
    return X[:3, :3], X[:3, 3], Z[:3, :3], Z[:3, 3]


def certified_poses(R_A: Array, t_A: Array, R_B: Array, t_B: Array) -> tuple[Array, Array]:
    """X and Y (4, 4) of A X = Y B, solved with unit weights, then with weights from the first answer's residuals.

    OpenCV's calls have no argument for the noise, so residuals are used to estimate the noise of rotations and
    of translations. An isotropic rotation of rms angle s has s / sqrt(3) an axis and kappa = 1 / (2 sigma_R^2).
    OpenCV's calls have no unit either: the solver's unit of length is the spread of the given translations.
    """
    unit = float(np.sqrt(t_A.var(axis=0).sum() + t_B.var(axis=0).sum())) or 1.0
    A, B = pose(R_A, t_A / unit), pose(R_B, t_B / unit)
    residual = _solved(A, B).residuals[Pair("target", "camera")]
    sigma = max(residual.translation_rms_m, LEAST_RESIDUAL) / np.sqrt(3.0)
    sigma_rad = max(residual.rotation_rms_rad, LEAST_RESIDUAL) / np.sqrt(3.0)
    solution = _solved(A, B, sigma, 0.5 / sigma_rad**2)
    X, Y = solution.X["target"].matrix(), solution.Y["camera"].matrix()
    X[:3, 3] *= unit
    Y[:3, 3] *= unit
    return X, Y


def _solved(A: Array, B: Array, sigma: float | None = None, kappa: float | None = None) -> Solution:
    problem = Problem(keep_measurements=False)
    problem.add("target", "camera", A, B, sigma, kappa)
    return solve(problem)
