"""What each pair determines alone: the test of the whole problem, on 15 x 15 matrices of some pairs at a time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.identifiability.free_directions import (
    FreeDirection,
    FreeReason,
    free_directions_of,
    reason_for,
    sparse_basis,
)
from gtsam_rwhec.identifiability.information import IS_ROTATION, PairInformation
from gtsam_rwhec.identifiability.noise_bounds import PairNoise, fitted_squares
from gtsam_rwhec.identifiability.threshold import free_threshold
from gtsam_rwhec.identifiability.verdicts import PairIdentifiability
from gtsam_rwhec.identifiability.weak_directions import ROUNDING, unit_of
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.problem.moments import T_B
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.solver.parts import Part


def typical_length(part: Part) -> float:
    """Root mean square of |t_B|, in metres: the length that counts as one radian in a sentence."""
    square = float(part.moments.squares(T_B).sum())
    return float(np.sqrt(max(square / float(part.moments.weight.sum()), 1e-12)))


@dataclass(frozen=True)
class PairsAlone:
    """The pairs of a part, what they tell, and the noise."""

    pairs: tuple[Pair, ...]
    free: tuple[str, ...]
    ends: np.ndarray  #: (E, 2), as in the part
    scale: ScaleMode
    counts: np.ndarray  #: (E,)
    fitted: Array  #: (E,): squares of noise that tilts of a free direction fit away
    information: PairInformation
    noise: PairNoise
    axes: np.ndarray  #: (E,): about how many axes A turned, 0, 1 or 2
    turned_rad: Array  #: (E,): root mean square of A's turning
    residual_rad: Array  #: (E,): root mean square of the rotation residuals
    length: float  #: metres that count as one radian

    @staticmethod
    def of(
        part: Part, information: PairInformation, noise: PairNoise, singular_values: Array, J_R: Array
    ) -> PairsAlone:
        """The pairs of a part; ``singular_values`` (E, 3) are of the mean of R_A, and J_R (E,) the costs.

        Axes by Corollary 2, tested against A's noise: the mean of R_A shortens every direction but a common axis, and
        1 - s^2 is the mean square sine of the turning that leaves that direction. Noise alone makes it 2 q^2. The axis
        is fitted at both ends.
        """
        counts = part.moments.count
        ratio = (1.0 - singular_values**2) / (2.0 * noise.carrier[:, None])
        threshold = free_threshold(2.0 * counts, 4.0 * noise.few, noise.spare)
        excited = (ratio > threshold[:, None]).sum(axis=1)
        return PairsAlone(
            part.pairs,
            part.free,
            part.ends,
            part.scale,
            counts,
            noise.few * fitted_squares(part),
            information,
            noise,
            np.array([0, 1, 1, 2])[excited],
            np.sqrt(np.maximum(1.0 - singular_values[:, -1] ** 2, 0.0)),
            np.sqrt(J_R / part.moments.kappa),  # J_R is sum kappa theta^2
            typical_length(part),
        )

    def reason(self, e: int) -> FreeReason:
        """Why a direction of a pair is free."""
        of_pair = int(self.axes[e]), float(self.turned_rad[e]), float(self.residual_rad[e]), int(self.counts[e])
        return reason_for(*of_pair)

    def reasons_of_frames(self) -> Mapping[str, FreeReason]:
        """A frame has the reason of its pair that turned about most axes; of several such pairs, of the last one."""
        n, E = len(self.free), len(self.pairs)
        best = np.zeros(n + 1, dtype=np.int64)
        key = self.axes.astype(np.int64) * E + np.arange(E)
        for side in self.ends.T:
            np.maximum.at(best, np.minimum(side, n), key)
        return {name: self.reason(int(best[i]) % E) for i, name in enumerate(self.free)}

    def verdicts(self, at: slice = slice(None)) -> dict[Pair, PairIdentifiability]:
        """Test some pairs, each alone, in the way the whole problem is tested."""
        info, noise = self.information, self.noise
        spare, counts, fitted = noise.spare[at], self.counts[at], self.fitted[at]
        squares, used = 2.0 * counts, info.used[at]
        of_rotation = info.rotation(at)
        turning, _ = _weakest_of_each(of_rotation, noise.rotation[at], used & IS_ROTATION)
        of_turning = free_threshold(squares, fitted, spare)
        settled = np.all(turning > of_turning[:, None], axis=1, keepdims=True)
        rest, directions = _weakest_of_each(
            info.translation(at) + ~settled[:, :, None] * of_rotation,
            noise.translation[at] + ~settled * noise.rotation[at],
            used & ~(IS_ROTATION & settled),
        )
        with_translations = np.minimum(spare, noise.spare_translation)
        of_rest = np.where(settled[:, 0] & (self.scale == "known"), spare, with_translations)
        other, threshold = of_rest != spare, of_turning.copy()
        threshold[other] = free_threshold(squares[other], fitted[other], of_rest[other])
        result = {}
        begin = at.indices(len(self.pairs))[0]
        for i, pair in enumerate(self.pairs[at]):
            e = begin + i
            free = np.less_equal(rest[i], threshold[i])
            ends = {name: 7 * end for end, name in enumerate(pair) if self.ends[e, end] < len(self.free)}
            if not free.any() and self.axes[e] < 2 and len(ends) == 2:
                free[rest[i].argmin()] = True  # Corollary 4: a pair that turns about one axis leaves a direction free
            directions_free: tuple[FreeDirection, ...] = ()
            if free.any():
                rows = [first + k for first in ends.values() for k in range(7)] + [14]
                basis = sparse_basis(directions[i][rows][:, free], self.length)
                reasons = dict.fromkeys(ends, self.reason(e))
                directions_free = free_directions_of(tuple(ends), basis, self.length, reasons)
            tests = [(float(rest[i].min()), float(threshold[i]))]
            if settled[i, 0]:
                tests.append((float(turning[i].min()), float(of_turning[i])))
            least, up_to = min(tests, key=lambda test: test[0] / test[1])
            result[pair] = PairIdentifiability(
                not free.any(), directions_free, int(self.axes[e]), int(counts[i]), least, up_to
            )
        return result


def _weakest_of_each(info: Array, noise: Array, used: np.ndarray) -> tuple[Array, Array]:
    """Eigenvalues (E, 15) in units of noise and directions (E, 15, 15); infinite for parameters that are not used."""
    unit = unit_of(noise, used)
    matrix = info * unit[:, :, None] * unit[:, None, :]
    diagonal = np.einsum("eii->ei", matrix)  # a view
    # Unused parameters get large entries, but no larger than needed: small eigenvalues would lose digits.
    diagonal[...] = np.where(used, diagonal, 1e3 + 2.0 * diagonal.max(axis=1, keepdims=True))
    values, vectors = np.linalg.eigh(matrix)
    values[values < ROUNDING * diagonal.max(axis=1, keepdims=True)] = 0.0
    foreign = (vectors**2 * ~used[:, :, None]).sum(axis=1) > 0.5
    return np.where(foreign, np.inf, values), vectors * unit[:, :, None]
