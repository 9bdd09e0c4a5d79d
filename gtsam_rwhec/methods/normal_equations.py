"""The solution of normal equations whose unknowns have different units."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.geometry.poses import Array

#: Up to this smallest eigenvalue over the largest, normal equations are singular: exact data leave a direction free.
FREE = 1e-10


def solve_scaled(normal: Array, right: Array, undetermined: str, smallest: float = FREE) -> Array:
    """Solve the normal equations; all unknowns are scaled alike, so that the choice of units loses no digits.

    Raises UnderdeterminedError with the text ``undetermined`` when an eigenvalue of the scaled matrix is at most
    ``smallest``.
    """
    scaling = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal * scaling[:, None] * scaling
    if np.linalg.eigvalsh(scaled)[0] <= smallest:
        raise UnderdeterminedError(undetermined)
    return scaling * np.linalg.solve(scaled, scaling * right)
