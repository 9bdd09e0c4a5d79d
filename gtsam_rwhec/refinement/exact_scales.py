"""From the optimum of the inverse equation to that of the physical one, where scales are the targets' own.

With a scale for each target the certified form is C X'_j = Y'_k A (DESIGN fact 7): what noise does to the measured
rotation acts on a lever arm there, and its optimum's physical residuals are larger than sigma says. Outliers are told
by physical residuals, so on the way each fit is carried over by Gauss-Newton on

    1/2 sum |alpha_j (R_A t_X + t_A - t_Y) - R_Y t_B|^2 / sigma^2 + kappa |R_A R_X - R_Y R_B|_F^2,

from the same moments: for each pair it is the 25 x 25 form at x = [alpha t_X, alpha t_Y, alpha, vec R_X, vec R_Y].
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.moments import edge_forms
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.residuals import PairPoses
from gtsam_rwhec.solver.rotations import vec
from gtsam_rwhec.solver.variables import Answer

MAX_STEPS = 30
#: Steps shorter than this (rad, m) end it.
SHORTEST = 1e-10
#: Damping to begin with, a share of the Hessian's diagonal.
DAMPING = 1e-6
#: After a step that lowers the cost it is divided by this, after another multiplied.
DAMPING_CHANGE = 10.0
#: It may grow this often within a step.
TRIES = 12
#: [e_i]x, i = 0, 1, 2.
GENERATORS = np.array(
    [[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]],
    dtype=np.float64,
)


def with_exact_scales(part: Part, answer: Answer) -> Answer:
    """The nearest minimum of the physical cost, by damped Gauss-Newton; as given where a scale is not positive."""
    if part.kind == "direct" or not _scales_are_positive(part, answer):
        return answer
    forms = np.add(*edge_forms(part.moments.translation, part.moments.rotation, part.moments.kappa))
    cost, gradient, hessian = _expand(part, answer, forms)
    damping = DAMPING
    for _ in range(MAX_STEPS):
        for _ in range(TRIES):
            damped = hessian + damping * np.diag(np.maximum(np.diag(hessian), 1e-12 * np.diag(hessian).max()))
            step = -np.linalg.lstsq(damped, gradient, rcond=None)[0]
            moved = _moved(part, answer, step)
            new_cost, new_gradient, new_hessian = _expand(part, moved, forms)
            if new_cost <= cost:
                break
            damping *= DAMPING_CHANGE
        else:
            return answer
        answer, cost, gradient, hessian = moved, new_cost, new_gradient, new_hessian
        damping /= DAMPING_CHANGE
        if np.abs(step).max() < SHORTEST:
            break
    return answer


def _scales_are_positive(part: Part, answer: Answer) -> bool:
    own = answer.own_scale[[name in part.scale_owners for name in part.free]]
    return bool(np.isfinite(own).all() and (own > 0.0).all() and np.isfinite(answer.scale) and answer.scale > 0.0)


def _scale_column(part: Part, target: str) -> int | None:
    """Where the logarithm of a pair's alpha is among the unknowns."""
    first = 6 * len(part.free)
    if part.scale == "shared":
        return first
    return first + part.scale_owners.index(target) if target in part.scale_owners else None


def _number_of_unknowns(part: Part) -> int:
    return 6 * len(part.free) + (part.scale == "shared") + len(part.scale_owners)


def _expand(part: Part, answer: Answer, forms: Array) -> tuple[float, Array, Array]:
    """Cost, gradient and Gauss-Newton Hessian by [omega, v] of each free frame and log alpha."""
    size = _number_of_unknowns(part)
    gradient, hessian = np.zeros(size), np.zeros((size, size))
    poses = PairPoses.of(part, answer)
    cost = 0.0
    index = {name: i for i, name in enumerate(part.free)}
    for e, (target, sensor) in enumerate(part.pairs):
        alpha, Q = poses.alpha[e], forms[e]
        x = np.concatenate(
            [alpha * poses.t_X[e], alpha * poses.t_Y[e], [alpha], poses.R_X[e].T.ravel(), poses.R_Y[e].T.ravel()]
        )
        J = np.zeros((25, size))
        for name, R, rows_t, rows_R in (
            (target, poses.R_X[e], slice(0, 3), slice(7, 16)),
            (sensor, poses.R_Y[e], slice(3, 6), slice(16, 25)),
        ):
            if name in index:
                first = 6 * index[name]
                J[rows_R, first : first + 3] += vec(R @ GENERATORS).T
                J[rows_t, first + 3 : first + 6] += alpha * np.eye(3)
        column = _scale_column(part, target)
        if column is not None:
            J[:7, column] = x[:7]
        cost += float(x @ Q @ x)
        gradient += 2.0 * J.T @ (Q @ x)
        hessian += 2.0 * J.T @ Q @ J
    for name, beliefs in part.priors.items():
        if name not in index:
            continue
        i, first = index[name], 6 * index[name]
        J_R = vec(answer.R[i] @ GENERATORS).T
        for prior in beliefs:
            if prior.kappa is not None:
                r = (answer.R[i] - prior.transform[:3, :3]).T.ravel()
                cost += 0.5 * prior.kappa * float(r @ r)
                gradient[first : first + 3] += prior.kappa * J_R.T @ r
                hessian[first : first + 3, first : first + 3] += prior.kappa * J_R.T @ J_R
            if prior.sigma is not None:
                r = answer.t[i] - prior.transform[:3, 3]
                cost += 0.5 * float(r @ r) / prior.sigma**2
                gradient[first + 3 : first + 6] += r / prior.sigma**2
                hessian[first + 3 : first + 6, first + 3 : first + 6] += np.eye(3) / prior.sigma**2
    return cost, gradient, hessian


def _moved(part: Part, answer: Answer, step: Array) -> Answer:
    n = len(part.free)
    own_step = step[: 6 * n].reshape(n, 6)
    own_scale = answer.own_scale.copy()
    for i, name in enumerate(part.free):
        column = _scale_column(part, name) if name in part.scale_owners else None
        if column is not None:
            own_scale[i] *= np.exp(step[column])
    return replace(
        answer,
        R=answer.R @ Rotation.from_rotvec(own_step[:, :3]).as_matrix(),
        t=answer.t + own_step[:, 3:],
        own_scale=own_scale,
        scale=answer.scale * float(np.exp(step[6 * n])) if part.scale == "shared" else answer.scale,
    )
