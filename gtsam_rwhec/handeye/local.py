"""Nonlinear least squares: DQNLOpt and DQNLOptRnd on the cost (8), ChVecOpt and QuatVecOpt on the costs (30).

Each cost is a quadratic form in what a pose is written as, of the size of a few matrices whatever the number of
motions; factored as L'L it is a residual of 8 or 14 to 17 rows with the same cost, gradient and Gauss-Newton Hessian
as the residuals of all motions together. The unknowns are a quaternion p of any length (q = p / |p|) and a translation
in units of 1/alpha: no rotation is out of reach of any start.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import ROTATION, left, right
from gtsam_rwhec.handeye.chordal_form import chordal_moments, chordal_residuals
from gtsam_rwhec.handeye.degenerate import free_directions
from gtsam_rwhec.handeye.dual_quaternions import from_transforms, to_transform
from gtsam_rwhec.handeye.motion_costs import squared_residuals
from gtsam_rwhec.handeye.request import Request
from gtsam_rwhec.handeye.saddle import Minimum, minimum
from gtsam_rwhec.identifiability.free_directions import FreeDirection
from gtsam_rwhec.methods.estimate import Outcome

#: least_squares stops where a step changes cost or unknowns by less than this part of them: rounding.
STOP = 1e-15
#: Of a form of unit diagonal: what one entry's rounding leaves.
ROUNDING = float(np.finfo(np.float64).eps)
Vector = Callable[[Array], Array]


def dqnlopt(request: Request) -> Outcome[Array]:
    """DQNLOpt: descent on the cost (8) from DQOpt's answer, which it should not leave (Section 4.4)."""
    found = minimum(request.cost)
    return Outcome(descend_dual_quaternion(request, found.q, found.q_dual), free_directions=_free_at(request, found))


def dqnlopt_random(request: Request) -> Outcome[Array]:
    """DQNLOptRnd: descent on the cost (8) from a random pose; ends in local minima now and then (Table 1).

    The rotation is uniform; the translation normal, with the root mean square of the motions' own.
    """
    try:
        rng = np.random.default_rng(request.rng)
    except (TypeError, ValueError) as error:
        raise OptionError(
            f"rng={request.rng!r} is not a source of random numbers ({error}); give a numpy.random.Generator or a seed "
            "that is not negative"
        ) from error
    q = rng.normal(size=4)
    q /= np.linalg.norm(q)
    t = rng.normal(size=3) * _length(request)
    q_dual = 0.5 * left(np.append(t, 0.0)) @ q
    return Outcome(
        descend_dual_quaternion(request, q, q_dual), free_directions=_free_at(request, minimum(request.cost))
    )


def chvecopt(request: Request) -> Outcome[Array]:
    """ChVecOpt: |R_C R - R R_H|^2 + alpha^2 |(R_C - 1) T - R T_H + T_C|^2 (eq. 30, first), from DQOpt's answer.

    The paper leaves the start open. The cost is the certified one's, which proves its minimum (``certified``).
    """
    rotation, translation = chordal_moments(request.motions, request.weights)
    found = minimum(request.cost)
    X = _descend_vector(rotation, translation, request.alpha, found, quaternion_cost=False)
    of_R, of_T = chordal_residuals(request.motions, X, request.weights)
    return Outcome(
        X, cost=of_R + request.alpha**2 * of_T, cost_name="eq. 30, chordal", free_directions=_free_at(request, found)
    )


def quatvecopt(request: Request) -> Outcome[Array]:
    """QuatVecOpt: |q_C q - q q_H|^2 + alpha^2 |(R_C - 1) T - R T_H + T_C|^2 (eq. 30, second), from DQOpt's answer."""
    _, translation = chordal_moments(request.motions, request.weights)
    found = minimum(request.cost)
    AA = request.cost.M / request.alpha**2  # the sum of A'A
    X = _descend_vector(AA, translation, request.alpha, found, quaternion_cost=True)
    (q,), (q_dual,) = from_transforms(X[None])
    of_q, _ = squared_residuals(request.motions, q, q_dual, request.weights)
    _, of_T = chordal_residuals(request.motions, X, request.weights)
    return Outcome(
        X, cost=of_q + request.alpha**2 * of_T, cost_name="eq. 30, quaternion", free_directions=_free_at(request, found)
    )


def descend_dual_quaternion(request: Request, q: Array, q_dual: Array) -> Array:
    """Minimise the cost (8), prior included, from a dual quaternion; the pose (4, 4) where it ends."""
    cost = request.cost
    factor = root(np.block([[cost.S, cost.W], [cost.W.T, cost.M]]))
    unit = _unit(request)

    def poses(x: Array) -> tuple[Array, Array, Array]:
        length = float(np.linalg.norm(x[:4]))
        q = x[:4] / length
        pure = left(np.append(0.5 * unit * x[4:], 0.0))
        return q, pure, (np.eye(4) - np.outer(q, q)) / length

    def residual(x: Array) -> Array:
        q, pure, _ = poses(x)
        e: Array = factor @ np.concatenate([q, pure @ q])
        return e

    def jacobian(x: Array) -> Array:
        q, pure, slope = poses(x)
        J = np.zeros((8, 7))
        J[:4, :4], J[4:, :4] = slope, pure @ slope
        J[4:, 4:] = 0.5 * unit * right(q)[:, :3]
        result: Array = factor @ J
        return result

    t = 2.0 * (right(q).T @ q_dual)[:3]  # q' = (t / 2, 0) (x) q
    found = _least_squares(residual, jacobian, np.concatenate([q, t / unit]))
    q, pure, _ = poses(found)
    return to_transform(q, pure @ q)


def _descend_vector(
    rotation: Array, translation: Array, alpha: float, start: Minimum, *, quaternion_cost: bool
) -> Array:
    """Minimise a cost of eq. 30; the pose (4, 4) where it ends.

    Parameters
    ----------
    rotation : (4, 4) or (9, 9) array
        The rotation's quadratic form, of q or of vec R (rows).
    translation : (13, 13) array
        The translation's, of (vec R, T, 1); alpha left out.
    """
    L_R, L_t = root(rotation), alpha * root(translation)

    def pose(x: Array) -> tuple[Array, Array, Array]:
        length = float(np.linalg.norm(x[:4]))
        q = x[:4] / length
        return q, rotation_entries(q), (np.eye(4) - np.outer(q, q)) / length

    def residual(x: Array) -> Array:
        q, r, _ = pose(x)
        first = L_R @ (q if quaternion_cost else r)
        return np.concatenate([first, L_t @ np.concatenate([r, x[4:] / alpha, [1.0]])])

    def jacobian(x: Array) -> Array:
        q, _, slope = pose(x)
        dr = rotation_slopes(q) @ slope
        J = np.zeros((len(L_R) + 13, 7))
        J[: len(L_R), :4] = L_R @ (slope if quaternion_cost else dr)
        J[len(L_R) :, :4] = L_t[:, :9] @ dr
        J[len(L_R) :, 4:] = L_t[:, 9:12] / alpha
        return J

    X = to_transform(start.q, start.q_dual)
    found = _least_squares(residual, jacobian, np.concatenate([start.q, alpha * X[:3, 3]]))
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = rotation_entries(found[:4] / np.linalg.norm(found[:4])).reshape(3, 3), found[4:] / alpha
    return X


def _least_squares(residual: Vector, jacobian: Vector, start: Array) -> Array:
    found = least_squares(residual, start, jac=jacobian, method="lm", ftol=STOP, xtol=STOP, gtol=STOP)
    x: Array = found.x
    return x


def root(form: Array) -> Array:
    """L with L'L a positive semidefinite form, rounding cut off, on both sides of zero.

    Of unit diagonal inside: rotations and lengths of any unit keep their own digits.
    """
    size = np.sqrt(np.maximum(form.diagonal(), 0.0))
    size[size == 0.0] = 1.0
    values, vectors = np.linalg.eigh(form / size / size[:, None])
    values = np.where(values > ROUNDING * len(form), values, 0.0)
    factor: Array = np.sqrt(values)[:, None] * vectors.T * size
    return factor


#: vec R (rows) of a unit quaternion is quadratic in it: entry k is q' _QUADRATIC[k] q.
_QUADRATIC = ROTATION.transpose(2, 3, 0, 1).reshape(9, 4, 4)


def rotation_entries(q: Array) -> Array:
    """vec R (9,), row after row, of a unit quaternion xyzw."""
    r: Array = _QUADRATIC @ q @ q
    return r


def rotation_slopes(q: Array) -> Array:
    """Derivatives (9, 4) of ``rotation_entries``."""
    slopes: Array = 2.0 * _QUADRATIC @ q
    return slopes


def _free_at(request: Request, found: Minimum) -> tuple[FreeDirection, ...]:
    return free_directions(request, found.q, found.values, found.vectors)


def _length(request: Request) -> float:
    t = np.concatenate([request.motions.C[:, :3, 3], request.motions.H[:, :3, 3]])
    return float(np.sqrt((t * t).mean())) or 1.0


def _unit(request: Request) -> float:
    return 1.0 / request.alpha if request.covariances is None else _length(request)
