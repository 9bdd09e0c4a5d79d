"""Strobl and Hirzinger 2006: rotation and translation errors weighed by their variances, which are estimated too.

Rotations and translations have Gaussian errors of unknown standard deviations sigma_R (rad an axis) and sigma_t (m an
axis), the same in all measurements. For given ones the poses are a nonlinear least-squares problem on the manifold; the
errors that are left estimate them anew, and so on until the weights rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array, one_transform
from gtsam_rwhec.methods.absolute import Stack, linear_outcome, linear_rotations
from gtsam_rwhec.methods.estimate import Outcome, Poses
from gtsam_rwhec.methods.method import Method, MethodOptions, Properties, checked_start
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.rotations import retract

#: The weights rest when their ratio changes by less than this share.
SETTLED = 1e-6
ROUNDS = 50
#: Errors below these are rounding: exact data have no variance to weigh by.
SMALLEST_RAD, SMALLEST_M = 1e-9, 1e-9


@dataclass(frozen=True)
class Weighed:
    """Poses X, Y (4, 4), the standard deviations estimated with them, in rad and m an axis, and the rounds it took."""

    X: Array
    Y: Array
    sigma_R: float
    sigma_t: float
    rounds: int
    settled: bool


def strobl2006(problem: Problem, options: MethodOptions) -> Outcome[Poses]:
    """One X, one Y: reweighed until the weights rest."""
    stack = Stack.of(problem)
    target, sensor = stack.targets[0], stack.sensors[0]
    if options.start is None:
        start = linear_outcome(stack, *linear_rotations(stack))
        of_X, of_Y, starts_from = start.X, start.Y, "shah2013"
    else:
        of_X, of_Y, _ = checked_start(problem, options.start)
        starts_from = "the given start"
    X, Y = one_transform(of_X[target], f"start of {target}"), one_transform(of_Y[sensor], f"start of {sensor}")
    found = reweighed(stack, X, Y, options.max_iterations)
    notes = [f"estimated errors: {np.degrees(found.sigma_R):.3g} deg and {1e3 * found.sigma_t:.3g} mm an axis"]
    if not found.settled:
        notes.append(f"the weights had not come to rest after {found.rounds} rounds")
    return Outcome({target: found.X}, {sensor: found.Y}, starts_from=starts_from, notes=tuple(notes))


def reweighed(stack: Stack, X: Array, Y: Array, max_iterations: int) -> Weighed:
    """Poses and variances in turn, from a start X, Y (4, 4)."""
    a, c = stack.gauge.sensor_carrier, stack.gauge.target_carrier
    centred = stack.A.copy()
    centred[:, :3, 3] = stack.centred_t_A
    R: Array = np.stack([X[:3, :3], Y[:3, :3]])
    t: Array = np.stack([X[:3, 3] - c, Y[:3, 3] - a])
    ratio, settled, rounds = 0.0, False, 0
    while rounds < ROUNDS:
        rounds += 1
        e_R, e_t = errors(centred, stack.B, R, t)
        # Both have three numbers a measurement and share twelve unknowns, which cancel in the ratio of the weights.
        degrees = max(3.0 * len(centred) - 6.0, 1.0)
        sigma_R = max(float(np.sqrt(np.vdot(e_R, e_R) / degrees)), SMALLEST_RAD)
        sigma_t = max(float(np.sqrt(np.vdot(e_t, e_t) / degrees)), SMALLEST_M)
        previous, ratio = ratio, sigma_t / sigma_R
        settled = abs(ratio - previous) <= SETTLED * ratio
        if settled:
            break
        R, t = _descended(centred, stack.B, R, t, sigma_R, sigma_t, max_iterations)
    T = np.tile(np.eye(4), (2, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, t + np.stack([c, a])
    return Weighed(T[0], T[1], sigma_R, sigma_t, rounds, settled)


def errors(A: Array, B: Array, R: Array, t: Array) -> tuple[Array, Array]:
    """Rotation vectors of (Y B)^-1 A X and R_A t_X + t_A - R_Y t_B - t_Y, (N, 3) each; R, t those of X and of Y."""
    R_A, R_B = A[:, :3, :3], B[:, :3, :3]
    e_R = se3.so3_logmap((R[1] @ R_B).transpose(0, 2, 1) @ R_A @ R[0])
    e_t = R_A @ t[0] + A[:, :3, 3] - B[:, :3, 3] @ R[1].T - t[1]
    return e_R, e_t


def jacobian(A: Array, B: Array, R: Array, e_R: Array) -> tuple[Array, Array]:
    """Of e_R by [w_X, w_Y] (N, 3, 6) and of e_t by [w_X, w_Y, t_X, t_Y] (N, 3, 12), rotations R Expmap(w)."""
    left_inverse = se3.so3_left_jacobian_inverse(e_R)
    # log(E Expmap(w)): J_r^-1 = (J_l^-1)'; log(Expmap(-R_B' w) E): -J_l^-1 R_B'
    J_R = np.concatenate([left_inverse.transpose(0, 2, 1), -left_inverse @ B[:, :3, :3].transpose(0, 2, 1)], axis=2)
    J_t = np.zeros((len(A), 3, 12))
    J_t[:, :, 3:6] = R[1] @ se3.hat(B[:, :3, 3])
    J_t[:, :, 6:9] = A[:, :3, :3]
    J_t[:, :, 9:] = -np.eye(3)
    return J_R, J_t


def _descended(
    A: Array, B: Array, R: Array, t: Array, sigma_R: float, sigma_t: float, max_iterations: int
) -> tuple[Array, Array]:
    """Least |e_R|^2 / sigma_R^2 + |e_t|^2 / sigma_t^2 by Levenberg-Marquardt on SO(3)^2 x R^6."""
    damping = 1e-9
    e_R, e_t = errors(A, B, R, t)
    cost = np.vdot(e_R, e_R) / sigma_R**2 + np.vdot(e_t, e_t) / sigma_t**2
    for _ in range(max_iterations):
        J_R, J_t = jacobian(A, B, R, e_R)
        H = np.einsum("nia,nib->ab", J_t, J_t) / sigma_t**2
        H[:6, :6] += np.einsum("nia,nib->ab", J_R, J_R) / sigma_R**2
        g = np.einsum("nia,ni->a", J_t, e_t) / sigma_t**2
        g[:6] += np.einsum("nia,ni->a", J_R, e_R) / sigma_R**2
        while True:
            step = -np.linalg.solve(H + damping * np.diag(np.diagonal(H)), g)
            R_new, t_new = retract(R, step[:6].reshape(2, 3)), t + step[6:].reshape(2, 3)
            e_R, e_t = errors(A, B, R_new, t_new)
            cost_new = np.vdot(e_R, e_R) / sigma_R**2 + np.vdot(e_t, e_t) / sigma_t**2
            if cost_new <= cost or damping > 1e6:
                break
            damping *= 10.0
        if cost_new > cost:  # rounding: no step goes down
            return R, t
        R, t, decrease, cost = R_new, t_new, cost - cost_new, cost_new
        damping = max(0.1 * damping, 1e-12)
        if decrease <= 1e-14 * cost and float(np.abs(step).max()) < 1e-8:
            break
    return R, t


METHOD = Method(
    name="strobl2006",
    properties=Properties("SE(3)", probabilistic=True),
    source="K. Strobl and G. Hirzinger, Optimal hand-eye calibration, IROS 2006",
    assumes="Errors alike in all measurements, whose sizes it finds itself (sigma and kappa are not used); a start "
    "near the answer.",
    function=strobl2006,
)
