"""Li, Wang and Wu 2010: all 24 entries of X and Y at once by a Kronecker product, and dual quaternions."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import LEFT, RIGHT, conjugate, dual_parts, left, to_rotations
from gtsam_rwhec.methods.absolute import Stack, plain_form, rotations_up_to_sign
from gtsam_rwhec.methods.estimate import Outcome, Poses
from gtsam_rwhec.methods.method import UNWEIGHTED, Method, MethodOptions, Properties
from gtsam_rwhec.methods.normal_equations import solve_scaled
from gtsam_rwhec.methods.paired_quaternions import paired_quaternions
from gtsam_rwhec.problem.problem import Problem

_SOURCE = (
    "A. Li, L. Wang and D. Wu, Simultaneous robot-world and hand-eye calibration using dual-quaternions and Kronecker "
    "product, Int. J. Physical Sciences 5(10), 2010"
)


def kronecker(problem: Problem, options: MethodOptions) -> Outcome[Poses]:
    """Solve A X = Y B by linear least squares over all entries of X and Y, then project the matrices to rotations.

    The translations belong to the matrices before the projection.
    """
    stack = Stack.of(problem)
    form = plain_form(stack)
    unknown = np.delete(np.arange(25), 6)
    undetermined = (
        "the linear system of the 24 entries of X and Y is singular: rotations about parallel axes, half turns alone, "
        "carriers that do not move, or a sensor that always sees the target in the same place; turn about a second "
        "axis, and change the distance"
    )
    x = solve_scaled(form[np.ix_(unknown, unknown)], -form[unknown, 6], undetermined)
    R = rotations_up_to_sign(x[6:].reshape(2, 3, 3).transpose(0, 2, 1))
    return stack.outcome(R, x[:6].reshape(2, 3) + stack.origins)


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
    source=_SOURCE,
    assumes=f"{UNWEIGHTED} The target's position in the sensor's frame changes: a camera that only turns about the "
    "target does not determine the 24 entries of X and Y.",
    function=kronecker,
)
DUAL_QUATERNIONS = Method(
    name="li2010_dq",
    properties=Properties("dual quaternions"),
    source=_SOURCE,
    assumes=f"{UNWEIGHTED} Signs of quaternions must fit. Carriers' origins are near the data: dual parts' errors grow "
    "with the distance.",
    function=dual_quaternions,
)
