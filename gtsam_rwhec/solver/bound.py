"""A lower bound on the optimum of a reduced form, from any multipliers. It is rigorous in floating point.

Let y = [vec R_1, ..., vec R_n, 1] be feasible and Z = Q' - Lambda for any multipliers. Then y'Q'y = y'Z y, because each
constraint is zero at y. Write y = x + [z, 0] for any x whose last entry is 1::

    y' Z y = x' Z x + 2 g' z + z' Z_rr z,      g = (Z x) without its last entry

If Z_rr >= diag(m) with m > 0, the right side is at least x' Z x - sum g^2 / m. This is the dual certificate of design
fact 3 without its null vector, so rounding errors do not decide the test of definiteness. Free directions, or no
certificate, leave only Z_rr >= -diag(m). Then |z_i| <= sqrt(3) + |r_i| for each rotation bounds the loss.

With an unknown scale nothing couples to h: (R, alpha) and (-R, -alpha) cost the same, and r itself is a null vector of
Z_rr. Then an entry j of r takes the role of h: y_r = a r + z with z_j = 0 and a = y_j / r_j, |a| <= 1 / |r_j|.

Z_rr is singular where an answer is free or has a twin. ``deflation`` removes the null directions first and loses almost
nothing. The verified test of all of Z_rr would lose the whole allowance.

x'Zx and g are evaluated in extended precision, with a bound on their rounding; ``verified`` tests the definiteness.
The bound is a true bound on the optimum of the stored D, C, E, G of ``ReducedForm``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver import arrow
from gtsam_rwhec.solver.deflation import deflated_eigenvalue
from gtsam_rwhec.solver.lagrangian import Wide, lagrangian
from gtsam_rwhec.solver.reduced_form import ReducedForm
from gtsam_rwhec.solver.rotations import CONSTRAINTS_FLAT
from gtsam_rwhec.solver.verified import UNIT, arrow_is_positive_definite, cholesky_allowance, gamma

#: Above this size Lanczos finds the eigenvalue of a failed certificate; below it, a dense decomposition does.
DENSE_EIGEN_SIZE = 700
#: Each margin of definiteness is this factor times the one tried before; a power of two does not round.
MORE_ROOM = 16.0


@dataclass(frozen=True)
class Bound:
    """A rigorous lower bound, and what was proven about Z for it; ``Bound()`` claims nothing."""

    lower_bound: float = -np.inf  #: never above the optimum of the stored reduced form
    value: float = -np.inf  #: x' Z x, without any allowance: the bound in exact arithmetic if Z_rr is positive definite
    #: Whether Z_rr (without one entry, for an unknown scale) is proven positive definite: the optimum is unique.
    definite: bool = False
    semidefinite: bool = False  #: whether Z_rr is proven positive semidefinite up to rounding
    eigenvalue: float = -np.inf  #: a proven lower bound on the smallest eigenvalue of Z_rr
    direction: Array | None = None  #: (9 n,): an eigenvector of a negative eigenvalue of Z_rr, for a better start


def lower_bound(form: ReducedForm, multipliers: Array, r: Array) -> Bound:
    """The bound from multipliers (n, 20) and a point r (9 n,). It is true for any, and tight for optimal ones."""
    if not (np.isfinite(multipliers).all() and np.isfinite(r).all()):  # a solver failed
        return Bound()
    L, n = form.leaves, form.rotations
    value, z, value_error, z_error = lagrangian(form, multipliers, np.append(r, 1.0))
    g, g_error, constant = z[:-1], z_error[:-1], z[-1]
    reach = np.abs(g.astype(float)) * (1.0 + 4.0 * UNIT) + g_error  # |g|, entry by entry, rounded up

    D, C, E, rounded = _curvature(form, multipliers)
    k, b = len(form.G), len(E)
    wide, square = arrow.with_low_rank(C, E, form.G_leaf, form.G_border[:, :-1])
    size = 9 * n + k
    leaf_diagonal, border_diagonal = np.einsum("lii->li", D), np.diagonal(E)
    leaf_unit = cholesky_allowance(leaf_diagonal, size) + rounded[: 9 * L].reshape(L, 9)
    border_unit = cholesky_allowance(border_diagonal, size) + rounded[9 * L :]
    rows_margin = np.zeros(k)

    def proven(leaf_margin: Array, border_margin: Array, pin: int | None = None) -> bool:
        """Whether Z_rr, without the border's row and column ``pin``, exceeds the margins."""
        margin = np.r_[border_margin + rounded[9 * L :], rows_margin]
        keep = np.delete(np.arange(b + k), pin) if pin is not None else slice(None)
        return arrow_is_positive_definite(
            D, wide[:, :, keep], square[keep][:, keep], leaf_margin + rounded[: 9 * L].reshape(L, 9), margin[keep]
        )

    pin, reach_of_a = None, 1.0
    if _is_homogeneous(form, multipliers) and r[9 * L :].any():
        pin = int(np.abs(r[9 * L :]).argmax())
        # Rotations have entries of at most 1.
        reach_of_a = float(1.0 / r[9 * L + pin] ** 2) * (1.0 + 1e-10)
    # z_i = vec R_i - r_i of a rotation R_i, so |z_i| <= sqrt(3) + |r_i|.
    size_z = np.sqrt(3.0) + np.linalg.norm(r.reshape(n, 9), axis=1)
    of_g = float((2.0 * np.linalg.norm(reach.reshape(n, 9), axis=1) * size_z).sum()) * (1.0 + 1e-10)
    if proven(leaf_unit, border_unit, pin):
        room = np.r_[leaf_unit.ravel(), border_unit]
        by_room = float((reach**2 / room).sum()) * (1.0 + 1e-10)
        by_size = of_g if pin is None else np.inf  # better with a large g and little room: z'Z_rr z >= 0
        # Each try needs a factorisation: it is worth it only if the bound loses enough to g.
        more = MORE_ROOM
        while min(by_room, by_size) > 1e-9 * abs(float(value)) + 1e-17 * size * form.magnitude:
            if not proven(more * leaf_unit, more * border_unit, pin):
                break
            room, by_room, more = MORE_ROOM * room, by_room / MORE_ROOM, MORE_ROOM * more
        loss = min(by_room, by_size)
        if pin is None:
            lower = value - Wide(value_error) - Wide(loss)
        else:
            # y'Zy = constant + a^2 (r'Z_rr r) + ..., and the constant is the last entry of Z x.
            negative = max(0.0, float(constant - value + Wide(value_error) + Wide(loss)))
            lower = constant - Wide(value_error) - Wide(negative * reach_of_a * (1.0 + 1e-10))
        return Bound(_round_down(lower), float(value), True, True, float(room.min(initial=np.inf)), None)

    smallest, direction = 0.0, None
    # Half of this is what the factorisation itself asks for.
    slack_leaf, slack_border = 2.0 * leaf_unit, 2.0 * border_unit
    semidefinite = proven(-slack_leaf, -slack_border)
    if not semidefinite:
        smallest, direction = _smallest_eigenpair(D, C, E, form)
        extra = 1.01 * max(-smallest, 0.0)
        for _ in range(60):
            slack_leaf, slack_border = leaf_unit + extra, border_unit + extra
            if proven(-slack_leaf, -slack_border):
                break
            extra = 1.5 * extra + 4.0 * float(max(leaf_unit.max(initial=0.0), border_unit.max(initial=0.0)))
        else:  # the estimate of the eigenvalue is wrong by 1.5^60: claim nothing
            return Bound(value=float(value), direction=direction)
    slack = np.r_[slack_leaf.ravel(), slack_border].reshape(n, 9)
    loss = float((slack.max(axis=1) * size_z**2).sum())
    if semidefinite and 9 * n <= DENSE_EIGEN_SIZE:
        below = deflated_eigenvalue(form, multipliers, arrow.dense(D, C, E), rounded, slack)
        loss = min(loss, max(-below, 0.0) * float((size_z**2).sum()))
    loss = (loss + of_g) * (1.0 + 1e-10)
    lower = _round_down(value - Wide(value_error) - Wide(loss))
    return Bound(lower, float(value), False, semidefinite, -float(slack.max()), None if semidefinite else direction)


def _is_homogeneous(form: ReducedForm, multipliers: Array) -> bool:
    """Whether nothing couples to h: an unknown scale, no known frames or priors, no handedness multipliers."""
    coupled = multipliers[:, 11:].any() or form.C[:, :, -1].any() or form.E[-1, :-1].any() or form.G[:, -1].any()
    return not coupled


def exact_value(form: ReducedForm, x: Array) -> tuple[float, float]:
    """x' Q' x in extended precision, and a bound on its rounding error."""
    value, _, error, _ = lagrangian(form, np.zeros((form.rotations, 20)), x)
    return float(value), error + UNIT * abs(float(value))


def _round_down(value: Any) -> float:
    return float(np.nextafter(float(value), -np.inf))


def _curvature(form: ReducedForm, multipliers: Array) -> tuple[Array, Array, Array, Array]:
    """Z_rr before G'G is subtracted, as arrow (D, C, E); last, a diagonal (9 n,) that dominates its rounding."""
    L, n = form.leaves, form.rotations
    Lambda = (multipliers @ CONSTRAINTS_FLAT).reshape(n, 10, 10)[:, :9, :9]
    size = (np.abs(multipliers) @ np.abs(CONSTRAINTS_FLAT)).reshape(n, 10, 10)[:, :9, :9].copy()
    D = form.D - Lambda[:L]
    E = form.E[:-1, :-1].copy()
    size[:L] += np.abs(form.D)
    for p in range(n - L):
        block = slice(9 * p, 9 * p + 9)
        size[L + p] += np.abs(E[block, block])
        E[block, block] -= Lambda[L + p]
    # Each entry sums at most 20 products (exact, as the constraints' entries are integers) and one subtraction.
    rounded = gamma(22) * size.sum(axis=2).ravel()
    return D, form.C[:, :, :-1], E, rounded


def _smallest_eigenpair(D: Array, C: Array, E: Array, form: ReducedForm) -> tuple[float, Array]:
    """Smallest eigenvalue of arrow(D, C, E) - G'G and its vector; an estimate."""
    size = len(form.G.T) - 1
    G = form.G[:, :-1]
    if size <= DENSE_EIGEN_SIZE:
        matrix = arrow.dense(D, C, E) - G.T @ G
        values, vectors = scipy.linalg.eigh(matrix, subset_by_index=[0, 0], check_finite=False)
        return float(values[0]), vectors[:, 0]
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh  # slow to import, few problems need it

    split = 9 * form.leaves
    wide = C.reshape(split, -1)

    def apply(v: Array) -> Array:
        v = v.ravel()
        leaf = np.matmul(D, v[:split].reshape(-1, 9, 1)).ravel() + wide @ v[split:]
        result: Array = np.r_[leaf, wide.T @ v[:split] + E @ v[split:]] - G.T @ (G @ v)
        return result

    operator = LinearOperator((size, size), matvec=apply, dtype=np.float64)
    start = np.random.default_rng(0).standard_normal(size)
    try:
        values, vectors = eigsh(operator, k=1, which="SA", v0=start, tol=1e-6, maxiter=2000)
        return float(values[0]), vectors[:, 0]
    except ArpackNoConvergence as stopped:
        if len(stopped.eigenvalues):
            return float(stopped.eigenvalues[0]), np.real(stopped.eigenvectors[:, 0])
        return -form.magnitude, start / np.linalg.norm(start)
