"""GTSAM's optimiser, and the information of the unknowns at its optimum."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from gtsam_rwhec.errors import NoiseError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.refinement.unknowns import rows_of, slots_of
from gtsam_rwhec.refinement.variables import Variables


@dataclass(frozen=True)
class Optimum:
    """Values at the optimum, their cost, and the optimiser's number of iterations."""

    values: gtsam.Values
    cost: float
    iterations: int


def optimise(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, max_iterations: int) -> Optimum:
    """Levenberg-Marquardt's optimum, to the last digits: the start is nearly optimal, and steps are cheap."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(max_iterations)
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(1e-12)
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    optimum = optimiser.optimize()
    return Optimum(optimum, optimiser.error(), optimiser.iterations())


def information_of(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, variables: Variables) -> Array:
    """Gauss-Newton information (d, d) of ``variables.unknowns`` in their order, with all other variables marginalised.

    ``graph`` has no constraints of fixed frames: their rows are left out here.
    """
    linear = graph.linearize(values)
    keys = variables.keys
    present = set(linear.keyVector())
    others = present - set(keys.values())
    if others:  # carrier poses
        try:
            linear = linear.marginal([key for key in keys.values() if key in present])
        except RuntimeError as error:  # GTSAM's IndeterminateSystemException
            raise NoiseError(
                "the carrier poses cannot be computed in double precision: A's rotation noise, about the origin that "
                "it is given about, moves frames far away by very much. Give the noise about the other carrier "
                "(CarrierNoise.about), or take a world origin near the measurements"
            ) from error
    seen = slots_of(unknown for unknown, key in keys.items() if key in present)
    ordering = gtsam.Ordering()
    for unknown in seen:
        ordering.push_back(keys[unknown])
    dense = linear.hessian(ordering)[0] if seen else np.zeros((0, 0))
    slots = slots_of(variables.unknowns)
    size = sum(unknown.dimension for unknown in slots)
    information = np.zeros((size, size))
    both = [unknown for unknown in slots if unknown in seen]
    rows, columns = rows_of(slots, both), rows_of(seen, both)
    information[np.ix_(rows, rows)] = dense[np.ix_(columns, columns)]
    return information
