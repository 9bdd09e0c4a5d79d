"""What a cost is evaluated at, and what comes out: enclosed costs, gradients, and the form's action on directions.

A direction and a gradient are vectors over the form's variables without h, about the part's gauge: 13 numbers for each
leaf, 13 for each center, [t (3), own scale, vec R (9)], then alpha; (13 n + 1,) in all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.rotations import unvec


@dataclass(frozen=True)
class Point:
    """Values of the form's variables about the gauge: numbers (n, 13), [t, own scale, vec R], and alpha."""

    numbers: Array
    alpha: float

    @property
    def rotations(self) -> Array:
        """(n, 3, 3), as the form has them."""
        return unvec(self.numbers[:, 4:])


@dataclass(frozen=True)
class Evaluation:
    """The cost at a point and half of its gradient Q x, each with a bound on its error.

    ``point`` has the values of the variables, rounded; the cost is that of the values as they are.
    """

    point: Point
    cost: float
    cost_error: float
    gradient: Array
    gradient_error: Array
    unknown: float = 0.0  #: what the moments' own rounding may change in the cost, where measurements were not kept

    @property
    def upper(self) -> float:
        """The cost, rounded up: the exact cost is at most this."""
        upper = float(np.nextafter(self.cost + self.cost_error * (1.0 + 1e-9), np.inf))
        return 0.0 if upper < 0.0 else upper


@dataclass(frozen=True)
class Action:
    """What the form does to directions V (13 n + 1, D): Q V, V'Q V and V'Q x, each with a bound on its error."""

    QV: Array
    QV_error: Array
    VQV: Array
    VQV_error: Array
    VQx: Array
    VQx_error: Array
    #: Sizes of the terms that cancel in each, where only moments tell them.
    sizes: tuple[Array, Array, Array] | None = None


class Form(Protocol):
    """A quadratic cost, evaluated with bounds on the rounding: from raw measurements, or from their moments."""

    def at(self, point: Point) -> Evaluation:
        """The cost at values of the variables."""

    def action(self, evaluation: Evaluation, V: Array) -> Action:
        """What the form does to directions, and to them with the evaluated point."""
