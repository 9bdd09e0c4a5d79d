"""The directions with the least information, in units of the information that noise alone would create.

Up to `DENSE_PARAMETERS` parameters all eigenvalues are computed. Above that the information's Cholesky factor follows
the graph (``solver/block_matrix.py``). If the information less the highest threshold is positive definite, nothing is
free (Sylvester's law of inertia), and Lanczos on its inverse gives the weakest direction to a per cent. Else Lanczos on
the inverse finds all directions below the threshold, and one above.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.block_matrix import BlockMatrix
from gtsam_rwhec.solver.noise_bounds import DENSE_PARAMETERS, free_threshold

#: Information below this part of the largest is rounding error.
ROUNDING = 4.0 * np.finfo(float).eps
#: If nothing is free: the relative precision of the weakest direction's information, which is only reported.
NEAR = 0.01
#: If some directions are free: how many are searched first (then four times as many), and their relative precision.
FIRST, PRECISION = 6, 1e-8
#: If Lanczos finds very many free directions, all eigenvalues are computed up to this many parameters: 0.2 GB.
MOST_DENSE = 4000
#: In larger problems at most this many free directions are reported, the weakest ones.
MOST_FREE = 768
#: The value that replaces the information of an unused parameter.
_FAR = 1e30


@dataclass(frozen=True)
class Weak:
    """Directions in ascending order of information over threshold: values (k,), thresholds (k,), directions (d, k)."""

    values: Array
    thresholds: Array
    directions: Array

    @property
    def free(self) -> np.ndarray:
        """(k,): whether a direction is free."""
        return self.values <= self.thresholds

    @property
    def ratio(self) -> float:
        """Information over threshold of the weakest direction."""
        return float(self.values[0] / self.thresholds[0]) if len(self.values) else np.inf


def unit_of(noise: Array, used: np.ndarray) -> Array:
    """The factor that brings a parameter to units of its noise; 0 for an unused parameter."""
    return np.where(used, 1.0 / np.sqrt(np.where(used, noise, 1.0)), 0.0)


def weakest(information: BlockMatrix, noise: Array, used: np.ndarray, ends: Array, spare: float, *, few: bool) -> Weak:
    """The directions with the smallest information in units of noise; all free directions are among them.

    ``noise`` (7 n + 1,): the information that noise alone would create; ``used`` (7 n + 1,): which parameters are
    tested; ``ends`` (n + 1,): how many ends of measurements each frame has, and how many measurements the shared scale.
    """
    unit = unit_of(noise, used)
    if not np.isfinite(information.diagonal * unit**2).all():  # and so are the entries beside it: it is semidefinite
        raise UnderdeterminedError(
            "what the measurements tell of the poses overflows: the translations of A and of B, or a scale, are "
            "far beyond anything measured in metres; give lengths in metres"
        )
    size = int(used.sum())
    if size == 0:
        return Weak(np.zeros(0), np.zeros(0), np.zeros((len(used), 0)))
    # Each direction has at least two squares, and the threshold is the highest for the fewest squares.
    values, vectors = (
        _all_of(information, unit, used)
        if size <= DENSE_PARAMETERS
        else _weakest_of_many(information, unit, used, float(free_threshold(2.0, 0.0, spare)))
    )
    # By Satterthwaite, the squares that a direction sums follow from its shares of the frames' measurements. A tilt of
    # the direction at a frame removes two of them.
    of_parameters = vectors**2
    share = np.empty((len(ends), len(values)))
    of_frames = of_parameters[:-1].reshape(len(ends) - 1, 7, len(values))
    share[:-1], share[-1] = of_frames.sum(axis=1), of_parameters[-1]
    squares = 1.0 / np.maximum((share**2 / ends[:, None]).sum(axis=0), 1e-300)
    tilted = 2.0 / ends[:-1] @ of_frames[:, :6].sum(axis=1) if few else 0.0
    thresholds = free_threshold(squares, tilted * squares, spare)
    order = np.argsort(values / thresholds)
    return Weak(values[order], thresholds[order], vectors[:, order] * unit[:, None])


def _all_of(information: BlockMatrix, unit: Array, used: np.ndarray) -> tuple[Array, Array]:
    """All eigenvalues of the used parameters in their units, and their vectors over all parameters."""
    values, reduced = np.linalg.eigh((information.dense() * unit[:, None] * unit)[used][:, used])
    values[values < ROUNDING * values[-1]] = 0.0
    vectors = np.zeros((len(used), len(values)))
    vectors[used] = reduced
    return values, vectors


def _weakest_of_many(information: BlockMatrix, unit: Array, used: np.ndarray, enough: float) -> tuple[Array, Array]:
    """The smallest eigenpairs, up to one above ``enough``."""
    from scipy.sparse.linalg import LinearOperator, eigsh  # slow to import, and few problems need it

    size, parameters, matrix = len(used), int(used.sum()), information.scaled(unit)
    unused = np.where(used, 0.0, _FAR)
    start = np.random.default_rng(0).standard_normal(size) * used
    # Nothing is free where the matrix less ``enough`` has a factor: then the weakest direction is only reported.
    count, precision, shift, factor = 1, NEAR, -enough, matrix.plus(unused - enough).factor()
    if factor is None:
        # Above the factorisation's rounding, far below thresholds.
        count, precision, shift = FIRST, PRECISION, max(1e-6, 1e-13 * float(matrix.diagonal.max()))
        factor = matrix.plus(unused + shift).factor()
    if factor is None:
        raise FloatingPointError("the information matrix is not positive semidefinite: its entries overflow")
    operator = LinearOperator((size, size), matvec=factor.solve_vector, dtype=np.float64)
    while 4 * count < parameters and count <= MOST_FREE:
        inverse, vectors = eigsh(operator, k=count, which="LA", v0=start, tol=precision)
        values = np.maximum(1.0 / inverse - shift, 0.0)
        if values.max() > enough or (4 * count > MOST_FREE and parameters > MOST_DENSE):
            return values, vectors * used[:, None]
        count *= 4
    # Lanczos is not faster with so many free directions.
    return _all_of(information, unit, used)
