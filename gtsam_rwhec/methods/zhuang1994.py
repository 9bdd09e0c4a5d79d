"""Zhuang, Roth and Sudhakar 1994: a linear system in the vector parts of two quaternions, then the translations."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.geometry.quaternions import left, of_rotations, right, to_rotations
from gtsam_rwhec.methods.absolute import Stack, linear_outcome, linear_rotations
from gtsam_rwhec.methods.estimate import Outcome, Poses
from gtsam_rwhec.methods.method import Method, MethodOptions, Properties
from gtsam_rwhec.methods.normal_equations import FREE
from gtsam_rwhec.methods.paired_quaternions import paired_quaternions
from gtsam_rwhec.problem.problem import Problem

#: Measurements whose A has a smaller scalar part (half turns) are left out: the equations divide by it.
SMALLEST_SCALAR = 1e-3
#: A note warns the user when Y's scalar part is below this (11 degrees off a half turn).
NEAR_HALF_TURN = 0.1


def zhuang1994(problem: Problem, options: MethodOptions) -> Outcome[Poses]:
    """q_A q_X = q_Y q_B with q_X's scalar part eliminated and q_Y's divided out: six unknowns.

    With q = (s, v), the equation's scalar part gives s_X = (s_Y s_B - v_Y.v_B + v_A.v_X) / s_A, and the vector part,
    divided by s_Y, is

        (s_A I + [v_A]x + v_A v_A'/s_A) v_X/s_Y - (s_B I - [v_B]x + v_A v_B'/s_A) v_Y/s_Y = v_B - (s_B/s_A) v_A.
    """
    stack = Stack.of(problem)
    q_A, q_B = paired_quaternions(stack)
    usable = np.abs(q_A[:, 3]) > SMALLEST_SCALAR
    v_A, s_A, v_B, s_B = q_A[usable, :3], q_A[usable, 3:], q_B[usable, :3], q_B[usable, 3:]
    # L(q)'s upper left block is s I + [v]x, R(q)'s is s I - [v]x
    of_X = left(q_A[usable])[:, :3, :3] + (v_A / s_A)[:, :, None] * v_A[:, None, :]
    of_Y = -right(q_B[usable])[:, :3, :3] - (v_A / s_A)[:, :, None] * v_B[:, None, :]
    rows = np.concatenate([of_X, of_Y], axis=2).reshape(-1, 6)
    constants = (v_B - s_B / s_A * v_A).ravel()
    normal = rows.T @ rows
    values = np.linalg.eigvalsh(normal)
    if not usable.any() or values[0] <= FREE * values[-1]:
        raise UnderdeterminedError(
            "Zhuang's linear system is singular: an A or Y is a half turn, and the system divides by its quaternion's "
            "scalar part, or the measured rotations turn about parallel axes. Turn a carrier's frame by a known "
            "rotation, or use another method"
        )
    ratio = np.linalg.solve(normal, rows.T @ constants)
    s_Y = 1.0 / np.sqrt(1.0 + ratio[3:] @ ratio[3:])
    v_X, v_Y = s_Y * ratio[:3], s_Y * ratio[3:]
    scalar = s_Y * s_B[:, 0] - v_B @ v_Y + v_A @ v_X  # s_A s_X of each measurement
    s_X = s_A[:, 0] @ scalar / (s_A[:, 0] @ s_A[:, 0])
    notes = []
    # Noise pulls the ratios down, so the system's own s_Y does not show a true value near 0.
    scalar_of_Y = abs(of_rotations(linear_rotations(stack))[1, 3])
    if scalar_of_Y < NEAR_HALF_TURN:
        notes.append(f"the answer is poor: Y is near a half turn, and its scalar part {scalar_of_Y:.3g} is a divisor")
    if not usable.all():
        notes.append(f"{np.sum(~usable)} measurements were left out: A is a half turn, whose scalar part is a divisor")
    return linear_outcome(stack, to_rotations(np.array([[*v_X, s_X], [*v_Y, s_Y]])), notes)


METHOD = Method(
    name="zhuang1994",
    properties=Properties("unit quaternions", joint=False),
    source="H. Zhuang, Z. S. Roth and R. Sudhakar, Simultaneous robot/world and tool/flange calibration by solving "
    "homogeneous transformation equations of the form AX = YB, IEEE T-RA 10(4), 1994",
    assumes="Neither Y nor any A is near a half turn: the scalar parts of their quaternions are divisors.",
    function=zhuang1994,
)
