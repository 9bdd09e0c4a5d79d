"""GTSAM's optimiser, and the information that the unknowns are left with."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from gtsam_rwhec.errors import NoiseError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.refinement.variables import Variables


@dataclass(frozen=True)
class Optimum:
    """Values at the optimum, and how the optimiser came there."""

    values: gtsam.Values
    initial_cost: float
    cost: float
    iterations: int


def optimise(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, max_iterations: int) -> Optimum:
    """Levenberg-Marquardt to the last digits: the start is as good as optimal, and steps are cheap."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(max_iterations)
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(1e-12)
    initial = graph.error(values)
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    optimum = optimiser.optimize()
    return Optimum(optimum, initial, optimiser.error(), optimiser.iterations())


def information_of(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, variables: Variables) -> Array:
    """Gauss-Newton information (d, d) of ``variables.unknown`` in their order, everything else marginalised.

    ``graph`` is without the constraints of fixed frames: known means that their rows are struck out.
    """
    linear = graph.linearize(values)
    keys = {name: variables.keys[name] for name in variables.keys}
    present = set(linear.keyVector())
    others = present - set(keys.values())
    if others:  # carrier poses
        try:
            linear = linear.marginal([key for key in keys.values() if key in present])
        except RuntimeError as error:  # GTSAM's IndeterminateSystemException
            raise NoiseError(
                "the carrier poses cannot be told apart from rounding: A's noise, turned about the origin that it is "
                "given about, moves what is far from it by far more than it says. Give it about the other carrier "
                "(CarrierNoise.about), or refer the world to an origin nearby"
            ) from error
    names = [name for name, key in keys.items() if key in present]
    ordering = gtsam.Ordering()
    for name in names:
        ordering.push_back(keys[name])
    dense = linear.hessian(ordering)[0] if names else np.zeros((0, 0))
    unknown = variables.unknown
    place = dict(zip(unknown, np.cumsum([0, *unknown.values()])[:-1], strict=True))
    information = np.zeros((sum(unknown.values()),) * 2)
    rows: list[int] = []
    columns: list[int] = []
    first = 0
    for name in names:
        dimension = 6 if name in variables.frames else 1
        if name in unknown:
            rows.extend(range(place[name], place[name] + dimension))
            columns.extend(range(first, first + dimension))
        first += dimension
    information[np.ix_(rows, rows)] = dense[np.ix_(columns, columns)]
    return information
