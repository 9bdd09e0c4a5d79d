"""Measurements of many pairs in one call: checked and sorted by pair, without a loop over measurements."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from numpy.typing import ArrayLike

from gtsam_rwhec.errors import CountError, FrameError, PoseError, StampError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.poses import ROTATION_ROUNDING, Array, checked_rows, orthonormality, rows_to_transforms
from gtsam_rwhec.geometry.rounding import UNIT
from gtsam_rwhec.problem.knowledge import check_name
from gtsam_rwhec.problem.measurements import GivenMeasurements, LongTranslations, Measurements, Pair, whole_stamps
from gtsam_rwhec.problem.moment_stack import BACK_ENTRIES, FRONT, FRONT_ENTRIES, MomentStack
from gtsam_rwhec.problem.moments import BLOCK, ONE, R_A, R_B, T_A, T_B, Gauge

#: This many measurements are summed at once: some megabytes.
SUMMED_AT_ONCE = 4096
#: Pairs that are summed together have at least this part of the longest one's measurements, so that little is padding.
FULL = 0.6
#: Positions, in the features without B's rotation, of the entries of their triangle.
_OF_FRONT = np.searchsorted(FRONT, FRONT_ENTRIES[0]), np.searchsorted(FRONT, FRONT_ENTRIES[1])


@dataclass(frozen=True)
class Sorted:
    """Measurements of P pairs, sorted by pair: those of pair p are ``first[p]:first[p + 1]``.

    A, B (N, 4, 4); sigma, kappa () or (N,); stamps_ns (N,), covariances (N, 6, 6), pixels (N, n, 2), kinds (N,), or
    None.
    ``given`` (N,): their places in the user's arrays, for messages; None where these have the same order.
    """

    pairs: tuple[Pair, ...]
    first: np.ndarray
    A: Array
    B: Array
    sigma: Array
    kappa: Array
    given: np.ndarray | None
    source: str
    stamps_ns: np.ndarray | None = None
    covariances: Array | None = None
    pixels: Array | None = None
    kinds: np.ndarray | None = None

    @staticmethod
    def of(pair: Pair, raw: Measurements, source: str = "") -> Sorted:
        """The measurements of one pair, without a copy."""
        return Sorted(
            (pair,), np.array([0, len(raw.A)]), raw.A, raw.B, raw.sigma, raw.kappa, None, source, *raw.options
        )

    @staticmethod
    def for_moments(measurements: Mapping[Pair, Measurements]) -> Iterator[Sorted]:
        """The measurements of many pairs, as many of them together as are summed at once."""
        ends = np.cumsum([len(raw.A) for raw in measurements.values()])
        for _, group in groupby(zip(measurements.items(), ends // SUMMED_AT_ONCE, strict=True), lambda each: each[1]):
            pairs, raws = zip(*(item for item, _ in group), strict=True)
            if len(pairs) == 1:
                yield Sorted.of(pairs[0], raws[0])
                continue
            count = [len(raw.A) for raw in raws]
            A, B, sigma, kappa = (
                np.concatenate([getattr(raw, of) for raw in raws]) for of in ("A", "B", "sigma", "kappa")
            )
            given = np.concatenate([np.arange(number) for number in count])
            yield Sorted(pairs, np.r_[0, np.cumsum(count)], A, B, sigma, kappa, given, "")

    def copied(self) -> Sorted:
        """A copy of the poses, which are the caller's arrays."""
        return replace(self, A=self.A.copy(), B=self.B.copy())

    @property
    def some(self) -> slice:
        """At most `BLOCK` measurements, spread over all of them: a log begins at rest, so its first are not enough."""
        return slice(None, None, -(-len(self.A) // BLOCK))

    def sample(self) -> tuple[Array, np.ndarray]:
        """Some poses of A, and which of them are motions."""
        places = np.arange(0, len(self.A), self.some.step)
        return self.A[places], self.motion[np.searchsorted(self.first, places, side="right") - 1]

    def long_translations(self, gauge: Gauge, where: str) -> LongTranslations:
        """Translations that are too long for metres."""
        motion, from_corners = bool(self.motion.all()), self.pixels is not None
        A, B = self.A[self.some], self.B[self.some]
        return LongTranslations.of(A, B, gauge, where, motion=motion, from_corners=from_corners)

    @property
    def counts(self) -> np.ndarray:
        """(P,) numbers of measurements."""
        return np.diff(self.first)

    @property
    def motion(self) -> np.ndarray:
        """(P,): whether both ends are the sensor's carrier."""
        return np.array([pair.is_motion for pair in self.pairs], dtype=bool)

    def section(self, pair: int) -> slice:
        """Where the measurements of a pair are."""
        return slice(int(self.first[pair]), int(self.first[pair + 1]))

    def projected(self) -> Sorted:
        """The measurements with the rotations that the moments are made of."""
        A, B = self.A.copy(), self.B.copy()
        for poses in (A, B):
            for begin in range(0, len(poses), BLOCK):
                block = poses[begin : begin + BLOCK]
                block[...] = rows_to_transforms(checked_rows(block, begin, self.source).rows)
        return replace(self, A=A, B=B)

    def padded(self, group: np.ndarray, begin: int = 0, most: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Places (p, k) of the measurements of some pairs, and which of them are no padding (a pair's last, again).

        Up to ``most`` of each pair, counted from ``begin``.
        """
        counts = self.counts[group][:, None]
        longest = int(counts.max())
        step = np.arange(begin, longest if most is None else min(longest, begin + most))
        return self.first[group][:, None] + np.minimum(step, counts - 1), step < counts

    def groups(self, pairs: np.ndarray) -> Iterator[np.ndarray]:
        """Groups of pairs of similar size, up to `SUMMED_AT_ONCE` measurements each; a larger pair is alone."""
        counts = self.counts[pairs]
        order = np.argsort(-counts, kind="stable")
        descending, order = counts[order], pairs[order]
        begin = 0
        while begin < len(order):
            longest = int(descending[begin])
            alike = int(np.searchsorted(-descending, -FULL * longest, side="right"))
            end = min(max(alike, begin + 1), begin + max(1, SUMMED_AT_ONCE // longest))
            yield order[begin:end]
            begin = end

    def moments(self, gauge: Gauge, *, with_R_B: bool) -> MomentStack:
        """The moments of every pair; a PoseError names the first pose of a block that is not valid."""
        result = MomentStack.nothing(self.motion, with_R_B=with_R_B)
        for group in self.groups(np.arange(len(self.pairs))):
            # Only a pair that is alone has more than a block.
            for begin in range(0, int(self.counts[group[0]]), SUMMED_AT_ONCE):
                result.add_to(group, self._summed(group, begin, gauge, with_R_B=with_R_B))
        return result

    def _weights(self, at: np.ndarray) -> tuple[Array, Array]:
        """1 / sigma^2 and kappa of measurements."""
        sigma, kappa = (each if each.ndim == 0 else each[at] for each in (self.sigma, self.kappa))
        return np.broadcast_to(1.0 / sigma**2, at.shape), np.broadcast_to(kappa, at.shape)

    def _summed(self, group: np.ndarray, begin: int, gauge: Gauge, *, with_R_B: bool) -> MomentStack:
        """The moments of a block of measurements of some pairs."""
        places, valid = self.padded(group, begin, SUMMED_AT_ONCE)
        result = MomentStack.nothing(self.motion[group], with_R_B=with_R_B)
        result.count[:] = valid.sum(axis=1)
        p, k = places.shape
        flat, features = places.ravel(), np.empty((25, p * k))
        try:
            of_A = checked_rows(self.A[flat], 0, "A", features[:12])
            of_B = checked_rows(self.B[flat], 0, "B", features[12:24])
        except PoseError:
            self._name(flat[valid.ravel()])
            raise
        f = features.reshape(25, p, k)
        if of_A.projected or of_B.projected:
            off = [orthonormality(_columns(poses[flat])) > ROTATION_ROUNDING for poses in (self.A, self.B)]
            result.projected[:] = (np.sum(off, axis=0).reshape(p, k) * valid).sum(axis=1)
        reach = np.abs(f[T_A]).max(axis=2)  # (3, p)
        a = gauge.sensor_carrier[:, None]
        c = np.where(result.motion, a, gauge.target_carrier[:, None])  # (3, p)
        f[T_A] += c[0, :, None] * f[0:3] + c[1, :, None] * f[3:6] + c[2, :, None] * f[6:9] - a[:, :, None]
        f[ONE] = 1.0
        weight, kappa = self._weights(places)
        result.longest_as_summed[:] = np.stack([np.linalg.norm(f[of], axis=0).max(axis=1) for of in (T_A, T_B)], axis=1)
        weight, kappa = weight * valid, kappa * valid
        kept = np.arange(25) if result.back is not None else FRONT
        rows = np.ascontiguousarray(f[kept].transpose(1, 0, 2))  # (p, features, k)
        products = np.matmul(rows * weight[:, None, :], rows.transpose(0, 2, 1))
        total = weight.sum(axis=1)
        products[:, -1, -1] = total
        if result.back is None:
            result.front[:] = products[:, _OF_FRONT[0], _OF_FRONT[1]]
            diagonal = np.zeros((p, 25))
            diagonal[:, FRONT] = np.einsum("eii->ei", products)
            # Each column of a rotation has length 1, up to rounding: other rotations were projected.
            diagonal[:, R_B] = ((f[R_B] ** 2) * weight).sum(axis=2).T
        else:
            result.front[:] = products[:, FRONT_ENTRIES[0], FRONT_ENTRIES[1]]
            result.back[:] = products[:, BACK_ENTRIES[0], BACK_ENTRIES[1]]
            diagonal = np.einsum("eii->ei", products)
        turned = np.matmul((f[R_A] * kappa).transpose(1, 0, 2), f[R_B].transpose(1, 2, 0))
        result.rotation[:] = turned.reshape(p, 81)
        result.kappa[:] = kappa.sum(axis=1)
        result.magnitude_as_summed[:] = np.sqrt(diagonal) * (1.0 + 1e-9)
        centring = 8.0 * UNIT * (reach + np.abs(c).sum(axis=0) + np.abs(a))
        result.error_as_summed[:] = (centring * np.sqrt(total)).T
        # The weight and its products take up to six operations; then a pair's measurements are summed.
        result.operations_as_summed[:] = result.count + 7
        # The rounding of the test of R'R itself is added.
        result.deviation[:] = max(of_A.deviation, of_B.deviation) + 8.0 * UNIT
        return result

    def _name(self, places: np.ndarray) -> None:
        """Raise the PoseError of the first measurement that is not valid: its pair, and its place in the arrays."""
        for place in np.sort(places):
            pair = self.pairs[int(np.searchsorted(self.first, place, side="right")) - 1]
            for name, poses in (("A", self.A), ("B", self.B)):
                where = f"{name} of {pair}{self.source}"
                given = place if self.given is None else self.given[place]
                checked_rows(poses[place : place + 1], int(given), where)


def _columns(poses: Array) -> Array:
    """vec(R) of poses (n, 4, 4) as (9, n)."""
    return poses[:, :3, :3].transpose(2, 1, 0).reshape(9, -1)


@dataclass(frozen=True, slots=True)
class Section:
    """The measurements of one pair among those of many."""

    many: Sorted
    index: int

    @property
    def count(self) -> int:
        """The number of measurements."""
        return int(self.many.first[self.index + 1] - self.many.first[self.index])

    @property
    def measurements(self) -> Measurements:
        """The measurements themselves, without a copy."""
        at, many = self.many.section(self.index), self.many
        sigma, kappa = (
            np.broadcast_to(value, at.stop - at.start) if value.ndim == 0 else value[at]
            for value in (many.sigma, many.kappa)
        )
        of_all = many.stamps_ns, many.covariances, many.pixels, many.kinds
        return Measurements(
            many.A[at], many.B[at], sigma, kappa, *(None if each is None else each[at] for each in of_all)
        )


@dataclass(frozen=True, slots=True)
class KeptMeasurements:
    """Raw measurements of a pair that are kept, batch by batch, and whether any batch had covariances."""

    stored: tuple[Section, ...] = ()
    has_covariances: bool = False

    def __add__(self, other: KeptMeasurements) -> KeptMeasurements:
        return KeptMeasurements(self.stored + other.stored, self.has_covariances or other.has_covariances)

    @property
    def has_kinds(self) -> bool:
        """Whether any batch weighs by direction."""
        return any(each.many.kinds is not None for each in self.stored)

    @property
    def batches(self) -> tuple[Measurements, ...]:
        """The measurements of each batch, without a copy."""
        return tuple(each.measurements for each in self.stored)

    @property
    def count(self) -> int:
        """The number of measurements that are kept."""
        return sum(each.count for each in self.stored)

    def joined(self) -> Measurements:
        """All batches in one, in the order in which they were added; stamps only where every batch has them."""
        batches = self.batches
        stamps = [b.stamps_ns for b in batches if b.stamps_ns is not None]
        return Measurements(
            np.concatenate([b.A for b in batches]),
            np.concatenate([b.B for b in batches]),
            np.concatenate([b.sigma for b in batches]),
            np.concatenate([b.kappa for b in batches]),
            np.concatenate(stamps) if len(stamps) == len(batches) else None,
            np.concatenate([b.covariance_of_B() for b in batches]) if self.has_covariances else None,
            self._pixels(),
            self._kinds(),
        )

    def _kinds(self) -> np.ndarray | None:
        """Which parts are measured; None where every batch has whole poses."""
        batches = self.batches
        if all(b.kinds is None for b in batches):
            return None
        return np.concatenate([np.zeros(len(b.A), dtype=np.int8) if b.kinds is None else b.kinds for b in batches])

    def _pixels(self) -> Array | None:
        """Corners of all batches; nan for those that were given as poses."""
        shapes = {b.pixels.shape[1:] for b in self.batches if b.pixels is not None}
        if not shapes:
            return None
        (shape,) = shapes  # a target has one board
        return np.concatenate(
            [np.full((len(b.A), *shape), np.nan) if b.pixels is None else b.pixels for b in self.batches]
        )


@dataclass(frozen=True)
class GivenMany:
    """The arguments of ``Problem.add_many``, not checked."""

    pairs: Sequence[tuple[str, str]]
    index: ArrayLike
    measurements: GivenMeasurements

    @property
    def where(self) -> str:
        """For messages."""
        source = self.measurements.source
        return f"the measurements of many pairs{f' ({source})' if source else ''}"

    def checked(self) -> Sorted:
        """Arrays, sorted by pair; poses themselves are checked where they are summed.

        A FrameError, CountError, PoseError, NoiseError or StampError says which pair or measurement is wrong.
        """
        pairs = self._checked_pairs()
        given = self.measurements
        raw = replace(given, stamps_ns=None).checked(self.where)
        count = len(raw.A)
        index = self._checked_index(count, len(pairs))
        number = np.bincount(index, minlength=len(pairs))
        if not number.all():
            nothing = int(np.argmin(number))
            raise CountError(f"{self.where}: pair {nothing}, {pairs[nothing]}, has no measurement; leave the pair out")
        order = np.argsort(index, kind="stable")
        is_sorted = bool((order[1:] > order[:-1]).all())
        of_pairs = index[order]

        def chosen(values: np.ndarray) -> np.ndarray:
            return values.copy() if is_sorted else values[order]  # a copy, since the caller's arrays may change

        stamps = whole_stamps(given.stamps_ns, count, self.where)
        result = Sorted(
            pairs,
            np.r_[0, np.cumsum(number)],
            chosen(raw.A),
            chosen(raw.B),
            chosen(raw.sigma) if raw.sigma.ndim else raw.sigma,
            chosen(raw.kappa) if raw.kappa.ndim else raw.kappa,
            order,
            f" ({given.source})" if given.source else "",
            None if stamps is None else chosen(stamps),
            None if raw.covariances is None else chosen(raw.covariances),
        )
        if result.stamps_ns is not None:
            back = np.flatnonzero((np.diff(result.stamps_ns) < 0) & (np.diff(of_pairs) == 0))
            if back.size:
                i = int(back[0])
                raise StampError(
                    f"{pairs[of_pairs[i]]}{result.source}: the stamp of measurement {order[i + 1]} "
                    f"({result.stamps_ns[i + 1]} ns) is before that of the pair's measurement {order[i]} "
                    f"({result.stamps_ns[i]} ns). Sort the measurements by stamp, or leave stamps_ns out"
                )
        return result

    def _checked_pairs(self) -> tuple[Pair, ...]:
        pairs = []
        for number, names in enumerate(self.pairs):
            if isinstance(names, str) or len(names) != 2:
                raise FrameError(f"{self.where}: pair {number} is {brief(names)}; give (target, sensor)")
            pair = Pair(*names)
            for name, what in zip(pair, ("target", "sensor"), strict=True):
                check_name(name, f"the {what}'s name of pair {number}")
            if pair.is_motion:
                raise FrameError(
                    f"{pair.target!r} is given as target and as sensor in pair {number}; names are unique across both "
                    "(motions of a sensor are added with add_motion)"
                )
            pairs.append(pair)
        if len(set(pairs)) < len(pairs):
            twice = next(pair for number, pair in enumerate(pairs) if pair in pairs[:number])
            raise FrameError(f"{self.where}: {twice} is given twice; give each pair once")
        both = {pair.target for pair in pairs} & {pair.sensor for pair in pairs}
        if both:
            number = next(number for number, pair in enumerate(pairs) if pair.target in both)
            raise FrameError(
                f"{self.where}: {pairs[number].target!r} is a target in pair {number} and a sensor in another one; "
                "names are unique across targets and sensors"
            )
        return tuple(pairs)

    def _checked_index(self, count: int, pairs: int) -> np.ndarray:
        index = np.asarray(self.index)
        if index.shape != (count,) or not np.issubdtype(index.dtype, np.integer):
            raise CountError(
                f"{self.where}: index has shape {index.shape} of {index.dtype}; give one integer for each of {count} "
                "measurements, its pair's place in pairs"
            )
        bad = np.flatnonzero((index < 0) | (index >= pairs))
        if bad.size:
            raise CountError(
                f"{self.where}: index of measurement {bad[0]} is {index[bad[0]]}; give 0 to {pairs - 1}, the place of "
                "its pair in pairs"
            )
        return index.astype(np.int64)
