"""Riemannian second-order descent on SO(3)^n for f(R) = x' Q' x, with Q' as an arrow or by its graph.

This is Newton's method on the manifold. It is damped (Levenberg) where the Hessian is not positive definite or the step
does not descend. A step needs one factorisation, of an arrow with 3 x 3 leaves or of what follows the graph.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver import arrow
from gtsam_rwhec.solver.graph_form import GraphForm
from gtsam_rwhec.solver.reduced_form import ReducedForm
from gtsam_rwhec.solver.rotations import retract, tangent_basis, unvec, vec

#: What a search looks for answers in: Q' as an arrow, or as a product that follows the graph.
SearchForm = ReducedForm | GraphForm

_I3 = np.eye(3)


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
    rounding = 1e-15 * max(form.magnitude, 1e-300)
    floor = max(1e-9 * form.magnitude / form.size, 1e-290)  # a form of motions at rest is zero
    damping = 0.0
    for iteration in range(max_iterations):
        basis = tangent_basis(R)
        gradient = np.matmul(basis.transpose(0, 2, 1), q[:-1].reshape(-1, 9, 1))  # half of the gradient, (n, 3, 1)
        hessian = form.hessian(R, basis, q) if isinstance(form, GraphForm) else ArrowHessian.of(form, R, basis, q)
        while True:
            step = hessian.step(gradient[:, :, 0], damping)
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


@dataclass(frozen=True)
class ArrowHessian:
    """Half the Riemannian Hessian, basis' Q' basis + sym(M) - tr(M) I with M_i = G_i' R_i, as arrow minus low rank."""

    leaf: Array
    coupling: Array
    border: Array
    G_leaf: Array
    G_border: Array

    @staticmethod
    def of(form: ReducedForm, R: Array, basis: Array, q: Array) -> ArrowHessian:
        """At R (n, 3, 3), with its tangents' basis (n, 9, 3) and q = Q' x."""
        L, n = form.leaves, form.rotations
        P = n - L
        M = unvec(q[:-1]).transpose(0, 2, 1) @ R
        trace = np.einsum("nii->n", M)
        curvature = 0.5 * (M + M.transpose(0, 2, 1)) - trace[:, None, None] * _I3
        leaf_basis, center_basis = basis[:L], basis[L:]
        leaf_transposed = leaf_basis.transpose(0, 2, 1)
        D = leaf_transposed @ form.D @ leaf_basis + curvature[:L]
        half = np.matmul(leaf_transposed, form.C[:, :, :-1])  # (L, 3, 9 P)
        C = np.einsum("lapj,pjk->lapk", half.reshape(L, 3, P, 9), center_basis).reshape(L, 3, 3 * P)
        rows = np.matmul(center_basis.transpose(0, 2, 1), form.E[:-1, :-1].reshape(P, 9, 9 * P)).reshape(3 * P, P, 9)
        E = np.matmul(rows.transpose(1, 0, 2), center_basis).transpose(1, 0, 2).reshape(3 * P, 3 * P)
        for p in range(P):
            E[3 * p : 3 * p + 3, 3 * p : 3 * p + 3] += curvature[L + p]
        k = len(form.G)
        G_leaf = np.matmul(form.G_leaf.transpose(1, 0, 2), leaf_basis).transpose(1, 0, 2)
        G_border = np.matmul(form.G_border[:, :-1].reshape(k, P, 9).transpose(1, 0, 2), center_basis)
        return ArrowHessian(D, C, E, G_leaf, G_border.transpose(1, 0, 2).reshape(k, 3 * P))

    def step(self, gradient: Array, damping: float) -> Array | None:
        """Newton's step (n, 3) for half the gradient (n, 3); None where the Hessian is not positive definite."""
        L, b = len(self.leaf), len(self.border)
        wide, square = arrow.with_low_rank(self.coupling, self.border, self.G_leaf, self.G_border)
        if damping:
            at = np.arange(b)
            square[at, at] += damping
        factor = arrow.cholesky(self.leaf + damping * _I3 if damping else self.leaf, wide, square)
        if factor is None:
            return None
        right = np.concatenate([gradient[L:].reshape(-1, 1), np.zeros((len(self.G_border), 1))])
        leaf, rest = factor.solve(gradient[:L, :, None], right)
        step: Array = -np.concatenate([leaf.reshape(-1, 3), rest[:b].reshape(-1, 3)])
        return step
