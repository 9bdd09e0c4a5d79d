"""Newton steps on the cost of the raw measurements, from an answer that the moments gave.

Where weights are extreme, or the origin far, moments hold fewer digits of the optimum than the measurements do. The
gradient comes from the measurements, the second derivative from the moments.
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver import arrow
from gtsam_rwhec.solver.curvature import Curvature
from gtsam_rwhec.solver.point import Evaluation, Point
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
    n, L = len(R), curvature.leaves
    gradient = evaluation.gradient[:-1].reshape(n, 13)[:, 4:]
    Z = curvature.less(kkt_multipliers(R, gradient))
    T = np.zeros((n, 13, 7))
    T[:, :4, :4] = np.eye(4)
    T[:, 4:, 4:] = tangent_basis(R)
    Tt = T.transpose(0, 2, 1)
    P = n - L
    leaf = Tt[:L] @ Z.leaf @ T[:L]
    coupling = np.empty((L, 7, 7 * P + 1))
    half = Tt[:L] @ Z.coupling
    coupling[:, :, -1] = half[:, :, -1]
    by_center = half[:, :, :-1].reshape(L, 7, P, 13)
    coupling[:, :, :-1] = np.einsum("lapj,pjb->lapb", by_center, T[L:]).reshape(L, 7, 7 * P)
    wide = np.zeros((13 * P + 1, 7 * P + 1))
    for p in range(P):
        wide[13 * p : 13 * p + 13, 7 * p : 7 * p + 7] = T[L + p]
    wide[-1, -1] = 1.0
    border = wide.T @ Z.border @ wide
    factor = arrow.cholesky(leaf, coupling, border)
    if factor is None:
        np.einsum("lii->li", leaf)[...] *= 1.0 + DAMPING
        np.einsum("ii->i", border)[...] *= 1.0 + DAMPING
        factor = arrow.cholesky(leaf, coupling, border)
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
