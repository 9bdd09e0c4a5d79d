"""What each pair determines alone: the test of the whole problem, applied to one 15 x 15 matrix for each pair."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gtsam_rwhec.files.terminal_text import counted
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.moments import T_B
from gtsam_rwhec.solver.answers import PairPoses
from gtsam_rwhec.solver.elimination import Elimination
from gtsam_rwhec.solver.free_directions import FreeDirection, FreeReason, free_directions_of, reason_for, sparse_basis
from gtsam_rwhec.solver.information import (
    IS_ROTATION,
    PairInformation,
    PartInformation,
    by_parameters,
    pair_information,
)
from gtsam_rwhec.solver.noise_bounds import (
    PairNoise,
    common_axes,
    fitted_squares,
    free_threshold,
    pair_noise,
    variance_factors,
)
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.weak_directions import ROUNDING, Weak, unit_of, weakest

#: At most this many pairs are tested at once.
TESTED_AT_ONCE = 256


@dataclass(frozen=True)
class PairIdentifiability:
    """What one pair determines alone.

    ``rotation_axes``: about how many axes its motion turned, 0, 1, or 2 for two and more (Corollary 2). ``weakest`` is
    the information of the weakest direction, in units of the information that noise alone would create; up to
    ``threshold`` the direction is free.
    """

    is_unique: bool
    free_directions: tuple[FreeDirection, ...]
    rotation_axes: int
    number_of_measurements: int
    weakest: float
    threshold: float


@dataclass(frozen=True)
class Identifiability:
    """What a problem's measurements determine. ``str()`` is a sentence about the pairs and the whole problem.

    ``free_directions`` span all that is free; ``weakest`` and ``threshold`` are as in `PairIdentifiability`, of the
    whole. ``pairs`` has each pair alone, the grid of the paper's Figure 8, tested when it is asked for; ``parts`` the
    frames of each unconnected part.
    """

    is_unique: bool
    free_directions: tuple[FreeDirection, ...]
    weakest: float
    threshold: float
    pairs: Mapping[Pair, PairIdentifiability]
    parts: tuple[tuple[str, ...], ...]

    @staticmethod
    def merged(results: list[Identifiability], components: tuple[tuple[str, ...], ...]) -> Identifiability:
        """One result for parts that were solved separately."""
        weakest = min(results, key=lambda r: r.weakest / max(r.threshold, 1e-300))
        return Identifiability(
            is_unique=all(r.is_unique for r in results),
            free_directions=tuple(direction for r in results for direction in r.free_directions),
            weakest=weakest.weakest,
            threshold=weakest.threshold,
            pairs=PairVerdicts(
                [alone for r in results if isinstance(r.pairs, PairVerdicts) for alone in r.pairs.parts]
            ),
            parts=components,
        )

    def __str__(self) -> str:
        if not self.is_unique:
            left = counted(len(self.free_directions), "direction")
            return f"The measurements leave {left} free; see free_directions."
        alone, number = sum(pair.is_unique for pair in self.pairs.values()), len(self.pairs)
        if number == 1:
            return "The pair's measurements determine both of its frames."
        if not alone:
            return "No pair determines its frames on its own; together the pairs determine every frame."
        which = f"Each of the {number} pairs determines its own frames"
        if alone < number:
            own = "determines its own frames" if alone == 1 else "determine their own frames"
            which = f"{alone} of {number} pairs {own}, and the other pairs connect the rest to them"
        return f"{which}, so every frame is determined (RWHEC paper, Theorem 3)."


def typical_length(part: Part) -> float:
    """Root mean square of |t_B|, in metres: the length that counts as one radian in a sentence."""
    square = float(part.moments.squares(T_B).sum())
    return float(np.sqrt(max(square / float(part.moments.weight.sum()), 1e-12)))


@dataclass(frozen=True)
class PairsAlone:
    """The pairs of a part, their information, and the noise."""

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
    sliding: frozenset[str] = frozenset()  #: targets that slide

    @staticmethod
    def of(
        part: Part, information: PairInformation, noise: PairNoise, singular_values: Array, J_R: Array
    ) -> PairsAlone:
        """The pairs of a part; ``singular_values`` (E, 3) are of the mean of R_A, and J_R (E,) the costs.

        Axes by Corollary 2, tested against A's noise: the mean of R_A shortens every direction but a common axis, and
        1 - s^2 is the mean square sine of the turning that leaves that direction. Noise alone makes this 2 q^2. The
        axis is fitted at both ends.
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
        of_noise = float(self.turned_rad[e]), float(self.residual_rad[e])
        return reason_for(int(self.axes[e]), *of_noise, int(self.counts[e]))

    def reasons_of_frames(self) -> Mapping[str, FreeReason]:
        """A frame has the reason of its pair that turned about most axes; of several such pairs, of the last one."""
        n, E = len(self.free), len(self.pairs)
        best = np.zeros(n + 1, dtype=np.int64)
        key = self.axes.astype(np.int64) * E + np.arange(E)
        for side in self.ends.T:
            np.maximum.at(best, np.minimum(side, n), key)
        return {name: self.reason(int(best[i]) % E) for i, name in enumerate(self.free)}

    @one_blas_thread()
    @np.errstate(all="ignore")
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
        free = rest <= threshold[:, None]
        ends, axes = self.ends[at] < len(self.free), self.axes[at]
        # Corollary 4: a pair that turns about one axis leaves a direction free.
        open_ = np.flatnonzero(~free.any(axis=1) & (axes < 2) & ends.all(axis=1))
        free[open_, rest[open_].argmin(axis=1)] = True
        # The weaker of two tests counts: that of the rotations, where they are determined, and that of the rest.
        weakest, limit = rest.min(axis=1), threshold.copy()
        of_rotations = turning.min(axis=1)
        by_rotations = settled[:, 0] & (of_rotations * limit < weakest * of_turning)
        weakest[by_rotations], limit[by_rotations] = of_rotations[by_rotations], of_turning[by_rotations]
        begin = at.indices(len(self.pairs))[0]
        some = np.flatnonzero(free.any(axis=1)).tolist()
        found = {e: self._free_directions(begin + e, directions[e][:, free[e]]) for e in some}
        each = zip(self.pairs[at], axes.tolist(), counts.tolist(), weakest.tolist(), limit.tolist(), strict=True)
        return {
            pair: PairIdentifiability(e not in found, found.get(e, ()), turned, count, least, up_to)
            for e, (pair, turned, count, least, up_to) in enumerate(each)
        }

    def _free_directions(self, e: int, directions: Array) -> tuple[FreeDirection, ...]:
        """The records of a pair's free directions (15, k)."""
        ends = {name: 7 * end for end, name in enumerate(self.pairs[e]) if self.ends[e, end] < len(self.free)}
        rows = [first + k for first in ends.values() for k in range(7)] + [14]
        reasons = dict.fromkeys(ends, self.reason(e))
        found = free_directions_of(tuple(ends), sparse_basis(directions[rows], self.length), self.length, reasons)
        return _that_slide(found, self.sliding)


def _that_slide(free: tuple[FreeDirection, ...], sliding: frozenset[str]) -> tuple[FreeDirection, ...]:
    """The directions, with the reason of those that are of sliding targets alone."""
    return tuple(
        replace(one, reason=FreeReason.SLIDES) if sliding.issuperset(one.frames) and one.frames else one for one in free
    )


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


class PairVerdicts(Mapping[Pair, PairIdentifiability]):
    """What each pair determines alone, tested when it is asked for, some pairs at a time: a mapping like a dict.

    A copy, and what is pickled, is a dict with all verdicts.
    """

    def __init__(self, parts: Sequence[PairsAlone]) -> None:
        self.parts = tuple(parts)
        self._known: dict[Pair, PairIdentifiability] = {}

    @cached_property
    def _place(self) -> dict[Pair, tuple[PairsAlone, int]]:
        return {pair: (part, e) for part in self.parts for e, pair in enumerate(part.pairs)}

    def __getitem__(self, pair: Pair) -> PairIdentifiability:
        if pair not in self._known:
            part, e = self._place[pair]
            begin = e - e % TESTED_AT_ONCE
            self._known |= part.verdicts(slice(begin, begin + TESTED_AT_ONCE))
        return self._known[pair]

    def __iter__(self) -> Iterator[Pair]:
        return iter(self._place)

    def __len__(self) -> int:
        return len(self._place)

    def __eq__(self, other: object) -> bool:
        return dict(self) == (dict(other) if isinstance(other, Mapping) else other)

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[type[dict[Pair, PairIdentifiability]], tuple[dict[Pair, PairIdentifiability]]]:
        return dict, (dict(self),)


def identify(part: Part, poses: PairPoses, J_t: Array, J_R: Array, order: Elimination | None = None) -> Identifiability:
    """Test every direction of a part at an answer, and every direction of each pair alone.

    J_t and J_R (E,) are the costs of the pairs at the answer ``poses``, in the physical model; the noise is estimated
    from them. ``order`` is that of the part's frames, where it is known already.
    """
    return identify_with_basis(part, poses, J_t, J_R, order)[0]


def identify_with_basis(
    part: Part, poses: PairPoses, J_t: Array, J_R: Array, order: Elimination | None = None
) -> tuple[Identifiability, Array]:
    """``identify``, and a basis of the free directions that also has the small shares, which the records leave out.

    The basis (7 n + 1, k) has a column for each record: [omega (rad), v (m), log own scale] for each of ``part.free``,
    then the shared scale's logarithm. It spans exactly what is free.
    """
    pairs = pair_information(part, poses)
    in_target, in_sensor, singular_values = common_axes(part)
    told = PartInformation.of(part, pairs, order)
    factors = variance_factors(part, told, J_t, J_R)
    noise = pair_noise(part, poses, pairs, factors, in_target, in_sensor)
    alone = PairsAlone.of(part, pairs, noise, singular_values, J_R)
    weak = _weakest_of_part(part, told, noise)
    basis = sparse_basis(weak.directions[:, weak.free], alone.length)
    free = free_directions_of(part.free, basis, alone.length, alone.reasons_of_frames() if basis.shape[1] else {})
    sliding = frozenset(part.pairs[each.e].target for each in part.directed if each.slides) & frozenset(part.targets)
    free = _that_slide(free, sliding)
    known = Identifiability(
        is_unique=not free,
        free_directions=free,
        weakest=float(weak.values[0]) if len(weak.values) else np.inf,
        threshold=float(weak.thresholds[0]) if len(weak.values) else 0.0,
        pairs=PairVerdicts([replace(alone, sliding=sliding)]),
        parts=(part.names,),
    )
    return known, basis


def _weakest_of_part(part: Part, told: PartInformation, noise: PairNoise) -> Weak:
    """Test the rotations. If all are determined, test the rest at fixed rotations; else test everything together."""
    n, count = len(part.free), part.moments.count
    is_free = part.ends < n
    # A motion's two ends are one frame; a fixed frame leaves both to the other.
    of_each = 2.0 * count / np.maximum(is_free.sum(axis=1), 1)
    sums = [np.bincount(part.ends[has, side], of_each[has], minlength=n) for side, has in enumerate(is_free.T)]
    ends = np.append(sums[0] + sums[1], float(part.number_of_measurements))
    of_rotations, of_translations = (by_parameters(part, each) for each in (noise.rotation, noise.translation))
    spare, few, turns = float(noise.spare.min()), noise.few, told.used & told.is_rotation
    tests = [weakest(told.rotation, of_rotations, turns, ends, spare, few=few)]
    if tests[0].free.any():
        of_all = of_rotations + of_translations
        spare = min(spare, noise.spare_translation)
        tests = [weakest(told.together, of_all, told.used, ends, spare, few=few)]
    else:
        # Where sizes are known, only A's noise passes for information about parameters other than rotations.
        spare = spare if part.scale == "known" else min(spare, noise.spare_translation)
        tests.append(weakest(told.translation, of_translations, told.used & ~turns, ends, spare, few=few))
    return min(tests, key=lambda test: test.ratio)
