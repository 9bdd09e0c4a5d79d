"""What the motion can and cannot determine (RWHEC paper Section 6, DESIGN fact 8).

Noise excites every direction a little, so rank says nothing on real data. A direction is called *free* when the
information that the measurements have of it is no more than the noise of A and B alone would create there if the true
motions left it open. In units of that noise information (``information.noise_information``) a free direction has a
ratio of mean 1: a sum of about m = 2 N squares of noise over a noise variance estimated with nu degrees of freedom, an
F variate. The threshold is its 99.9 % quantile F(m, nu): a free direction is called determined once in a thousand.
Three measurements with six degrees to spare ask for a ratio of 20, a hundred for 1.4.

Corollaries 2 and 4 are the same test on one pair: rotations about two distinct axes leave nothing free. Theorems 1 and
3 (one determined pair determines all that is connected) and endnote 9 (pairs that only together determine) need no
rule of their own: information adds along the graph, and the whole is tested as the pairs are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse.linalg import LinearOperator, eigsh
from scipy.special import fdtri

from gtsam_rwhec.certify import arrow
from gtsam_rwhec.certify.parts import Part
from gtsam_rwhec.certify.search import Forms
from gtsam_rwhec.certify.variables import Answer
from gtsam_rwhec.free_directions import describe
from gtsam_rwhec.information import (
    Derivative,
    Information,
    NoiseLevel,
    derivative,
    information,
    noise_information,
    noise_level,
)
from gtsam_rwhec.poses import Array
from gtsam_rwhec.problem import Pair
from gtsam_rwhec.statistics import ONE, R_A, T_B

#: A free direction passes for determined with this probability.
SIGNIFICANCE = 1e-3
#: Above this many parameters the weakest directions are found by Lanczos on the arrow factor, not densely.
DENSE_PARAMETERS = 400


@dataclass(frozen=True)
class PairIdentifiability:
    """What one pair determines on its own.

    Attributes
    ----------
    is_unique : bool
    free_directions : list of str
        In words.
    rotation_axes : int
        About how many axes its motion turned: 0, 1, or 2 for two and more (Corollary 2).
    number_of_measurements : int
    weakest : float
        Information of the weakest direction, in units of what noise alone would create.
    threshold : float
        Up to which ``weakest`` counts as free.
    """

    is_unique: bool
    free_directions: list[str]
    rotation_axes: int
    number_of_measurements: int
    weakest: float
    threshold: float


@dataclass(frozen=True)
class Identifiability:
    """What a problem's measurements determine.

    Attributes
    ----------
    is_unique : bool
        Whether every frame and scale is determined.
    free_directions : list of str
        Each frame's free directions, in words.
    weakest, threshold : float
        As in ``PairIdentifiability``, for the whole.
    pairs : dict of (target, sensor) to PairIdentifiability
        Each pair on its own: the grid of the paper's Figure 8.
    parts : tuple of tuple of str
        Frames of each unconnected part.
    explanation : str
        How what a pair determines spreads, in words.
    """

    is_unique: bool
    free_directions: list[str]
    weakest: float
    threshold: float
    pairs: dict[Pair, PairIdentifiability]
    parts: tuple[tuple[str, ...], ...]
    explanation: str


@dataclass(frozen=True)
class _Weak:
    """Directions in ascending order of information: values (k,), vectors (d, k) in noise units, thresholds (k,)."""

    values: Array
    vectors: Array
    thresholds: Array

    @property
    def free(self) -> np.ndarray:
        return self.values <= self.thresholds


def identify(
    part: Part, forms: Forms, answer: Answer, translation_cost: float, rotation_cost: float
) -> Identifiability:
    """Test every direction of a part, and of each of its pairs alone, at its answer.

    Parameters
    ----------
    part : Part
    forms : Forms
    answer : Answer
    translation_cost, rotation_cost : float
        J_t and J_R at the answer: they tell the noise.
    """
    P = derivative(part, answer)
    noise = noise_level(part, translation_cost, rotation_cost)
    ends, own, _ = noise_information(part, noise, answer.scale)
    index = {name: i for i, name in enumerate(part.free)}
    n, L = len(part.free), len(part.leaves)
    noise_frames, counts, noise_scale = np.zeros((n, 7)), np.zeros(n), 0.0
    for e, pair in enumerate(part.pairs):
        for end, name in enumerate(pair):
            if name in index:
                noise_frames[index[name], :6] += ends[e, end]
                counts[index[name]] += part.moments[e].count
        if pair[0] in index:
            noise_frames[index[pair[0]], 6] += own[e]
        noise_scale += own[e]
    total = part.number_of_measurements
    length = _typical_length(part)
    axes = [_rotation_axes(part, e, noise) for e in range(len(part.pairs))]

    info = information(part, forms.full, P)
    border_noise = np.r_[noise_frames[L:].ravel(), noise_scale]
    weak = _weakest(info, noise_frames[:L], border_noise, np.r_[counts, total], noise.redundancy)
    free: list[str] = []
    if weak.free.any():
        frames_noise = np.concatenate([noise_frames.ravel(), [noise_scale]])
        basis = weak.vectors[:, weak.free] / np.sqrt(np.where(frames_noise > 0.0, frames_noise, 1.0))[:, None]
        seen = {
            name: max((a for a, pair in zip(axes, part.pairs, strict=True) if name in pair), default=0)
            for name in index
        }
        free = describe(part.free, basis, length, seen, part.scale)
    pairs = _pairs(part, forms, P, ends, own, noise, axes, length)
    return Identifiability(
        is_unique=not free,
        free_directions=free,
        weakest=float(weak.values[0]) if len(weak.values) else np.inf,
        threshold=float(weak.thresholds[0]) if len(weak.values) else 0.0,
        pairs=pairs,
        parts=(part.names,),
        explanation=_explanation(pairs, not free),
    )


def combined(results: list[Identifiability], components: tuple[tuple[str, ...], ...]) -> Identifiability:
    """One result for parts that were solved apart."""
    weakest = min(results, key=lambda r: r.weakest / max(r.threshold, 1e-300))
    return Identifiability(
        is_unique=all(r.is_unique for r in results),
        free_directions=[direction for r in results for direction in r.free_directions],
        weakest=weakest.weakest,
        threshold=weakest.threshold,
        pairs={pair: value for r in results for pair, value in r.pairs.items()},
        parts=components,
        explanation=" ".join(dict.fromkeys(r.explanation for r in results)),
    )


def _typical_length(part: Part) -> float:
    """Root mean square of |t_B|, in metres: weighs radians against metres in words."""
    W = sum(float(m.translation[ONE, ONE]) for m in part.moments)
    square = sum(float(np.trace(m.translation[T_B, T_B])) for m in part.moments)
    return float(np.sqrt(max(square / W, 1e-12)))


def _threshold(squares: Array | float, redundancy: int) -> Array:
    result: Array = np.asarray(fdtri(np.asarray(squares), float(max(redundancy, 1)), 1.0 - SIGNIFICANCE))
    return result


def _rotation_axes(part: Part, e: int, noise: NoiseLevel) -> int:
    """About how many axes a pair's A turned (Corollary 2, tested as noise would have it): 0, 1 or 2.

    The mean of R_A shortens every direction but a common axis: 1 - s^2 of its singular values is the mean square
    sine of the turning that leaves that direction.
    """
    moments = part.moments[e]
    mean = moments.translation[R_A, ONE].reshape(3, 3) / moments.translation[ONE, ONE]
    s = np.linalg.svd(mean, compute_uv=False)
    ratio = (1.0 - s**2) * moments.kappa / moments.count / noise.rotation
    excited = int((ratio > _threshold(2.0 * moments.count, noise.redundancy)).sum())
    return {0: 0, 1: 1, 2: 1, 3: 2}[excited]


def _weakest(info: Information, leaf_noise: Array, border_noise: Array, counts: Array, redundancy: int) -> _Weak:
    """The directions with the least information in units of noise information; all that are free among them."""
    L = len(leaf_noise)
    leaf_scale = np.where(info.used_leaf, 1.0 / np.sqrt(np.where(leaf_noise > 0.0, leaf_noise, 1.0)), 0.0)
    border_scale = np.where(info.used_border, 1.0 / np.sqrt(np.where(border_noise > 0.0, border_noise, 1.0)), 0.0)
    D = info.leaf * leaf_scale[:, :, None] * leaf_scale[:, None, :]
    C = info.coupling * leaf_scale[:, :, None] * border_scale
    E = info.border * border_scale[:, None] * border_scale
    used = np.r_[info.used_leaf.ravel(), info.used_border]
    size = int(used.sum())
    if size == 0:
        return _Weak(np.zeros(0), np.zeros((len(used), 0)), np.zeros(0))
    if size <= DENSE_PARAMETERS:
        matrix = arrow.dense(D, C, E)[used][:, used]
        values, reduced = np.linalg.eigh(matrix)
    else:
        values, reduced = _weakest_by_lanczos(D, C, E, used)
    vectors = np.zeros((len(used), len(values)))
    vectors[used] = reduced
    # Satterthwaite: a direction spread over frames sums as many squares as its shares of their measurements tell.
    share = np.empty((len(counts), len(values)))
    share[:-1] = (vectors[:-1] ** 2).reshape(len(counts) - 1, 7, -1).sum(axis=1)
    share[-1] = vectors[-1] ** 2
    squares = 1.0 / np.maximum((share**2 / (2.0 * counts[:, None])).sum(axis=0), 1e-300)
    thresholds = _threshold(squares, redundancy)
    order = np.argsort(values / thresholds)
    assert len(used) >= L * 7
    return _Weak(values[order], vectors[:, order], thresholds[order])


def _weakest_by_lanczos(D: Array, C: Array, E: Array, used: np.ndarray) -> tuple[Array, Array]:
    """The smallest eigenpairs by inverse iteration with one arrow factorisation, linear in the leaves."""
    L, m = D.shape[:2]
    shift = 1e-6
    unused = (~used).astype(float)
    leaf_diagonal = unused[: L * m].reshape(L, m) * 1e30 + shift
    border_diagonal = unused[L * m :] * 1e30 + shift
    factor = arrow.cholesky(D + leaf_diagonal[:, :, None] * np.eye(m), C, E + np.diag(border_diagonal))
    if factor is None:
        raise FloatingPointError("the information matrix is not positive semidefinite: its entries overflow")

    def solve(v: Array) -> Array:
        leaf, border = factor.solve(v[: L * m].reshape(L, m, 1), v[L * m :].reshape(-1, 1))
        return np.concatenate([leaf.ravel(), border.ravel()])

    size = len(used)
    count = 12
    operator = LinearOperator((size, size), matvec=solve, dtype=np.float64)
    inverse, vectors = eigsh(operator, k=count, which="LA", v0=np.random.default_rng(0).standard_normal(size) * used)
    values = np.maximum(1.0 / inverse - shift, 0.0)
    return values, vectors[used]


def _pairs(
    part: Part,
    forms: Forms,
    P: Derivative,
    ends: Array,
    own: Array,
    noise: NoiseLevel,
    axes: list[int],
    length: float,
) -> dict[Pair, PairIdentifiability]:
    """Every pair on its own, all in one stack of 15 x 15 problems: two frames' seven parameters, and the scale."""
    index = {name: i for i, name in enumerate(part.free)}
    L, E = len(part.leaves), len(part.pairs)
    S = forms.substitution
    Q = S.transpose(0, 2, 1) @ (forms.edges_translation + forms.edges_rotation) @ S
    tangent = np.zeros((E, 28, 15))
    noise_diagonal = np.zeros((E, 15))
    used = np.zeros((E, 15), dtype=bool)
    owners = set(part.scale_owners)
    for e, pair in enumerate(part.pairs):
        for end, name in enumerate(pair):
            if name not in index:
                continue
            i = index[name]
            slot = 0 if i < L else 1
            rows, columns = slice(13 * slot, 13 * slot + 13), slice(7 * slot, 7 * slot + 7)
            tangent[e, rows, columns] = P.frames[i]
            tangent[e, rows, 14] = P.by_scale[i]
            noise_diagonal[e, 7 * slot : 7 * slot + 6] += ends[e, end]
            used[e, 7 * slot : 7 * slot + 6] = True
            if end == 0 and name in owners:
                noise_diagonal[e, 7 * slot + 6] = own[e]
                used[e, 7 * slot + 6] = True
        tangent[e, 26:, 14] = P.tail
        noise_diagonal[e, 14] = own[e]
        used[e, 14] = part.scale == "shared"
    scaled = tangent * np.where(used, 1.0 / np.sqrt(np.where(used, noise_diagonal, 1.0)), 0.0)[:, None, :]
    matrix = 2.0 * scaled.transpose(0, 2, 1) @ Q @ scaled
    diagonal = np.einsum("eii->ei", matrix)  # a view
    # What a pair does not have is not free; no larger than the rest, or the small eigenvalues lose their digits.
    diagonal[...] = np.where(used, diagonal, 1.0 + diagonal.max(axis=1, keepdims=True))
    values, vectors = np.linalg.eigh(matrix)
    counts = np.array([m.count for m in part.moments])
    threshold = _threshold(2.0 * counts, noise.redundancy)
    result = {}
    for e, pair in enumerate(part.pairs):
        free = values[e] <= threshold[e]
        sentences: list[str] = []
        if free.any():
            names = tuple(dict.fromkeys(name for name in sorted(pair, key=lambda x: index.get(x, -1)) if name in index))
            basis = vectors[e][:, free] / np.sqrt(np.where(used[e], noise_diagonal[e], 1.0))[:, None]
            kept = [7 * (0 if index[name] < L else 1) + k for name in names for k in range(7)] + [14]
            sentences = describe(names, basis[kept], length, dict.fromkeys(names, axes[e]), part.scale)
        result[pair] = PairIdentifiability(
            not free.any(), sentences, axes[e], int(counts[e]), float(values[e, 0]), float(threshold[e])
        )
    return result


def _explanation(pairs: dict[Pair, PairIdentifiability], unique: bool) -> str:
    alone = sum(pair.is_unique for pair in pairs.values())
    if unique and len(pairs) == 1:
        return "The pair's measurements determine both of its frames."
    if unique and alone:
        return (
            f"{alone} of {len(pairs)} pairs determine their frames on their own; along the graph that determines "
            "every frame (Theorem 3)."
        )
    if unique:
        return "No pair determines its frames on its own; together the pairs determine every frame."
    return "The measurements leave some directions free; see free_directions."
