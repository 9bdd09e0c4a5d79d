"""Measurements of many pairs in one call: checked and sorted by pair, without a loop over measurements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from gtsam_rwhec.errors import CountError, FrameError, StampError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.problem.knowledge import check_name
from gtsam_rwhec.problem.measurements import GivenMeasurements
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.segmented_moments import Sorted


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

        stamps = self._checked_stamps(count)
        result = Sorted(
            pairs=pairs,
            first=np.r_[0, np.cumsum(number)],
            A=chosen(raw.A),
            B=chosen(raw.B),
            sigma=chosen(raw.sigma) if raw.sigma.ndim else raw.sigma,
            kappa=chosen(raw.kappa) if raw.kappa.ndim else raw.kappa,
            given=order,
            source=f" ({given.source})" if given.source else "",
            stamps_ns=None if stamps is None else chosen(stamps),
            covariances=None if raw.covariances is None else chosen(raw.covariances),
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
            number, pair = next((n, pair) for n, pair in enumerate(pairs) if pair.target in both)
            raise FrameError(
                f"{self.where}: {pair.target!r} is a target in pair {number} and a sensor in another one; names are "
                "unique across targets and sensors"
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

    def _checked_stamps(self, count: int) -> np.ndarray | None:
        if self.measurements.stamps_ns is None:
            return None
        stamps = np.asarray(self.measurements.stamps_ns)
        if stamps.shape != (count,) or not np.issubdtype(stamps.dtype, np.integer):
            raise CountError(
                f"{self.where}: stamps_ns has shape {stamps.shape} of {stamps.dtype} for {count} measurements; give "
                "integer nanoseconds"
            )
        return stamps.astype(np.int64)
