"""What the motion can and cannot determine (RWHEC paper Section 6, design fact 8).

Noise excites every direction a little, so the rank decides nothing on real data. A direction counts as *free* when the
motions give no more information about it than noise alone would create if the true motions left the direction open
(``noise_bounds.pair_noise``). The test divides the information by that of noise alone. For a free direction this ratio
follows an F distribution: squares of noise are divided by a noise variance that nu equations to spare tell. N
measurements have two squares each; tilts of the direction at both its ends fit four of them away. The threshold is the
99.9 % quantile, so a free direction counts as determined once in a thousand times. Three measurements have three to six
equations of rotations to spare and need a ratio of 50 to 9, a hundred measurements need 1.4.

Rotation residuals depend on rotations only, so rotations are tested first. If all are determined, the second test is
about translations and scales at those rotations. If not, one test of everything uses all residuals together.

Corollaries 2 and 4 are the same test on one pair: rotations about two distinct axes leave nothing free. Information
adds along the graph, and the whole is tested as the pairs are. So Theorems 1 and 3 (one determined pair determines all
that is connected) and endnote 9 (pairs that determine only together) need no rule of their own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.identifiability.free_directions import FreeReason, free_directions_of, reason_for, sparse_basis
from gtsam_rwhec.identifiability.information import (
    Information,
    PairInformation,
    information,
    pair_information,
    prior_information,
)
from gtsam_rwhec.identifiability.noise_bounds import (
    DENSE_PARAMETERS,
    PairNoise,
    common_axes,
    fitted_squares,
    pair_noise,
    variance_factors,
)
from gtsam_rwhec.identifiability.threshold import free_threshold
from gtsam_rwhec.identifiability.verdicts import Identifiability, PairIdentifiability
from gtsam_rwhec.problem.moments import T_B
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.solver import arrow
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.residuals import PairPoses

#: Information below this part of the largest is rounding error.
ROUNDING = 4.0 * np.finfo(float).eps
#: Which of a pair's 15 parameters are rotations.
_IS_ROTATION = np.isin(np.arange(15), (0, 1, 2, 7, 8, 9))


@dataclass(frozen=True)
class _Weak:
    """Directions in ascending order of information over threshold: values (k,), thresholds (k,), directions (d, k)."""

    values: Array
    thresholds: Array
    directions: Array

    @property
    def free(self) -> np.ndarray:
        free: np.ndarray = self.values <= self.thresholds
        return free

    @property
    def ratio(self) -> float:
        return float(self.values[0] / self.thresholds[0]) if len(self.values) else np.inf


def identify(part: Part, poses: PairPoses, J_t: Array, J_R: Array) -> Identifiability:
    """Test every direction of a part at an answer, and every direction of each pair alone.

    J_t and J_R (E,) are the costs of the pairs at the answer ``poses``, in the physical model; the noise is estimated
    from them.
    """
    return identify_with_basis(part, poses, J_t, J_R)[0]


def identify_with_basis(part: Part, poses: PairPoses, J_t: Array, J_R: Array) -> tuple[Identifiability, Array]:
    """``identify``, and the free directions with their small shares, which the records leave out.

    The basis (7 n + 1, k) has a column for each record: [omega (rad), v (m), log own scale] for each of ``part.free``,
    then the shared scale's logarithm. It spans exactly what is free.
    """
    pairs = pair_information(part, poses)
    in_target, in_sensor, singular_values = common_axes(part)
    factors = variance_factors(part, pairs, J_t, J_R)
    noise = pair_noise(part, poses, pairs, factors, in_target, in_sensor)
    length = typical_length(part)
    axes, turned = _rotation_axes(part, singular_values, noise)
    residual = np.sqrt(J_R / part.moments.kappa)  # J_R is sum kappa theta^2
    count = part.moments.count.tolist()
    reasons = [reason_for(*of_pair) for of_pair in zip(axes, turned, residual, count, strict=True)]
    weak = _weakest_of_part(part, pairs, noise)
    # A frame has the reason of its pair that turned about most axes; of several such pairs, of the last one.
    of_frame = {
        name: reasons[max((a, e) for e, (a, pair) in enumerate(zip(axes, part.pairs, strict=True)) if name in pair)[1]]
        for name in part.free
    }
    basis = sparse_basis(weak.directions[:, weak.free], length)
    free = free_directions_of(part.free, basis, length, of_frame)
    known = Identifiability(
        is_unique=not free,
        free_directions=free,
        weakest=float(weak.values[0]) if len(weak.values) else np.inf,
        threshold=float(weak.thresholds[0]) if len(weak.values) else 0.0,
        pairs=_pairs(part, pairs, noise, axes, reasons, length),
        parts=(part.names,),
    )
    return known, basis


def _weakest_of_part(part: Part, pairs: PairInformation, noise: PairNoise) -> _Weak:
    """Test rotations; then, if all are determined, the rest at those rotations, and else everything together."""
    index = {name: i for i, name in enumerate(part.free)}
    ends = np.zeros(len(index) + 1)
    for pair, count in zip(part.pairs, part.moments.count, strict=True):
        free = set(pair) & index.keys()
        for name in free:  # a motion's two ends are one frame; a fixed frame leaves both to the other
            ends[index[name]] += 2.0 * count / len(free)
    ends[-1] = part.number_of_measurements
    rotation_prior, translation_prior = prior_information(part)
    turning = information(part, pairs.rotation, noise.rotation, pairs.used & _IS_ROTATION, rotation_prior)
    spare = float(noise.spare.min())
    tests = [_weakest(turning, ends, spare, few=noise.few)]
    if tests[0].free.any():
        everything = information(
            part,
            pairs.rotation + pairs.translation,
            noise.rotation + noise.translation,
            pairs.used,
            rotation_prior + translation_prior,
        )
        tests = [_weakest(everything, ends, min(spare, noise.spare_translation), few=noise.few)]
    else:
        rest = pairs.used & ~_IS_ROTATION
        moving = information(part, pairs.translation, noise.translation, rest, translation_prior)
        tests.append(_weakest(moving, ends, _spare_of_rest(part, noise), few=noise.few))
    return min(tests, key=lambda test: test.ratio)


def _spare_of_rest(part: Part, noise: PairNoise) -> float:
    """The equations to spare that tell the noise of what is not a rotation: only A's noise, where sizes are known."""
    of_carrier = float(noise.spare.min())
    return of_carrier if part.scale == "known" else min(of_carrier, noise.spare_translation)


def typical_length(part: Part) -> float:
    """Root mean square of |t_B|, in metres: the length that counts as one radian in a sentence."""
    square = float(part.moments.squares(T_B).sum())
    return float(np.sqrt(max(square / float(part.moments.weight.sum()), 1e-12)))


def _rotation_axes(part: Part, singular_values: Array, noise: PairNoise) -> tuple[list[int], Array]:
    """About how many axes each pair's A turned (0, 1 or 2), and by how much (E,): root mean square, in rad.

    Corollary 2, tested against A's noise. The mean of R_A shortens every direction but a common axis: 1 - s^2 of its
    singular values (E, 3) is the mean square sine of the turning that leaves that direction. Noise alone makes it
    2 q^2. The axis is fitted at both ends.
    """
    ratio = (1.0 - singular_values**2) / (2.0 * noise.carrier[:, None])
    threshold = free_threshold(2.0 * part.moments.count, 4.0 * noise.few, noise.spare)
    excited = (ratio > threshold[:, None]).sum(axis=1)
    return [(0, 1, 1, 2)[k] for k in excited], np.sqrt(np.maximum(1.0 - singular_values[:, -1] ** 2, 0.0))


def _weakest(info: Information, ends: Array, spare: float, *, few: bool) -> _Weak:
    """The directions with the smallest information in units of noise; all free directions are among them.

    ``ends`` (n + 1,): how many ends of measurements each frame has, and how many measurements the shared scale.
    """
    used = info.used
    unit = _unit(info.noise, used)
    leaf_unit, border_unit = unit[: info.leaf[:, 0].size].reshape(-1, 7), unit[info.leaf[:, 0].size :]
    D = info.leaf * leaf_unit[:, :, None] * leaf_unit[:, None, :]
    C = info.coupling * leaf_unit[:, :, None] * border_unit
    E = info.border * border_unit[:, None] * border_unit
    if not all(np.isfinite(each).all() for each in (D, C, E)):
        raise UnderdeterminedError(
            "what the measurements tell of the poses overflows: the translations of A and of B, or a scale, are "
            "far beyond anything measured in metres; give lengths in metres"
        )
    size = int(used.sum())
    if size == 0:
        return _Weak(np.zeros(0), np.zeros(0), np.zeros((len(used), 0)))
    if size <= DENSE_PARAMETERS:
        values, reduced = np.linalg.eigh(arrow.dense(D, C, E)[used][:, used])
        values[values < ROUNDING * values[-1]] = 0.0
    else:
        # Each direction has at least two squares, and the threshold is the highest for the fewest squares.
        values, reduced = _weakest_by_lanczos(D, C, E, used, float(free_threshold(2.0, 0.0, spare)))
    vectors = np.zeros((len(used), len(values)))
    vectors[used] = reduced
    # By Satterthwaite, the squares that a direction sums follow from its shares of the frames' measurements. A tilt of
    # the direction at a frame fits two of them away.
    of_parameters = vectors**2
    share = np.empty((len(ends), len(values)))
    of_frames = of_parameters[:-1].reshape(len(ends) - 1, 7, len(values))
    share[:-1], share[-1] = of_frames.sum(axis=1), of_parameters[-1]
    squares = 1.0 / np.maximum((share**2 / ends[:, None]).sum(axis=0), 1e-300)
    tilted = 2.0 / ends[:-1] @ of_frames[:, :6].sum(axis=1) if few else 0.0
    thresholds = free_threshold(squares, tilted * squares, spare)
    order = np.argsort(values / thresholds)
    return _Weak(values[order], thresholds[order], vectors[:, order] * unit[:, None])


def _unit(noise: Array, used: np.ndarray) -> Array:
    """The factor that brings a parameter to units of its noise; 0 for an unused parameter."""
    result: Array = np.where(used, 1.0 / np.sqrt(np.where(used, noise, 1.0)), 0.0)
    return result


def _weakest_by_lanczos(D: Array, C: Array, E: Array, used: np.ndarray, enough: float) -> tuple[Array, Array]:
    """The smallest eigenpairs, up to one above ``enough``, by Lanczos on the inverse; time linear in the leaves."""
    L, m = D.shape[:2]
    largest = max(np.einsum("lii->li", D).max(initial=0.0), np.diagonal(E).max(initial=0.0))
    shift = max(1e-6, 1e-13 * float(largest))  # above the factorisation's rounding, far below any threshold
    unused = (~used).astype(float)
    leaf_diagonal = unused[: L * m].reshape(L, m) * 1e30 + shift
    border_diagonal = unused[L * m :] * 1e30 + shift
    factor = arrow.cholesky(D + leaf_diagonal[:, :, None] * np.eye(m), C, E + np.diag(border_diagonal))
    if factor is None:
        raise FloatingPointError("the information matrix is not positive semidefinite: its entries overflow")

    from scipy.sparse.linalg import LinearOperator, eigsh  # slow to import, and few problems need it

    size = len(used)
    operator = LinearOperator((size, size), matvec=factor.solve_vector, dtype=np.float64)
    start = np.random.default_rng(0).standard_normal(size) * used
    count = 12
    while 4 * count < size:
        inverse, vectors = eigsh(operator, k=count, which="LA", v0=start)
        values = np.maximum(1.0 / inverse - shift, 0.0)
        if values.max() > enough:
            return values, vectors[used]
        count *= 4
    # Lanczos is not faster with so many free directions.
    everything = np.linalg.eigh(arrow.dense(D, C, E)[used][:, used])
    return everything.eigenvalues, everything.eigenvectors


def _pairs(
    part: Part,
    pairs: PairInformation,
    noise: PairNoise,
    axes: list[int],
    reasons: list[FreeReason],
    length: float,
) -> dict[Pair, PairIdentifiability]:
    """Test every pair alone, in the way the whole problem is tested; all pairs are one stack of 15 x 15 problems."""
    counts = part.moments.count
    squares, fitted = 2.0 * counts, noise.few * fitted_squares(part)
    rotations = pairs.used & _IS_ROTATION
    turning, _ = _weakest_of_each(pairs.rotation, noise.rotation, rotations)
    of_turning = free_threshold(squares, fitted, noise.spare)
    settled = np.all(turning > of_turning[:, None], axis=1, keepdims=True)
    rest, directions = _weakest_of_each(
        pairs.translation + ~settled[:, :, None] * pairs.rotation,
        noise.translation + ~settled * noise.rotation,
        pairs.used & ~(_IS_ROTATION & settled),
    )
    with_translations = np.minimum(noise.spare, noise.spare_translation)
    spare = np.where(settled[:, 0] & (part.scale == "known"), noise.spare, with_translations)
    other, threshold = spare != noise.spare, of_turning.copy()
    threshold[other] = free_threshold(squares[other], fitted[other], spare[other])
    result = {}
    for e, pair in enumerate(part.pairs):
        free = np.less_equal(rest[e], threshold[e])
        ends = {name: 7 * end for end, name in enumerate(pair) if name not in part.fixed}
        if not free.any() and axes[e] < 2 and len(ends) == 2:
            free[rest[e].argmin()] = True  # Corollary 4: a pair that turns about one axis leaves a direction free
        rows = [first + k for first in ends.values() for k in range(7)] + [14]
        basis = sparse_basis(directions[e][rows][:, free], length)
        directions_free = free_directions_of(tuple(ends), basis, length, dict.fromkeys(ends, reasons[e]))
        tests = [(float(rest[e].min()), float(threshold[e]))]
        if settled[e, 0]:
            tests.append((float(turning[e].min()), float(of_turning[e])))
        weakest, up_to = min(tests, key=lambda test: test[0] / test[1])
        result[pair] = PairIdentifiability(not free.any(), directions_free, axes[e], int(counts[e]), weakest, up_to)
    return result


def _weakest_of_each(info: Array, noise: Array, used: np.ndarray) -> tuple[Array, Array]:
    """Eigenvalues (E, 15) in units of noise and directions (E, 15, 15); infinite for parameters that are not used."""
    unit = _unit(noise, used)
    matrix = info * unit[:, :, None] * unit[:, None, :]
    diagonal = np.einsum("eii->ei", matrix)  # a view
    # Unused parameters get large entries, but no larger than needed: small eigenvalues would lose digits.
    diagonal[...] = np.where(used, diagonal, 1e3 + 2.0 * diagonal.max(axis=1, keepdims=True))
    values, vectors = np.linalg.eigh(matrix)
    values[values < ROUNDING * diagonal.max(axis=1, keepdims=True)] = 0.0
    foreign = (vectors**2 * ~used[:, :, None]).sum(axis=1) > 0.5
    return np.where(foreign, np.inf, values), vectors * unit[:, :, None]
