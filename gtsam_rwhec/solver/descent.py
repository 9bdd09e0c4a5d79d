"""Riemannian second-order descent on SO(3)^n for f(R) = x' Q' x, with Q' as a matrix or by its graph.

This is Newton's method on the manifold. It is damped (Levenberg) where the Hessian is not positive definite or the step
does not descend.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.graph_form import GraphForm
from gtsam_rwhec.solver.reduced_form import ReducedForm
from gtsam_rwhec.solver.rotations import retract, tangent_basis, vec

#: What a search looks for answers in: Q' as a matrix, or as a product that follows the graph.
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
