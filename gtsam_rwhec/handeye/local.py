"""Nonlinear least squares: DQNLOpt and DQNLOptRnd on the cost (8), ChVecOpt and QuatVecOpt on the costs (30).

Each cost is a quadratic form y'F y, where the few numbers y are computed from the pose. F does not grow with the number
of motions. With F = L'L, the residual L y has 8 to 22 rows. Its cost, gradient and Gauss-Newton Hessian are those of
the residuals of all motions together. The unknowns are a quaternion p of any length (q = p / |p|) and a translation in
units of 1/alpha, so every start can reach every rotation.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import least_squares

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import ROTATION, left, right
from gtsam_rwhec.handeye.chordal_form import chordal_moments, chordal_residuals
from gtsam_rwhec.handeye.degenerate import free_directions
from gtsam_rwhec.handeye.dual_quaternions import from_transforms, times_vectors, to_transform
from gtsam_rwhec.handeye.motion_costs import squared_residuals
from gtsam_rwhec.handeye.request import Request
from gtsam_rwhec.handeye.saddle import Minimum, minimum
from gtsam_rwhec.methods.estimate import Outcome

#: least_squares stops where a step changes cost or unknowns by less than this part, which is rounding error.
STOP = 1e-15
#: An entry of a form of unit diagonal has this rounding error.
ROUNDING = float(np.finfo(np.float64).eps)
#: vec R (rows) of a unit quaternion is quadratic in it: entry k is q' _QUADRATIC[k] q.
_QUADRATIC = ROTATION.transpose(2, 3, 0, 1).reshape(9, 4, 4)
#: The numbers y (n,) of a pose's q (4,) and t (3,), with their derivatives (n, 4) by q and (n, 3) by t.
Lift = Callable[[Array, Array], tuple[Array, Array, Array]]


def dqnlopt(request: Request) -> Outcome[Array]:
    """DQNLOpt descends on the cost (8) from DQOpt's answer, where it should stay (Section 4.4)."""
    found = minimum(request.cost)
    return _outcome(request, found, _descend_dual_quaternion(request, to_transform(found.q, found.q_dual)))


def dqnlopt_random(request: Request) -> Outcome[Array]:
    """DQNLOptRnd descends on the cost (8) from a random pose. Some runs end in local minima (Table 1).

    The start's rotation is uniform. Its translation is normal, with the root mean square of the motions' translations.
    """
    try:
        rng = np.random.default_rng(request.rng)
    except (TypeError, ValueError) as error:
        raise OptionError(
            f"rng={request.rng!r} is not a source of random numbers ({error}); give a numpy.random.Generator or a seed "
            "that is not negative"
        ) from error
    q, t = rng.normal(size=4), rng.normal(size=3) * _length(request)
    X = _descend_dual_quaternion(request, to_transform(q, 0.5 * times_vectors(q) @ t))
    return _outcome(request, minimum(request.cost), X)


def chvecopt(request: Request) -> Outcome[Array]:
    """ChVecOpt: |R_C R - R R_H|^2 + alpha^2 |(R_C - 1) T - R T_H + T_C|^2 (eq. 30, first), from DQOpt's answer.

    The paper names no start. The method ``certified`` minimises the same cost and proves the minimum.
    """
    rotation, translation = chordal_moments(request.motions, request.weights)

    def lift(q: Array, t: Array) -> tuple[Array, Array, Array]:
        by_q = rotation_slopes(q)
        y, y_by_q, by_t = _vector_lift(by_q, q, t)
        return np.concatenate([y[:9], y]), np.concatenate([by_q, y_by_q]), np.concatenate([np.zeros((9, 3)), by_t])

    found = minimum(request.cost)
    X = _descend_vector(request, found, rotation, translation, lift)
    of_R, of_T = chordal_residuals(request.motions, X, request.weights)
    return _outcome(request, found, X, of_R + request.alpha**2 * of_T, "eq. 30, chordal")


def quatvecopt(request: Request) -> Outcome[Array]:
    """QuatVecOpt: |q_C q - q q_H|^2 + alpha^2 |(R_C - 1) T - R T_H + T_C|^2 (eq. 30, second), from DQOpt's answer."""
    _, translation = chordal_moments(request.motions, request.weights)

    def lift(q: Array, t: Array) -> tuple[Array, Array, Array]:
        y, y_by_q, by_t = _vector_lift(rotation_slopes(q), q, t)
        return np.concatenate([q, y]), np.concatenate([np.eye(4), y_by_q]), np.concatenate([np.zeros((4, 3)), by_t])

    AA = request.cost.M / request.alpha**2  # the sum of A'A
    found = minimum(request.cost)
    X = _descend_vector(request, found, AA, translation, lift)
    (q,), (q_dual,) = from_transforms(X[None])
    of_q, _ = squared_residuals(request.motions, q, q_dual, request.weights)
    _, of_T = chordal_residuals(request.motions, X, request.weights)
    return _outcome(request, found, X, of_q + request.alpha**2 * of_T, "eq. 30, quaternion")


def _vector_lift(slopes: Array, q: Array, t: Array) -> tuple[Array, Array, Array]:
    """(vec R, t, 1) (13,), with vec R quadratic in q."""
    by_q, by_t = np.zeros((13, 4)), np.zeros((13, 3))
    by_q[:9], by_t[9:12] = slopes, np.eye(3)
    return np.concatenate([0.5 * slopes @ q, t, [1.0]]), by_q, by_t


def _descend_vector(request: Request, found: Minimum, rotation: Array, translation: Array, lift: Lift) -> Array:
    """Minimise a cost of eq. 30 from DQOpt's answer; the pose (4, 4) where the descent ends."""
    factor = block_diag(root(rotation), request.alpha * root(translation))
    return _descend(factor, lift, to_transform(found.q, found.q_dual), 1.0 / request.alpha)


def _descend_dual_quaternion(request: Request, start: Array) -> Array:
    """Minimise the cost (8), prior included; the pose (4, 4) where the descent ends."""
    cost = request.cost

    def lift(q: Array, t: Array) -> tuple[Array, Array, Array]:  # y = (q, q')
        pure = left(np.append(0.5 * t, 0.0))
        by_t = np.concatenate([np.zeros((4, 3)), 0.5 * right(q)[:, :3]])
        return np.concatenate([q, pure @ q]), np.concatenate([np.eye(4), pure]), by_t

    unit = 1.0 / request.alpha if request.covariances is None else _length(request)
    return _descend(root(np.block([[cost.S, cost.W], [cost.W.T, cost.M]])), lift, start, unit)


def _descend(factor: Array, lift: Lift, start: Array, unit: float) -> Array:
    """Minimise |factor y|^2 over poses from a start (4, 4), translations in units of ``unit`` metres."""

    def pose(x: Array) -> tuple[Array, Array, Array]:
        length = float(np.linalg.norm(x[:4]))
        q = x[:4] / length
        return q, unit * x[4:], (np.eye(4) - np.outer(q, q)) / length  # the last is dq / dp

    def residual(x: Array) -> Array:
        q, t, _ = pose(x)
        return factor @ lift(q, t)[0]

    def jacobian(x: Array) -> Array:
        q, t, slope = pose(x)
        _, by_q, by_t = lift(q, t)
        return factor @ np.hstack([by_q @ slope, unit * by_t])

    (q,), _ = from_transforms(start[None])
    x0 = np.concatenate([q, start[:3, 3] / unit])
    q, t, _ = pose(least_squares(residual, x0, jac=jacobian, method="lm", ftol=STOP, xtol=STOP, gtol=STOP).x)
    return to_transform(q, 0.5 * times_vectors(q) @ t)


def root(form: Array) -> Array:
    """L with L'L a positive semidefinite form. Eigenvalues that are rounding error are set to zero.

    The form is first brought to unit diagonal: rotations and lengths of any unit keep their own digits.
    """
    size = np.sqrt(np.maximum(form.diagonal(), 0.0))
    size[size == 0.0] = 1.0
    values, vectors = np.linalg.eigh(form / size / size[:, None])
    values = np.where(values > ROUNDING * len(form), values, 0.0)
    factor: Array = np.sqrt(values)[:, None] * vectors.T * size
    return factor


def rotation_slopes(q: Array) -> Array:
    """Derivatives (9, 4) of vec R (rows) by a unit quaternion xyzw. vec R is half the derivatives times q."""
    slopes: Array = 2.0 * _QUADRATIC @ q
    return slopes


def _outcome(
    request: Request, found: Minimum, X: Array, cost: float | None = None, cost_name: str = ""
) -> Outcome[Array]:
    """The answer X (4, 4), with the free directions of the cost (8) at DQOpt's answer."""
    free = free_directions(request, found.q, found.values, found.vectors)
    return Outcome(X, cost=cost, cost_name=cost_name, free_directions=free)


def _length(request: Request) -> float:
    """Root mean square of the motions' translations, metres; 1 where nothing moves."""
    t = np.concatenate([request.motions.C[:, :3, 3], request.motions.H[:, :3, 3]])
    return float(np.sqrt((t * t).mean())) or 1.0
