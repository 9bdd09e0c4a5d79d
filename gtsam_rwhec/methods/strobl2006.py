"""Strobl and Hirzinger 2006: rotation and translation errors weighed by their variances, which are estimated too.

Rotations and translations have Gaussian errors of unknown standard deviations sigma_R (rad an axis) and sigma_t (m an
axis), equal in all measurements. For given standard deviations the poses are a nonlinear least-squares problem on the
manifold. The residuals estimate the standard deviations again, and so on until the weights rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array, one_transform
from gtsam_rwhec.methods.absolute import Stack
from gtsam_rwhec.methods.estimate import Outcome, Poses
from gtsam_rwhec.methods.linear_methods import start_of
from gtsam_rwhec.methods.local_on_manifold import LomOptions, local_on_manifold
from gtsam_rwhec.methods.method import Method, MethodOptions, Properties
from gtsam_rwhec.problem.problem import Problem

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
    """Solve for one X and one Y; weights and poses are estimated in turn until the weights rest."""
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


METHOD = Method(
    name="strobl2006",
    properties=Properties("SE(3)", probabilistic=True),
    source="K. Strobl and G. Hirzinger, Optimal hand-eye calibration, IROS 2006",
    assumes="All measurements equally accurate; the method estimates the accuracy and ignores sigma and kappa. A start "
    "near the answer.",
    function=strobl2006,
)
