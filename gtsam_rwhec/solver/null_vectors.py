"""Directions that the measurements leave free, and the exact products of the Lagrangian's Z with them.

A free direction is an eigenvector of Z with an eigenvalue of zero, up to rounding. The moments do not show how near to
zero it is, but the raw measurements do: their residuals along such a direction are zero up to the last digit of the
measurements, so the form's product with it is known without cancellation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import fsum

import numpy as np
import scipy.linalg

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.rounding import gamma
from gtsam_rwhec.solver.answers import Action, Evaluation
from gtsam_rwhec.solver.curvature import Curvature
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.rotations import CONSTRAINTS, WITH_CONSTANT, multiplier_blocks

#: Eigenvalues up to this many times the test's allowance for rounding count as zero.
REACH = 100.0
#: With a unit diagonal, smaller eigenvalues count as zero in any case.
SMALLEST = 1e-10
#: A variable counts as undetermined where its rounding is more than this part of its diagonal entry.
UNDETERMINED = 1e-3
#: Such a variable gets a unit in which its diagonal entry is about this small: it is a null vector of its own.
LOWERED = 1e-12
#: Entries of rotations are limited, translations are not. So a rotation's entry is held, unless it is this much
#: smaller.
PREFERENCE = 1e3
#: From moments, products with a free direction are known up to about this fraction of the terms that cancel in them.
ROUNDING_OF_MOMENTS = 2.0**-44
#: The vectors are corrected at most this many times, by their products computed from the raw measurements.
CORRECTIONS = 8
#: With more vectors than this, a correction takes long, and only one is made.
MANY = 16
#: Corrections continue while each one makes the form's products with the vectors smaller by this factor.
SMALLER = 0.3


@dataclass(frozen=True)
class NullVectors:
    """k directions V, each 1 at its own held variable and 0 at the others', and their products with Z and the gradient.

    held (k,), V (N, k); ZV (N, k), Vg (k,) and VZV (k, k), each with a bound on its error.
    """

    held: np.ndarray
    V: Array
    ZV: Array
    ZV_error: Array
    Vg: Array
    Vg_error: Array
    VZV: Array
    VZV_error: Array

    @staticmethod
    def none(size: int) -> NullVectors:
        """No direction."""
        held, nothing, columns, square = np.zeros(0, dtype=int), np.zeros(0), np.zeros((size, 0)), np.zeros((0, 0))
        return NullVectors(held, columns, columns, columns, nothing, nothing, square, square)

    def without_errors(self) -> NullVectors:
        """The same, as if nothing had been rounded."""
        errors = {name: np.zeros_like(getattr(self, name)) for name in ("ZV_error", "Vg_error", "VZV_error")}
        return replace(self, **errors)


def point_as_null_vector(
    evaluation: Evaluation, multipliers: Array, value: float, value_error: float, g: Array, g_error: Array
) -> NullVectors | None:
    """The point itself: where nothing couples to h, Z x is the gradient, and x'Z x the value less its constant part."""
    numbers = evaluation.point.numbers
    rotations = numbers[:, 4:]
    if not rotations.any():
        return None
    frame, entry = np.unravel_index(int(np.abs(rotations).argmax()), rotations.shape)
    x = float(rotations[frame, entry])
    constant = multipliers[:, WITH_CONSTANT]
    along = fsum([value, *(-constant).ravel().tolist()])  # without rounding but in the result: large multipliers cancel
    error = value_error + gamma(2) * abs(along)
    grown = 1.0 + 1e-12
    return NullVectors(
        np.array([13 * frame + 4 + entry]),
        np.append(numbers.ravel(), evaluation.point.alpha)[:, None] / x,
        (g / x)[:, None],
        (g_error / abs(x) * grown + gamma(2) * np.abs(g / x))[:, None],
        np.array([along / x]),
        np.array([error / abs(x) * grown]),
        np.array([[along / x**2]]),
        np.array([[error / x**2 * grown]]),
    )


def free_vectors(
    form: PartForm,
    evaluation: Evaluation,
    multipliers: Array,
    Z: Curvature,
    of_scale: float,
    slack: float = 0.0,
    *,
    by_rounding: bool = True,
) -> tuple[NullVectors, Array] | None:
    """The null vectors of Z; None where Z has none, or a negative eigenvalue.

    Z includes ``slack`` on the diagonal of rotations. With ``by_rounding``, every variable's unit is lowered by its
    rounding: this finds more vectors with extreme weights. Without it, only undetermined variables have such a unit.
    The second result is the multipliers (n, 20), changed so that the gradient vanishes along the vectors. With the
    given ones it does not, as the point is rounded.
    """
    scale = np.abs(form.curvature.diagonal)
    undetermined = Z.rounding > UNDETERMINED * scale
    lowered = scale + Z.rounding / LOWERED if by_rounding else np.where(undetermined, Z.rounding / LOWERED, scale)
    unit = 1.0 / np.sqrt(np.maximum(lowered, 1e-290))
    allowance = float((Z.allowance(scale) * unit**2).max())
    zero = max(REACH * allowance, SMALLEST)
    values, vectors = Z.weakest(unit, zero)
    if len(values) == 0 or values[0] < -zero:
        return None
    prefer = np.where(Z.is_rotation, PREFERENCE, 1.0)
    held = scipy.linalg.qr(vectors.T * prefer, mode="economic", pivoting=True)[2][: len(values)]
    V = unit[:, None] * vectors
    V = V @ np.linalg.inv(V[held])
    factor = Z.with_held(held).factor()
    if factor is None:
        return None
    turns = Z.is_rotation[held]
    before = np.inf
    corrections = CORRECTIONS if len(held) <= MANY else 1
    for correction in range(corrections + 1):
        V[held] = np.eye(len(held))
        action = form.cost.action(evaluation, V)
        nulls = _with_multipliers(action, evaluation, multipliers, V, held, of_scale, slack)
        rest = np.where(np.isin(np.arange(len(V)), held)[:, None], 0.0, nulls.ZV)
        size = float(((unit[:, None] * rest) ** 2).sum())
        if correction == corrections or size > SMALLER * before:
            break
        before = size
        V = V - np.column_stack([factor.solve_vector(column) for column in rest.T])
    multipliers = stationary_along(V[:, turns], nulls.Vg[turns], evaluation, multipliers)
    return _with_multipliers(action, evaluation, multipliers, V, held, of_scale, slack), multipliers


def stationary_along(V: Array, Vg: Array, evaluation: Evaluation, multipliers: Array) -> Array:
    """The multipliers nearest to the given ones for which V'g = 0; only constraints that have multipliers get more."""
    n = len(multipliers)
    if V.shape[1] == 0:
        return multipliers
    x = np.c_[evaluation.point.numbers[:, 4:], np.ones(n)]
    r = V[:-1].reshape(n, 13, -1)[:, 4:]
    of_constraints = np.einsum("nik,qij,nj->knq", r, CONSTRAINTS[:, :9], x)
    of_constraints[:, :, ~(multipliers.any(axis=0) | (np.arange(20) < 6))] = 0.0
    change = np.linalg.lstsq(of_constraints.reshape(len(Vg), -1), Vg, rcond=1e-9)[0]
    result: Array = multipliers + change.reshape(n, 20)
    return result


def _with_multipliers(
    action: Action,
    evaluation: Evaluation,
    multipliers: Array,
    V: Array,
    held: np.ndarray,
    of_scale: float,
    slack: float,
) -> NullVectors:
    """The products of Z = Q - Lambda + slack with V, from those of Q."""
    n, k = len(multipliers), V.shape[1]
    Lambda, size = multiplier_blocks(multipliers)
    r = V[:-1].reshape(n, 13, k)[:, 4:]
    x = np.c_[evaluation.point.numbers[:, 4:], np.ones(n)]
    of_V = np.einsum("nij,njk->nik", Lambda[:, :9, :9], r) - slack * r
    of_V_size = np.einsum("nij,njk->nik", size[:, :9, :9], np.abs(r)) + slack * np.abs(r)
    of_x = np.einsum("nij,nj->ni", Lambda[:, :9], x)
    of_x_size = np.einsum("nij,nj->ni", size[:, :9], np.abs(x))
    ZV, ZV_error = action.QV.copy(), action.QV_error.copy()
    ZV[:-1].reshape(n, 13, k)[:, 4:] -= of_V
    ZV_error[:-1].reshape(n, 13, k)[:, 4:] += gamma(40) * of_V_size
    few, many = gamma(40), gamma(9 * n + 48)
    Vg = action.VQx - np.einsum("nik,ni->k", r, of_x) - 0.5 * of_scale * V[-1]
    Vg_error = action.VQx_error + many * np.einsum("nik,ni->k", np.abs(r), of_x_size)
    Vg_error += few * (np.abs(Vg) + abs(of_scale) * np.abs(V[-1]))
    VZV = action.VQV - np.einsum("nik,nil->kl", r, of_V)
    VZV_error = action.VQV_error + many * np.einsum("nik,nil->kl", np.abs(r), of_V_size) + few * np.abs(VZV)
    if action.sizes is not None:
        # Moments are known only up to their rounding: within it, their form may even be negative.
        of_QV, of_VQV, of_VQx = action.sizes
        of_ZV = of_QV.copy()
        of_ZV[:-1].reshape(n, 13, k)[:, 4:] += of_V_size
        of_VZV = of_VQV + np.einsum("nik,nil->kl", np.abs(r), of_V_size)
        of_Vg = of_VQx + np.einsum("nik,ni->k", np.abs(r), of_x_size)
        for value, error, terms in ((ZV, ZV_error, of_ZV), (VZV, VZV_error, of_VZV), (Vg, Vg_error, of_Vg)):
            nothing = np.abs(value) <= ROUNDING_OF_MOMENTS * terms
            value[nothing] = error[nothing] = 0.0
    return NullVectors(held, V, ZV, ZV_error + gamma(2) * np.abs(ZV), Vg, Vg_error, VZV, VZV_error)
