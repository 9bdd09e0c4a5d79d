"""Numerical Jacobians of any factor, by GTSAM's own retractions."""

from __future__ import annotations

import gtsam
import numpy as np


def values_of(variables: dict[int, gtsam.Pose3 | float]) -> gtsam.Values:
    """Poses, and numbers as 1-vectors."""
    values = gtsam.Values()
    for key, value in variables.items():
        values.insert(key, value if isinstance(value, gtsam.Pose3) else np.array([float(value)]))
    return values


def graph_of(*factors: gtsam.CustomFactor) -> gtsam.NonlinearFactorGraph:
    """A graph of some factors."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph


def moved(values: gtsam.Values, key: int, step: np.ndarray) -> gtsam.Values:
    """The values with one variable moved along its tangent."""
    delta = gtsam.VectorValues()
    delta.insert(key, step)
    return values.retract(delta)


def numeric_jacobian(factor: gtsam.CustomFactor, values: gtsam.Values, key: int, step: float = 1e-5) -> np.ndarray:
    """The derivative of the unwhitened error by one variable, by Richardson's fourth-order differences."""
    columns = []
    for direction in np.eye(len(values.atVector(key)) if is_number(values, key) else 6):

        def central(h: float, direction: np.ndarray = direction) -> np.ndarray:
            sides = [factor.unwhitenedError(moved(values, key, s * h * direction)) for s in (1.0, -1.0)]
            return (sides[0] - sides[1]) / (2.0 * h)

        columns.append((4.0 * central(step) - central(2.0 * step)) / 3.0)
    return np.array(columns).T


def is_number(values: gtsam.Values, key: int) -> bool:
    try:
        values.atPose3(key)
    except RuntimeError:
        return True
    return False


def check_jacobians(factor: gtsam.CustomFactor, values: gtsam.Values, sigmas: np.ndarray, atol: float = 1e-7) -> None:
    """Each key's analytic Jacobian is the numeric one; sigmas whiten them."""
    linear = factor.linearize(values)
    assert list(linear.keys()) == list(factor.keys())
    expected = np.hstack([numeric_jacobian(factor, values, key) for key in list(factor.keys())])
    np.testing.assert_allclose(linear.jacobian()[0] * sigmas[:, None], expected, atol=atol)
    np.testing.assert_allclose(linear.jacobian()[1] * sigmas, -factor.unwhitenedError(values), atol=1e-12)
