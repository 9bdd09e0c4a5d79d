"""Starting points of descents where the graph is followed: eigenvectors by inverse iteration with a sparse factor."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.block_matrix import BlockFactor, BlockMatrix
from gtsam_rwhec.solver.elimination import Elimination
from gtsam_rwhec.solver.full_form import FullForm
from gtsam_rwhec.solver.graph_form import GraphForm
from gtsam_rwhec.solver.parts import Part, connected_components
from gtsam_rwhec.solver.rotations import project, unvec

#: This part of the diagonal is added to it: exact data make the form singular.
SHIFT = 1e-9
#: Inverse iterations at most, and the change of a unit vector at which they end: the start need not be exact.
ITERATIONS, SMALL = 40, 1e-3
#: Inverse iterations with Q' as a whole.
FEW_ITERATIONS = 8
#: Steps of Lanczos for the smallest eigenvalue, which the search for a bound then corrects.
LANCZOS_STEPS = 80


def graph_spectral_start(part: Part, rotation_form: FullForm, order: Elimination) -> list[Array]:
    """Rotations that minimise the rotation residuals over all matrices, projected to SO(3); (n, 3, 3) each.

    As `start.spectral_start`, with all frames in the eigenvector, each in units of its own diagonal.
    """
    n = len(rotation_form.frames)
    frames = rotation_form.frames
    of_h, tail = rotation_form.tails[:, :, 1:], rotation_form.tail[1:, 1:]
    anchored = bool(np.abs(of_h).max(initial=0.0) > 0.0)
    if not anchored:
        of_h, tail = np.zeros_like(of_h), np.ones((1, 1))
    P = BlockMatrix(order, frames, rotation_form.couplings, of_h, tail)
    weights = np.maximum(np.einsum("nii->n", frames) / 9.0, 1e-290)
    weight = np.append(np.repeat(weights, 9), max(float(tail[0, 0]), 1e-290))
    factor = P.plus(SHIFT * weight).factor()
    if factor is None:
        return []
    r: Array = np.zeros(P.size)
    if anchored:
        r = _smallest(factor, weight, np.ones(P.size))
        return [project(unvec(sign * r[:-1])) for sign in (1.0, -1.0)]
    # Components that only the shared scale joins each have an eigenvector and a sign.
    index = {name: i for i, name in enumerate(part.free)}
    for names in connected_components(part.pairs) if part.scale == "shared" else [list(part.free)]:
        members = np.array([index[name] for name in names if name in index], dtype=int)
        begin = np.zeros((n, 9))
        begin[members] = np.random.default_rng(0).standard_normal((len(members), 9))
        v = _smallest(factor, weight, np.append(begin.ravel(), 0.0))
        r += v * _handedness(v[:-1])
    return [project(unvec(r[:-1]))]


def _smallest(factor: BlockFactor, weight: Array, v: Array) -> Array:
    """The smallest eigenvector, beside the diagonal ``weight``, that ``v`` has a part of."""
    v = v / np.sqrt(float(weight @ v**2))
    for _ in range(ITERATIONS):
        after = factor.solve_vector(weight * v)
        after /= np.sqrt(float(weight @ after**2))
        change = np.sqrt(float(weight @ (after - v) ** 2))
        v = after
        if change < SMALL:
            break
    return v


def _handedness(r: Array) -> float:
    """+1 or -1, so that the blocks of r are right-handed (design fact 5)."""
    return 1.0 if float(np.sign(np.linalg.det(unvec(r))).sum()) >= 0.0 else -1.0


def graph_unconstrained_start(form: GraphForm) -> list[Array]:
    """Minimisers of x'Q'x over all matrices, as `start.unconstrained_start` has them."""
    n = form.rotations
    shift = np.append(np.tile(np.r_[np.zeros(4), np.full(9, 1e-12 * form.magnitude)], n), 0.0)
    factor = form.without_h().plus(shift).factor()
    if factor is None:
        return []

    def solved(right: Array) -> Array:
        numbers = np.zeros((n, 13))
        numbers[:, 4:] = right.reshape(n, 9)
        return factor.solve_vector(np.append(numbers.ravel(), 0.0))[:-1].reshape(n, 13)[:, 4:].ravel()

    last = np.zeros(form.size)
    last[-1] = 1.0
    linear = form.apply(last)[:-1]
    candidates = []
    if np.abs(linear).max(initial=0.0) > 0.0:
        candidates.append(solved(-linear))
    v: Array = np.ones(form.size - 1)
    for _ in range(FEW_ITERATIONS):
        v = solved(v)
        v /= np.linalg.norm(v)
    candidates.append(v * _handedness(v))
    return [project(unvec(r)) for r in candidates]


def graph_smallest_eigenpair(form: GraphForm, Lambda: Array) -> tuple[float, Array]:
    """The smallest eigenvalue of Q' - Lambda without h, and its vector (9 n,): an upper bound, and near it.

    Lambda (n, 9, 9) are the multipliers' blocks. By Lanczos' method with full orthogonalisation.
    """
    n = form.rotations
    size = 9 * n
    steps = min(LANCZOS_STEPS, size)
    basis = np.zeros((steps, size))
    diagonal, beside = np.zeros(steps), np.zeros(steps)
    v = np.random.default_rng(0).standard_normal(size)
    v /= np.linalg.norm(v)
    for k in range(steps):
        basis[k] = v
        product = form.apply(np.append(v, 0.0))[:-1] - np.matmul(Lambda, v.reshape(n, 9, 1)).ravel()
        diagonal[k] = float(v @ product)
        for _ in range(2):  # twice is enough (Parlett 1998, section 6.9)
            product -= basis[: k + 1].T @ (basis[: k + 1] @ product)
        beside[k] = float(np.linalg.norm(product))
        if beside[k] <= 1e-12 * form.magnitude:
            steps = k + 1
            break
        v = product / beside[k]
    values, vectors = scipy.linalg.eigh_tridiagonal(
        diagonal[:steps], beside[: steps - 1], select="i", select_range=(0, 0)
    )
    vector: Array = basis[:steps].T @ vectors[:, 0]
    return float(values[0]), vector / np.linalg.norm(vector)
