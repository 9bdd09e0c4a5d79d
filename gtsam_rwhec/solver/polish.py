"""Newton steps on the cost of the raw measurements, from an answer that the moments gave.

Where weights are extreme, or the origin far, moments hold fewer digits of the optimum than the measurements do. The
gradient comes from the measurements, the second derivative from the moments.
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.answers import Evaluation, Point
from gtsam_rwhec.solver.curvature import Curvature
from gtsam_rwhec.solver.rotations import kkt_multipliers, retract, tangent_basis, vec

#: A gradient that can lower the cost by less than about this part of it is left as it is.
WORTH = 1e-18
#: What is added to the Hessian's diagonal, as a part of it, where the measurements leave directions free.
DAMPING = 1e-9
#: A step that moves a rotation (rad), a translation over the largest, or a scale over itself, by more than this is not
#: taken: the start was near the optimum already.
LONGEST = 1e-2


def is_worth_a_step(curvature: Curvature, evaluation: Evaluation) -> bool:
    """Whether the gradient along the rotations' tangents and the other variables is more than rounding."""
    g = _tangent_gradient(evaluation)
    scale = np.abs(curvature.diagonal)
    frames = scale[:-1].reshape(-1, 13)
    by_tangent = np.append(
        np.c_[frames[:, :4], np.repeat(frames[:, 4:].mean(axis=1)[:, None], 3, axis=1)].ravel(), scale[-1]
    )
    gain = float((g**2 / np.maximum(by_tangent, 1e-290)).sum())
    return gain > WORTH * evaluation.cost


def newton_step(curvature: Curvature, evaluation: Evaluation) -> Point | None:
    """The point after one Newton step; None where the Hessian is not positive definite, or the step is long."""
    point = evaluation.point
    R = point.rotations
    n = len(R)
    gradient = evaluation.gradient[:-1].reshape(n, 13)[:, 4:]
    T = np.zeros((n, 13, 7))
    T[:, :4, :4] = np.eye(4)
    T[:, 4:, 4:] = tangent_basis(R)
    hessian = curvature.less(kkt_multipliers(R, gradient)).matrix.congruent(T)
    factor = hessian.factor()
    if factor is None:
        factor = hessian.plus(DAMPING * hessian.diagonal).factor()
    if factor is None:
        return None
    step = factor.solve_vector(_tangent_gradient(evaluation))
    by_frame = step[:-1].reshape(n, 7)
    reach = max(float(np.abs(point.numbers[:, :3]).max(initial=0.0)), 1e-9)
    scales = np.append(point.numbers[:, 3], point.alpha)
    change = np.abs(np.append(by_frame[:, 3], step[-1])) / np.maximum(np.abs(scales), 1e-290)
    longest = max(
        np.abs(by_frame[:, 4:]).max(initial=0.0), np.abs(by_frame[:, :3]).max(initial=0.0) / reach, change.max()
    )
    if not longest <= LONGEST:
        return None
    numbers = point.numbers.copy()
    numbers[:, :4] -= by_frame[:, :4]
    numbers[:, 4:] = vec(retract(R, -by_frame[:, 4:]))
    return Point(numbers, point.alpha - float(step[-1]))


def _tangent_gradient(evaluation: Evaluation) -> Array:
    """(7 n + 1,): by [t, own scale, right perturbation of R] of each frame, and alpha."""
    point = evaluation.point
    n = len(point.numbers)
    gradient = evaluation.gradient[:-1].reshape(n, 13)
    turning = np.matmul(tangent_basis(point.rotations).transpose(0, 2, 1), gradient[:, 4:, None])[:, :, 0]
    return np.append(np.c_[gradient[:, :4], turning].ravel(), evaluation.gradient[-1])
