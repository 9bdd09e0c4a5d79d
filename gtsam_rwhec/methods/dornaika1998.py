"""Dornaika and Horaud 1998: unit quaternions in closed form, and the nonlinear problem over matrices with penalties."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array, one_transform
from gtsam_rwhec.geometry.quaternions import LEFT, RIGHT, to_rotations
from gtsam_rwhec.methods.absolute import Stack, linear_outcome, plain_form, rotations_up_to_sign
from gtsam_rwhec.methods.estimate import Outcome, Poses
from gtsam_rwhec.methods.linear_methods import start_of
from gtsam_rwhec.methods.method import Method, MethodOptions, Properties
from gtsam_rwhec.methods.paired_quaternions import paired_quaternions
from gtsam_rwhec.problem.problem import Problem

#: The weight of |R R' - I|^2 against the residuals', which is 1.
PENALTY = 1e6


def closed_form(problem: Problem, options: MethodOptions) -> Outcome[Poses]:
    """q_A q_X = q_Y q_B in least squares over two unit quaternions, then the translations.

    The sum of |L(q_A) q_X - R(q_B) q_Y|^2 is 2 N - 2 q_X' C q_Y with C = sum of L(q_A)' R(q_B): q_X and q_Y are
    the singular vectors of C's largest singular value.
    """
    stack = Stack.of(problem)
    q_A, q_B = paired_quaternions(stack)
    C = np.einsum("cd,cji,djk->ik", q_A.T @ q_B, LEFT, RIGHT)
    U, _, Vt = np.linalg.svd(C)
    return linear_outcome(stack, to_rotations(U[:, :1].T), to_rotations(Vt[:1]))


def nonlinear(problem: Problem, options: MethodOptions) -> Outcome[Poses]:
    """Least |R_A R_X - R_Y R_B|^2 + |R_A t_X + t_A - R_Y t_B - t_Y|^2 + 1e6 (|R_X R_X' - I|^2 + |R_Y R_Y' - I|^2).

    Over the 24 entries, by Levenberg-Marquardt. The first two sums are one quadratic form in them, so an iteration's
    cost does not grow with the number of measurements. What the penalties leave is projected to rotations.
    """
    from scipy.optimize import least_squares

    stack = Stack.of(problem)
    target, sensor = stack.targets[0], stack.sensors[0]
    X, Y, _, starts_from = start_of(problem, options)
    T_X, T_Y = one_transform(X[target], f"start of {target}"), one_transform(Y[sensor], f"start of {sensor}")
    form = plain_form(stack)
    values, vectors = np.linalg.eigh(form)
    root = (np.sqrt(np.maximum(2.0 * values, 0.0)) * vectors).T  # 1/2 |root x|^2 = x' Q x

    def residual(x: Array) -> Array:
        R_X, R_Y = x[6:15].reshape(3, 3).T, x[15:24].reshape(3, 3).T
        penalties = np.concatenate([(R @ R.T - np.eye(3)).ravel() for R in (R_X, R_Y)])
        rows: Array = np.concatenate([root[:, :6] @ x[:6] + root[:, 6] + root[:, 7:] @ x[6:], PENALTY**0.5 * penalties])
        return rows

    def jacobian(x: Array) -> Array:
        J = np.zeros((len(root) + 18, 24))
        J[: len(root), :6], J[: len(root), 6:] = root[:, :6], root[:, 7:]
        for frame in range(2):
            R = x[6 + 9 * frame : 15 + 9 * frame].reshape(3, 3).T
            at = 6 + 9 * frame
            rows = J[len(root) + 9 * frame : len(root) + 9 * frame + 9, at : at + 9].reshape(3, 3, 3, 3)
            # d(R R')_ij / dR_ab = delta_ia R_jb + delta_ja R_ib; entry (a, b) is at 3 b + a
            derivative = np.einsum("ia,jb->ijba", np.eye(3), R) + np.einsum("ja,ib->ijba", np.eye(3), R)
            rows[...] = PENALTY**0.5 * derivative
        return J

    gauge = stack.gauge
    start = np.concatenate(
        [
            T_X[:3, 3] - gauge.target_carrier,
            T_Y[:3, 3] - gauge.sensor_carrier,
            T_X[:3, :3].T.ravel(),
            T_Y[:3, :3].T.ravel(),
        ]
    )
    found = least_squares(
        residual, start, jacobian, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=options.max_iterations
    )
    x = found.x
    R = rotations_up_to_sign(x[6:24].reshape(2, 3, 3).transpose(0, 2, 1))
    t_X, t_Y = x[None, :3] + gauge.target_carrier, x[None, 3:6] + gauge.sensor_carrier
    return stack.outcome(R[:1], t_X, R[1:], t_Y, starts_from=starts_from)


_SOURCE = "F. Dornaika and R. Horaud, Simultaneous robot-world and hand-eye calibration, IEEE T-RA 14(4), 1998"

CLOSED = Method(
    name="dornaika1998_closed",
    properties=Properties("unit quaternions", joint=False),
    source=_SOURCE,
    assumes="Rotations without the translations' help, all measurements alike; quaternions whose signs fit together.",
    function=closed_form,
)
NONLINEAR = Method(
    name="dornaika1998",
    properties=Properties("matrices", probabilistic=True),
    source=_SOURCE,
    assumes="A start near the answer; a radian weighs as much as a metre (times the square root of two), whatever the "
    "noise.",
    function=nonlinear,
)
