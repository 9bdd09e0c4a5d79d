"""The moments of many pairs about one gauge: shifted, added and written, the same bits on every machine.

Moments are sums, so those of several logs add once they are about one gauge. Shifts here multiply and add entry by
entry in a fixed order: no library of linear algebra is asked, whose order of summation varies from processor to
processor.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.moments import ONE, T_A, Gauge, Moments
from gtsam_rwhec.problem.problem import Problem

#: A shift rounds each entry at most so often: four products and four sums for its row, as many for its column.
SHIFT_OPERATIONS = 16
_UPPER = np.triu_indices(25)


@dataclass(frozen=True, eq=False)
class PairMoments:
    """Moments of E pairs, in the order of their names.

    Attributes
    ----------
    pairs : tuple of Pair
        Sorted.
    gauge : Gauge
    is_relative : bool
        Whether the noise of some measurements was not stated.
    count, kappa, operations, deviation, projected : (E,) arrays
    translation : (E, 25, 25) array
        Symmetric to the last bit.
    rotation : (E, 9, 9) array
    magnitude, feature_error : (E, 25) arrays
        Each as in `Moments`.
    """

    pairs: tuple[Pair, ...]
    gauge: Gauge
    is_relative: bool
    count: np.ndarray
    kappa: Array
    translation: Array
    rotation: Array
    magnitude: Array
    feature_error: Array
    operations: np.ndarray
    deviation: Array
    projected: np.ndarray

    @staticmethod
    def of(problem: Problem) -> PairMoments:
        """The moments of a problem, about its gauge."""
        pairs = tuple(sorted(problem.pairs))
        found = [problem.moments(*pair) for pair in pairs]
        columns = {name: np.array([getattr(moments, name) for moments in found]) for name in _COLUMNS}
        columns["translation"] = _mirrored(columns["translation"])
        return PairMoments(pairs, problem.gauge, problem.is_relative, **columns)

    def moments(self) -> dict[Pair, Moments]:
        """By pair, as a problem has them."""
        return {
            pair: Moments(
                int(self.count[i]),
                float(self.kappa[i]),
                self.translation[i],
                self.rotation[i],
                self.magnitude[i],
                self.feature_error[i],
                int(self.operations[i]),
                float(self.deviation[i]),
                int(self.projected[i]),
            )
            for i, pair in enumerate(self.pairs)
        }

    @property
    def is_motion(self) -> np.ndarray:
        """(E,) booleans: both carriers are the sensor's."""
        return np.array([pair.is_motion for pair in self.pairs], dtype=bool)

    def renamed(self, names: Mapping[str, str]) -> PairMoments:
        """The same with other names of frames, in the order of these."""
        pairs = [Pair(names.get(pair.target, pair.target), names.get(pair.sensor, pair.sensor)) for pair in self.pairs]
        order = sorted(range(len(pairs)), key=pairs.__getitem__)
        columns = {name: getattr(self, name)[order] for name in _COLUMNS}
        return PairMoments(tuple(pairs[i] for i in order), self.gauge, self.is_relative, **columns)

    def about(self, gauge: Gauge) -> PairMoments:
        """The moments about another gauge."""
        a = gauge.sensor_carrier - self.gauge.sensor_carrier
        c = gauge.target_carrier - self.gauge.target_carrier
        if not a.any() and not c.any():
            return self
        of_pair = np.where(self.is_motion[:, None], a, c)
        G = self.translation.copy()
        _shift_rows(G, a, of_pair)
        G = G.transpose(0, 2, 1).copy()
        _shift_rows(G, a, of_pair)
        return PairMoments(
            self.pairs,
            gauge,
            self.is_relative,
            self.count,
            self.kappa,
            _mirrored(G),
            self.rotation,
            _reach(self.magnitude, a, of_pair),
            _reach(self.feature_error, a, of_pair),
            self.operations + SHIFT_OPERATIONS,
            self.deviation,
            self.projected,
        )

    def added(self, other: PairMoments) -> PairMoments:
        """The moments of both, about the mean of their gauges, weighted by their sums of 1 / sigma^2."""
        mine, others = self._weight(), other._weight()
        share = others / (mine + others)
        gauge = Gauge(
            *(
                getattr(self.gauge, name) + share * (getattr(other.gauge, name) - getattr(self.gauge, name))
                for name in ("sensor_carrier", "target_carrier")
            )
        )
        pairs = tuple(sorted({*self.pairs, *other.pairs}))
        first, second = (each.about(gauge)._spread_over(pairs) for each in (self, other))
        return PairMoments(
            pairs,
            gauge,
            self.is_relative or other.is_relative,
            **{name: first[name] + second[name] for name in ("count", "kappa", "translation", "rotation", "projected")},
            **{
                name: np.sqrt(first[name] * first[name] + second[name] * second[name])
                for name in ("magnitude", "feature_error")
            },
            operations=np.maximum(first["operations"], second["operations"]) + 1,
            deviation=np.maximum(first["deviation"], second["deviation"]),
        )

    def _weight(self) -> float:
        """The sum of 1 / sigma^2 of all pairs, in their order."""
        return float(np.add.accumulate(self.translation[:, ONE, ONE])[-1])

    def _spread_over(self, pairs: tuple[Pair, ...]) -> dict[str, np.ndarray]:
        """The arrays with rows for all of `pairs`; zero where there is none."""
        place = {pair: i for i, pair in enumerate(pairs)}
        rows = [place[pair] for pair in self.pairs]
        spread = {}
        for name in _COLUMNS:
            column = getattr(self, name)
            spread[name] = np.zeros((len(pairs), *column.shape[1:]), column.dtype)
            spread[name][rows] = column
        return spread

    def facts(self) -> dict[str, object]:
        """What `of_arrays` needs beside the arrays."""
        return {"pairs": [list(pair) for pair in self.pairs], "is_relative": self.is_relative}

    def arrays(self) -> dict[str, np.ndarray]:
        """For a file: of each symmetric matrix one triangle."""
        columns = {name: getattr(self, name) for name in _COLUMNS}
        columns["translation"] = self.translation[:, _UPPER[0], _UPPER[1]]
        columns["gauge"] = np.concatenate([self.gauge.sensor_carrier, self.gauge.target_carrier])
        return columns

    @staticmethod
    def of_arrays(facts: Mapping[str, object], arrays: Mapping[str, np.ndarray]) -> PairMoments:
        """What `facts` and `arrays` were made of."""
        named: list[list[str]] = facts["pairs"]  # type: ignore[assignment]
        triangle = arrays["translation"]
        G = np.zeros((len(named), 25, 25))
        G[:, _UPPER[0], _UPPER[1]] = triangle
        columns = {name: arrays[name] for name in _COLUMNS} | {"translation": _mirrored(G)}
        gauge = Gauge(arrays["gauge"][:3].copy(), arrays["gauge"][3:].copy())
        return PairMoments(tuple(Pair(*pair) for pair in named), gauge, bool(facts["is_relative"]), **columns)

    def sha256(self) -> str:
        """A checksum of all bits, in hexadecimal digits."""
        digest = hashlib.sha256(repr(self.facts()).encode())
        for name, array in sorted(self.arrays().items()):
            digest.update(name.encode() + np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()


_COLUMNS = tuple(field.name for field in fields(PairMoments))[3:]


def _shift_rows(G: Array, a: Array, c: Array) -> None:
    """t_A' = t_A + R_A c - a in the rows of t_A, in place; c (E, 3)."""
    for k in range(3):
        G[:, T_A] += c[:, k, None, None] * G[:, 3 * k : 3 * k + 3]
    G[:, T_A] -= a[:, None] * G[:, ONE, None]


def _reach(size: Array, a: Array, c: Array) -> Array:
    """How large the shifted features are at most."""
    result = size.copy()
    for k in range(3):
        result[:, T_A] += np.abs(c[:, k, None]) * size[:, 3 * k : 3 * k + 3]
    result[:, T_A] += np.abs(a) * size[:, ONE, None]
    return result


def _mirrored(G: Array) -> Array:
    """The matrices with the upper triangle in both."""
    upper = np.triu(G)
    mirrored: Array = upper + np.triu(G, 1).transpose(0, 2, 1)
    return mirrored
