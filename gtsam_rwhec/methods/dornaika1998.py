"""Dornaika and Horaud 1998: unit quaternions in closed form, and the nonlinear problem over matrices with penalties."""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

from gtsam_rwhec.geometry.poses import Array, one_transform
from gtsam_rwhec.geometry.quaternions import LEFT, RIGHT, to_rotations
from gtsam_rwhec.methods.absolute import Stack, linear_outcome, plain_form, rotations_up_to_sign
from gtsam_rwhec.methods.estimate import Outcome, Poses
from gtsam_rwhec.methods.levenberg_marquardt import descend_on_chart
from gtsam_rwhec.methods.linear_methods import start_of
from gtsam_rwhec.methods.method import Method, MethodOptions, Properties
from gtsam_rwhec.methods.paired_quaternions import paired_quaternions
from gtsam_rwhec.problem.problem import Problem

#: |R R' - I|^2 has this weight; the residuals have weight 1.
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
    return linear_outcome(stack, to_rotations(np.array([U[:, 0], Vt[0]])))


def nonlinear(problem: Problem, options: MethodOptions) -> Outcome[Poses]:
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
    R = rotations_up_to_sign(x[6:].reshape(2, 3, 3).transpose(0, 2, 1))
    return stack.outcome(R, x[:6].reshape(2, 3) + stack.origins, starts_from=starts_from)


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


_SOURCE = "F. Dornaika and R. Horaud, Simultaneous robot-world and hand-eye calibration, IEEE T-RA 14(4), 1998"

CLOSED = Method(
    name="dornaika1998_closed",
    properties=Properties("unit quaternions", joint=False),
    source=_SOURCE,
    assumes="All measurements equally accurate. Translations do not help the rotations. Signs of quaternions must fit.",
    function=closed_form,
)
NONLINEAR = Method(
    name="dornaika1998",
    properties=Properties("matrices", probabilistic=True),
    source=_SOURCE,
    assumes="A start near the answer. A radian weighs as much as a metre (times the square root of two).",
    function=nonlinear,
)
