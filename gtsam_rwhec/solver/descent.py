"""Riemannian second-order descent on SO(3)^n for f(R) = x' Q' x, with Q' as a matrix or by its graph.

This is Newton's method on the manifold. It is damped (Levenberg) where the Hessian is not positive definite or the step
does not descend.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rwhec_factors.se3 import so3_nearest

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.moments import ONE, R_A
from gtsam_rwhec.solver.block_matrix import BlockFactor, BlockMatrix
from gtsam_rwhec.solver.graph_form import GraphForm
from gtsam_rwhec.solver.parts import Part, connected_components
from gtsam_rwhec.solver.reduced_form import ReducedForm
from gtsam_rwhec.solver.rotations import retract, tangent_basis, unvec, vec

#: The reduced form in which answers are searched: Q' as a matrix, or as products over the graph.
SearchForm = ReducedForm | GraphForm


@dataclass(frozen=True)
class Descent:
    """The end of a descent: rotations (n, 3, 3), cost, iterations, whether it converged."""

    R: Array
    cost: float
    iterations: int
    converged: bool


def homogeneous(R: Array) -> Array:
    """x = [vec R_1, ..., vec R_n, 1]."""
    return np.append(vec(R), 1.0)


def cost_of(form: SearchForm, R: Array) -> float:
    """x' Q' x."""
    x = homogeneous(R)
    return float(x @ form.apply(x))


def descend(form: SearchForm, R: Array, max_iterations: int) -> Descent:
    """Go down from R (n, 3, 3) to a critical point."""
    x = homogeneous(R)
    q = form.apply(x)
    cost = float(x @ q)
    if len(R) == 0:  # every frame is fixed
        return Descent(R, cost, 0, converged=True)
    rounding = 1e-15 * max(form.magnitude, 1e-300)
    floor = max(1e-9 * form.magnitude / form.size, 1e-290)  # a form of motions at rest is zero
    damping = 0.0
    for iteration in range(max_iterations):
        basis = tangent_basis(R)
        gradient = np.matmul(basis.transpose(0, 2, 1), q[:-1].reshape(-1, 9, 1))  # half of the gradient, (n, 3, 1)
        newton = form.newton(R, basis, q)
        while True:
            step = newton(gradient[:, :, 0], damping)
            if step is not None:
                decrease = -float((step * gradient[:, :, 0]).sum())  # predicted decrease, nearly
                length = float(np.abs(step).max(initial=0.0))
                if length < 2.0:
                    candidate = retract(R, step)
                    x_new = homogeneous(candidate)
                    q_new = form.apply(x_new)
                    cost_new = float(x_new @ q_new)
                    # Close to the end the cost is flat up to rounding: a short Newton step is accepted as it is.
                    if cost_new <= cost + max(rounding, 1e-14 * abs(cost)) or length < 1e-7:
                        break
            damping = max(4.0 * damping, floor)
            if not damping <= 1e6 * form.magnitude:
                return Descent(R, cost, iteration, converged=False)
        R, x, q, cost = candidate, x_new, q_new, cost_new
        damping = 0.0 if damping <= floor else damping / 8.0
        if (length < 1e-9 or decrease < 1e-2 * rounding) and damping <= floor:
            return Descent(R, cost, iteration + 1, converged=True)
    return Descent(R, cost, max_iterations, converged=False)


#: This fraction of the diagonal is added to the form, because exact data make it singular.
SHIFT = 1e-9
#: The most inverse iterations, and the change of the unit vector below which they end: a rough start is enough.
ITERATIONS, SMALL = 40, 1e-3
#: Number of inverse iterations with the whole Q'.
FEW_ITERATIONS = 8


def spectral_start(part: Part, rotation: BlockMatrix) -> list[Array]:
    """Rotations that minimise the rotation residuals over all matrices, projected to SO(3); (n, 3, 3) each.

    ``rotation`` is the form of these residuals, 9 numbers a frame and the tail [alpha, h]. With exact data the
    minimisers are a line through the truth (Corollary 2), so the smallest eigenvector, with each frame in units of its
    own diagonal, is the truth up to its sign. Known frames and priors add terms with h; then both signs are returned,
    and the cost decides.
    """
    n, of_h = len(rotation.frames), rotation.tails[:, :, 1:]
    if n == 0:  # every rotation is known
        return [np.zeros((0, 3, 3))]
    is_anchored = bool(of_h.any())
    tail = rotation.tail[1:, 1:] if is_anchored else np.ones((1, 1))
    matrix = BlockMatrix(rotation.order, rotation.frames, rotation.couplings, of_h, tail)
    weights = np.maximum(np.einsum("nii->n", rotation.frames) / 9.0, 1e-290)
    weight = np.append(np.repeat(weights, 9), max(float(tail[0, 0]), 1e-290))
    factor = matrix.plus(SHIFT * weight).factor()
    if factor is None:
        return [np.tile(np.eye(3), (n, 1, 1))]
    if is_anchored:
        r = _smallest(factor, weight, np.ones(matrix.size))
        return [so3_nearest(unvec(sign * r[:-1])) for sign in (1.0, -1.0)]
    # Components that only the shared scale joins each have an eigenvector and a sign; those of known frames have none.
    r = np.zeros(9 * n)
    place = {name: i for i, name in enumerate(part.free)}
    for names in connected_components(part.pairs) if part.scale == "shared" else [list(part.free)]:
        members = np.array([place[name] for name in names if name in place], dtype=int)
        if not members.size:
            continue
        begin = np.zeros((n, 9))
        begin[members] = np.random.default_rng(0).standard_normal((len(members), 9))
        v = _smallest(factor, weight, np.append(begin.ravel(), 0.0))[:-1]
        r += v * _handedness(v)
    return [so3_nearest(unvec(r))]


def unconstrained_start(form: SearchForm) -> list[Array]:
    """Minimisers of x'Q'x over all matrices: with h = 1 where Q' has linear terms, and the smallest eigenvector.

    Q' has the translation residuals too, so these starts can be better where rotations alone are poorly excited.
    """
    solved = form.solver(1e-12 * form.magnitude) if form.rotations else None
    if solved is None:
        return []
    linear = form.apply(np.append(np.zeros(form.size - 1), 1.0))[:-1]
    candidates = [solved(-linear)] if linear.any() else []
    v: Array = np.ones(form.size - 1)
    for _ in range(FEW_ITERATIONS):
        v = solved(v)
        v /= np.linalg.norm(v)
    candidates.append(v * _handedness(v))
    return [so3_nearest(unvec(r)) for r in candidates]


def mirrored(part: Part, R: Array) -> Array:
    """Rotations (n, 3, 3) of the form's variables after a half turn of all frames about the motions' main axis.

    The mirror image costs the same when the motion is planar and the scale unknown. Let every A turn about one axis
    (u_s in the sensor carrier, u_t in the target carrier, A u_t = u_s) and translate at right angles to it. Then each
    residual is a component along the axis plus an independent one at right angles to it. A half turn of all frames
    about the axis changes the sign of the second one, and so does a negative scale: (H R, -alpha) and (R, alpha) cost
    the same. Both have det R = 1, but only one of them has a positive scale.
    """
    sums = part.moments.entries(R_A, np.array([ONE])).reshape(-1, 3, 3).transpose(0, 2, 1)
    still = ~part.moments.motion
    if still.any():
        U, _, Vt = np.linalg.svd(sums[still].sum(axis=0))
        of_sensor, of_target = U[:, 0], Vt[0]
    else:  # both ends of a motion are the sensor's carrier
        turned = sums.sum(axis=0)
        of_sensor = of_target = np.linalg.eigh(turned + turned.T)[1][:, -1]
    axes = np.array([of_target if name in part.targets else of_sensor for name in part.free])
    half_turns = 2.0 * axes[:, :, None] * axes[:, None, :] - np.eye(3)
    result: Array = half_turns @ R if part.kind == "direct" else R @ half_turns
    return result


def _smallest(factor: BlockFactor, weight: Array, v: Array) -> Array:
    """The smallest eigenvector with a part in ``v``, in the metric diag(``weight``), by inverse iteration."""
    v = v / np.sqrt(float(weight @ v**2))
    for _ in range(ITERATIONS):
        after = factor.solve_vector(weight * v)
        after /= np.sqrt(float(weight @ after**2))
        change = np.sqrt(float(weight @ (after - v) ** 2))
        v = after
        if change < SMALL:
            break
    return v


def _handedness(r: Array) -> float:
    """+1 or -1, so that the blocks of r are right-handed (design fact 5)."""
    return 1.0 if float(np.sign(np.linalg.det(unvec(r))).sum()) >= 0.0 else -1.0
