"""Closed forms: Shah 2013 and Wang 2022, Zhuang 1994, Dornaika 1998, Li 2010; and the start of those that descend."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import LEFT, RIGHT, conjugate, dual_parts, left, of_rotations, right, to_rotations
from gtsam_rwhec.methods.linear_systems import (
    FREE,
    Stack,
    linear_outcome,
    linear_rotations,
    linear_translations,
    paired_quaternions,
    plain_form,
    poses_of,
    solve_scaled,
)
from gtsam_rwhec.methods.method import UNWEIGHTED, Method, MethodOptions, Outcome, Poses, Properties, checked_start
from gtsam_rwhec.problem.problem import Problem


def linear_method(problem: Problem, options: MethodOptions) -> Outcome[Poses]:
    """Closed form. With one X and one Y, Wang's method is Shah's: singular vectors of a sum of Kronecker products."""
    stack = Stack.of(problem)
    return linear_outcome(stack, linear_rotations(stack))


def start_of(problem: Problem, options: MethodOptions) -> tuple[Poses, Poses, float, str]:
    """X, Y, scale, and a text that names their source: the given start, else Wang's answer.

    Wang's linear systems are extended to several Xs and Ys and to an unknown scale, which his method does not have.
    Raises FrameError, PoseError or ScaleError for a given start that lacks a frame or has other values than poses and a
    scale, and UnderdeterminedError when the linear systems do not determine a start.
    """
    if options.start is not None:
        return *checked_start(problem.targets, problem.sensors, options.start), "the given start"
    stack = Stack.of(problem)
    unknown = problem.scale != "known"
    R = linear_rotations(stack)
    t, alpha = linear_translations(stack, R, unknown_scale=unknown)
    start = stack.outcome(R, t)
    words = "wang2022"
    if unknown or min(len(stack.targets), len(stack.sensors)) > 1:
        words = "wang2022's linear systems, " + ("with the scale" if unknown else "for several Xs and Ys")
    return start.X, start.Y, alpha, words


_ASSUMES = "All measurements equally accurate, at least two axes of rotation. Translations do not help the rotations."

SHAH = Method(
    name="shah2013",
    function=linear_method,
    properties=Properties("SE(3)", joint=False),
    source="M. Shah, Solving the robot-world/hand-eye calibration problem using the Kronecker product, "
    "J. Mechanisms and Robotics 5(3), 2013",
    assumes=_ASSUMES,
)
WANG = Method(
    name="wang2022",
    function=linear_method,
    properties=Properties("SE(3)", joint=False, multiple="Xs or Ys"),
    source="Y. Wang et al., Accurate calibration of multi-perspective cameras from a generalization of the hand-eye "
    "constraint, ICRA 2022",
    assumes=_ASSUMES,
)


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


ZHUANG = Method(
    name="zhuang1994",
    properties=Properties("unit quaternions", joint=False),
    source="H. Zhuang, Z. S. Roth and R. Sudhakar, Simultaneous robot/world and tool/flange calibration by solving "
    "homogeneous transformation equations of the form AX = YB, IEEE T-RA 10(4), 1994",
    assumes="Neither Y nor any A is near a half turn: the scalar parts of their quaternions are divisors.",
    function=zhuang1994,
)


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


DORNAIKA_SOURCE = "F. Dornaika and R. Horaud, Simultaneous robot-world and hand-eye calibration, IEEE T-RA 14(4), 1998"

DORNAIKA_CLOSED = Method(
    name="dornaika1998_closed",
    properties=Properties("unit quaternions", joint=False),
    source=DORNAIKA_SOURCE,
    assumes="All measurements equally accurate. Translations do not help the rotations. Signs of quaternions must fit.",
    function=closed_form,
)
_LI_SOURCE = (
    "A. Li, L. Wang and D. Wu, Simultaneous robot-world and hand-eye calibration using dual-quaternions and Kronecker "
    "product, Int. J. Physical Sciences 5(10), 2010"
)


def kronecker(problem: Problem, options: MethodOptions) -> Outcome[Poses]:
    """Solve A X = Y B by linear least squares over all entries of X and Y, then project the matrices to rotations.

    The translations belong to the matrices before the projection.
    """
    stack = Stack.of(problem)
    form, unknown = plain_form(stack), np.delete(np.arange(25), 6)
    undetermined = (
        "the linear system of the 24 entries of X and Y is singular: rotations about parallel axes, half turns alone, "
        "carriers that do not move, or a sensor that always sees the target in the same place; turn about a second "
        "axis, and change the distance"
    )
    x = solve_scaled(form[np.ix_(unknown, unknown)], -form[unknown, 6], undetermined)
    return stack.outcome(*poses_of(stack, x))


def _rows() -> Array:
    """The equations' coefficients (16, 8, 16): [feature of q_A, q'_A, q_B, q'_B; equation; q_X, q'_X, q_Y, q'_Y].

    q_A q_X - q_Y q_B = 0 and q_A q'_X + q'_A q_X - q_Y q'_B - q'_Y q_B = 0.
    """
    rows = np.zeros((16, 8, 16))
    real, dual = slice(0, 4), slice(4, 8)
    X, dual_X, Y, dual_Y = (slice(4 * i, 4 * i + 4) for i in range(4))
    rows[0:4, real, X] = rows[0:4, dual, dual_X] = rows[4:8, dual, X] = LEFT
    rows[8:12, real, Y] = rows[8:12, dual, dual_Y] = rows[12:16, dual, Y] = -RIGHT
    return rows


_ROWS = _rows()


def dual_quaternions(problem: Problem, options: MethodOptions) -> Outcome[Poses]:
    """Solve the homogeneous linear system of two dual quaternions, 8 equations a measurement.

    Exact data leave two dimensions, (q, q') and (0, q) of both frames. So the answer is a combination of the two
    smallest singular vectors whose real and dual parts are orthogonal. Of two such combinations it has the larger real
    part. Each frame is then made a unit dual quaternion.
    """
    stack = Stack.of(problem)
    q_A, q_B = paired_quaternions(stack)
    features = np.concatenate(
        [q_A, dual_parts(q_A, stack.A[:, :3, 3]), q_B, dual_parts(q_B, stack.B[:, :3, 3])], axis=1
    )
    normal = np.einsum("fg,fri,grj->ij", features.T @ features, _ROWS, _ROWS, optimize=True)
    v = np.linalg.eigh(normal)[1][:, :2].T.reshape(2, 2, 2, 4)  # [vector, frame, real or dual, entry]
    # v_0 cos u + v_1 sin u: real . dual, over both frames, is a quadratic form P in (cos u, sin u)
    P = np.einsum("afi,bfi->ab", v[:, :, 0], v[:, :, 1])
    real = np.einsum("afi,bfi->ab", v[:, :, 0], v[:, :, 0])
    directions = _isotropic(0.5 * (P + P.T))
    combination = directions[np.argmax(np.einsum("na,ab,nb->n", directions, real, directions))]
    q, dual = np.moveaxis(np.einsum("a,afki->fki", combination, v), 1, 0)
    length = np.linalg.norm(q, axis=1, keepdims=True)
    q, dual = q / length, dual / length
    dual = dual - np.einsum("fi,fi->f", q, dual)[:, None] * q
    t = 2.0 * np.einsum("fij,fj->fi", left(dual), conjugate(q))[:, :3]
    return stack.outcome(to_rotations(q), t)


def _isotropic(P: Array) -> Array:
    """Two unit vectors u (2, 2) with u' P u = 0 or nearest to 0, for a symmetric P (2, 2)."""
    (small, large), axes = np.linalg.eigh(P)
    if small * large >= 0.0:  # definite, by noise: the smaller eigenvalue
        nearest = axes[:, int(abs(small) > abs(large))]
        return np.array([nearest, nearest])
    c, s = np.sqrt(large), np.sqrt(-small)
    u: Array = np.array([c * axes[:, 0] + s * axes[:, 1], c * axes[:, 0] - s * axes[:, 1]]) / np.hypot(c, s)
    return u


# The RWHEC paper's Section 2 says that Li's methods solve rotations and translations separately. But both systems hold
# both, and measured translations affect the rotations found: the methods are joint.
KRONECKER = Method(
    name="li2010_kronecker",
    properties=Properties("matrices"),
    source=_LI_SOURCE,
    assumes=f"{UNWEIGHTED} The target's position in the sensor's frame changes: a camera that only turns about the "
    "target does not determine the 24 entries of X and Y.",
    function=kronecker,
)
DUAL_QUATERNIONS = Method(
    name="li2010_dq",
    properties=Properties("dual quaternions"),
    source=_LI_SOURCE,
    assumes=f"{UNWEIGHTED} Signs of quaternions must fit. Carriers' origins are near the data: dual parts' errors grow "
    "with the distance.",
    function=dual_quaternions,
)
