"""Moments of many pairs at once: measurements are sorted by pair, and pairs with about as many are summed together."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.errors import PoseError
from gtsam_rwhec.geometry.poses import ROTATION_ROUNDING, Array, checked_rows, orthonormality, rows_to_transforms
from gtsam_rwhec.geometry.rounding import UNIT
from gtsam_rwhec.problem.moments import BLOCK, ONE, R_A, R_B, T_A, Gauge, Moments
from gtsam_rwhec.problem.packed_moments import BACK_ENTRIES, FRONT, FRONT_ENTRIES, PackedMoments
from gtsam_rwhec.problem.pairs import Pair

#: So many measurements are summed at once, some megabytes.
AT_ONCE = 4096
#: Pairs that are summed together have at least this part of the longest one's measurements, so that little is padding.
FULL = 0.6
#: Where the features without B's rotation have the entries of their triangle.
_OF_FRONT = np.searchsorted(FRONT, FRONT_ENTRIES[0]), np.searchsorted(FRONT, FRONT_ENTRIES[1])


@dataclass(frozen=True)
class _Table:
    """What `PackedMoments` has, to be filled group by group."""

    count: np.ndarray
    kappa: Array
    front: Array
    back: Array | None
    rotation: Array
    magnitude: Array
    feature_error: Array
    operations: np.ndarray
    deviation: Array
    projected: np.ndarray


@dataclass(frozen=True)
class Sorted:
    """Measurements of P pairs, sorted by pair: those of pair p are ``first[p]:first[p + 1]``.

    A, B (N, 4, 4); sigma, kappa () or (N,); ``given`` (N,): their places in the user's arrays, for messages; stamps_ns
    (N,) and covariances (N, 6, 6), or None.
    """

    pairs: tuple[Pair, ...]
    first: np.ndarray
    A: Array
    B: Array
    sigma: Array
    kappa: Array
    given: np.ndarray
    source: str
    stamps_ns: np.ndarray | None = None
    covariances: Array | None = None

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

    def padded(self, group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places (p, k) of the measurements of some pairs, and which of them are no padding (a pair's last, again)."""
        counts = self.counts[group][:, None]
        step = np.arange(int(counts.max()))
        return self.first[group][:, None] + np.minimum(step, counts - 1), step < counts

    def groups(self, pairs: np.ndarray) -> Iterator[np.ndarray]:
        """Some pairs, those with about as many measurements, `AT_ONCE` together; a pair with more is alone."""
        counts = self.counts[pairs]
        order = np.argsort(-counts, kind="stable")
        descending, order = counts[order], pairs[order]
        begin = 0
        while begin < len(order):
            longest = int(descending[begin])
            alike = int(np.searchsorted(-descending, -FULL * longest, side="right"))
            end = min(max(alike, begin + 1), begin + max(1, AT_ONCE // longest))
            yield order[begin:end]
            begin = end

    def moments(self, gauge: Gauge, *, with_R_B: bool) -> PackedMoments:
        """The moments of every pair; a PoseError names the first pose of a block that is not valid."""
        P = len(self.pairs)
        result = _Table(
            count=self.counts,
            kappa=np.empty(P),
            front=np.empty((P, len(FRONT_ENTRIES[0]))),
            back=np.empty((P, len(BACK_ENTRIES[0]))) if with_R_B else None,
            rotation=np.empty((P, 81)),
            magnitude=np.empty((P, 25)),
            feature_error=np.empty((P, 3)),
            operations=np.empty(P, dtype=int),
            deviation=np.empty(P),
            projected=np.zeros(P, dtype=int),
        )
        motion = self.motion
        for group in self.groups(np.arange(P)):
            if len(group) == 1 and self.counts[group[0]] > BLOCK:
                self._long(int(group[0]), gauge, result)
            else:
                self._sum(group, gauge, motion[group], result)
        return PackedMoments(**vars(result))

    def _weights(self, at: np.ndarray) -> tuple[Array, Array]:
        """1 / sigma^2 and kappa of measurements."""
        sigma, kappa = (each if each.ndim == 0 else each[at] for each in (self.sigma, self.kappa))
        return np.broadcast_to(1.0 / sigma**2, at.shape), np.broadcast_to(kappa, at.shape)

    def _long(self, pair: int, gauge: Gauge, result: _Table) -> None:
        own = np.arange(self.first[pair], self.first[pair + 1])
        weight, kappa = self._weights(own)
        try:
            moments = Moments.of(
                self.A[own], self.B[own], weight, kappa, gauge, self.pairs[pair].is_motion, self.pairs[pair].label
            )
        except PoseError:
            self._name(own)
            raise
        table = vars(result)
        for name, value in vars(PackedMoments.of([moments])).items():
            if table[name] is not None and name != "count":
                table[name][pair] = value[0]

    def _sum(self, group: np.ndarray, gauge: Gauge, motion: np.ndarray, result: _Table) -> None:
        places, valid = self.padded(group)
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
            result.projected[group] = (np.sum(off, axis=0).reshape(p, k) * valid).sum(axis=1)
        reach = np.abs(f[T_A]).max(axis=2)  # (3, p)
        a = gauge.sensor_carrier[:, None]
        c = np.where(motion, a, gauge.target_carrier[:, None])  # (3, p)
        f[T_A] += c[0, :, None] * f[0:3] + c[1, :, None] * f[3:6] + c[2, :, None] * f[6:9] - a[:, :, None]
        f[ONE] = 1.0
        weight, kappa = self._weights(places)
        weight, kappa = weight * valid, kappa * valid
        kept = np.arange(25) if result.back is not None else FRONT
        rows = np.ascontiguousarray(f[kept].transpose(1, 0, 2))  # (p, features, k)
        products = np.matmul(rows * weight[:, None, :], rows.transpose(0, 2, 1))
        total = weight.sum(axis=1)
        products[:, -1, -1] = total
        if result.back is None:
            result.front[group] = products[:, _OF_FRONT[0], _OF_FRONT[1]]
            diagonal = np.zeros((p, 25))
            diagonal[:, FRONT] = np.einsum("eii->ei", products)
            # Each column of a rotation has length 1, up to what was projected.
            diagonal[:, R_B] = ((f[R_B] ** 2) * weight).sum(axis=2).T
        else:
            result.front[group] = products[:, FRONT_ENTRIES[0], FRONT_ENTRIES[1]]
            result.back[group] = products[:, BACK_ENTRIES[0], BACK_ENTRIES[1]]
            diagonal = np.einsum("eii->ei", products)
        turned = np.matmul((f[R_A] * kappa).transpose(1, 0, 2), f[R_B].transpose(1, 2, 0))
        result.rotation[group] = turned.reshape(p, 81)
        result.kappa[group] = kappa.sum(axis=1)
        result.magnitude[group] = np.sqrt(diagonal) * (1.0 + 1e-9)
        centring = 8.0 * UNIT * (reach + np.abs(c).sum(axis=0) + np.abs(a))
        result.feature_error[group] = (centring * np.sqrt(total)).T
        # The weight and its products take up to six operations; then a pair's measurements are summed.
        result.operations[group] = self.counts[group] + 7
        # What the test of R'R itself rounds comes on top.
        result.deviation[group] = max(of_A.deviation, of_B.deviation) + 8.0 * UNIT

    def _name(self, places: np.ndarray) -> None:
        """Raise the PoseError of the first measurement that is not valid: its pair, and its place in the arrays."""
        for place in np.sort(places):
            pair = self.pairs[int(np.searchsorted(self.first, place, side="right")) - 1]
            for name, poses in (("A", self.A), ("B", self.B)):
                where = f"{name} of {pair}{self.source}"
                checked_rows(poses[place : place + 1], int(self.given[place]), where)


def _columns(poses: Array) -> Array:
    """vec(R) of poses (n, 4, 4) as (9, n)."""
    return poses[:, :3, :3].transpose(2, 1, 0).reshape(9, -1)
