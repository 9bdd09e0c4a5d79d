"""Levenberg and Marquardt's method, for small problems whose normal equations fit into one matrix."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from scipy.optimize import least_squares

from gtsam_rwhec.geometry.poses import Array

Point = TypeVar("Point")
#: The point x (m,) of parameters p (k,), and its derivatives (m, k).
Chart = Callable[[Array], tuple[Array, Array]]

#: Damping starts at this, relative to the Hessian's diagonal. A failed step multiplies it by 10, a good one by 0.1.
FIRST_DAMPING = 1e-6
#: With more damping than this the steps are rounding error.
MOST_DAMPING = 1e9
#: A step with no larger entry (rad, m) is taken although rounding hides whether the cost falls.
FLAT_STEP = 1e-7
#: least_squares stops when a step changes cost or unknowns by less than this share, which is rounding error.
STOP = 1e-15
#: An entry of a form of unit diagonal has this rounding error.
ROUNDING = float(np.finfo(np.float64).eps)
#: The descent ends after a step with no larger entry (rad, m).
LAST_STEP = 1e-9


@dataclass(frozen=True, eq=False)
class Linearised:
    """Half a sum of squares at a point: its value, its gradient g (k,) and Gauss-Newton Hessian H (k, k) by a step."""

    cost: float
    g: Array
    H: Array

    def step(self, damping: float) -> Array:
        """The step to the least value of the quadratic model, with damping times H's diagonal added to H."""
        H = self.H + damping * np.diag(np.diagonal(self.H))
        return -np.linalg.lstsq(H, self.g, rcond=1e-15)[0]  # a chart's H may be singular


@dataclass(frozen=True)
class Descent(Generic[Point]):
    """Where a descent ended, the cost there, the number of steps, and whether it converged before the step limit."""

    point: Point
    cost: float
    iterations: int
    converged: bool


def descend(
    linearised: Callable[[Point], Linearised], moved: Callable[[Point, Array], Point], start: Point, max_iterations: int
) -> Descent[Point]:
    """Find a local minimum from ``start``; ``moved`` takes a step (k,) from a point to the next point."""
    point, here, damping = start, linearised(start), FIRST_DAMPING
    for iteration in range(1, max_iterations + 1):
        while True:
            step = here.step(damping)
            length = float(np.abs(step).max())
            tried = moved(point, step)
            ahead = linearised(tried)
            if ahead.cost <= here.cost or (length < FLAT_STEP and np.isfinite(ahead.cost)):
                break
            damping *= 10.0
            if damping > MOST_DAMPING:  # no step reduces the cost: rounding
                return Descent(point, here.cost, iteration, converged=True)
        point, here, damping = tried, ahead, max(0.1 * damping, 1e-12)
        if length < LAST_STEP:
            return Descent(point, here.cost, iteration, converged=True)
    return Descent(point, here.cost, max_iterations, converged=False)


def descend_on_chart(form: Array, chart: Chart, start: Array, max_iterations: int) -> Array:
    """Parameters p (k,) of a local minimum of x' Q x, x (m,) = chart(p), for a form Q (m, m), from ``start`` (k,)."""
    L = root(form)

    def residual(p: Array) -> Array:
        return L @ chart(p)[0]

    def jacobian(p: Array) -> Array:
        return L @ chart(p)[1]

    found = least_squares(
        residual, start, jacobian, method="lm", ftol=STOP, xtol=STOP, gtol=STOP, max_nfev=max_iterations
    )
    return np.asarray(found.x)


def unit_quaternions(p: Array) -> tuple[Array, Array]:
    """Quaternions (n, 4) divided by their lengths, and their derivatives (n, 4, 4) by the numbers given."""
    length = np.linalg.norm(p, axis=1, keepdims=True)
    q = p / length
    return q, (np.eye(4) - q[:, :, None] * q[:, None, :]) / length[:, :, None]


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
