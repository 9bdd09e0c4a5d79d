"""The partial result of one log: its moments with facts in one small file, its cleaned measurements in another.

The reduction reads the first, some kilobytes a pair. A refinement reads the second too: poses, covariances, corners
and stamps of every measurement that is used. Both are named by the key of the log, the rig file and the version.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from pydantic import ValidationError

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.fleet.container import packed, unpacked
from gtsam_rwhec.fleet.log_facts import LogFacts
from gtsam_rwhec.fleet.pair_moments import PairMoments
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair

FOLDER = "partials"
_TRIANGLE = np.triu_indices(6)


@dataclass(frozen=True, eq=False)
class Partial:
    """The moments of a log's cleaned measurements, and the facts about the log."""

    facts: LogFacts
    moments: PairMoments

    def packed(self) -> bytes:
        """The bytes of its file."""
        facts = {"log": self.facts.model_dump(mode="json"), "moments": self.moments.facts()}
        return packed("partial", facts, self.moments.arrays())


def read_partial(content: bytes, where: str) -> Partial:
    """A partial result from the bytes of its file, which `where` names.

    Raises
    ------
    FileFormatError
        It is none, is damaged, or is of another version (`ResultVersionError`).
    """
    facts, arrays = unpacked(content, "partial", where)
    try:
        return Partial(LogFacts.model_validate(facts["log"]), PairMoments.of_arrays(facts["moments"], arrays))
    except (ValidationError, KeyError) as error:
        raise FileFormatError(f"{where} is no partial result of this version; remove it, and run again") from error


@dataclass(frozen=True, eq=False)
class KeptPair:
    """The cleaned measurements of one pair of a log.

    Attributes
    ----------
    stamps_ns : (N,) integers
        On the carriers' clock.
    A, B : (N, 4, 4) arrays
    covariances : (N, 6, 6) array or None
        Of B, rounded to single precision, as the moments have them.
    pixels : (N, n, 2) array or None
        The target's corners, nan where one was not seen.
    """

    stamps_ns: np.ndarray
    A: Array
    B: Array
    covariances: Array | None
    pixels: Array | None


@dataclass(frozen=True, eq=False)
class KeptLog:
    """The cleaned measurements of a log, and the carriers' path where a clock is to be estimated.

    Attributes
    ----------
    pairs : dict of Pair to KeptPair
    path : (stamps_ns (M,), T (M, 4, 4)) or None
        T_sensorcarrier_targetcarrier over time.
    """

    pairs: Mapping[Pair, KeptPair]
    path: tuple[np.ndarray, Array] | None = None

    def packed(self) -> bytes:
        """The bytes of its file."""
        arrays: dict[str, np.ndarray] = {}
        # Targets in one image have one A: it is kept once.
        stacked = [kept.A[:, :3] for kept in self.pairs.values()]
        poses, which = np.unique(np.concatenate(stacked).reshape(-1, 12), axis=0, return_inverse=True)
        arrays["poses"] = poses
        ends = np.cumsum([0, *map(len, stacked)])
        for i, kept in enumerate(self.pairs.values()):
            arrays[f"{i}.A"] = which.ravel()[ends[i] : ends[i + 1]].astype(np.uint32)
            arrays[f"{i}.B"] = kept.B[:, :3].reshape(-1, 12)
            arrays[f"{i}.stamps_ns"] = np.diff(kept.stamps_ns, prepend=0)
            if kept.covariances is not None:
                arrays[f"{i}.covariances"] = kept.covariances[:, _TRIANGLE[0], _TRIANGLE[1]].astype(np.float32)
            if kept.pixels is not None:
                arrays[f"{i}.pixels"] = kept.pixels.astype(np.float32)
        if self.path is not None:
            arrays["path.stamps_ns"] = np.diff(self.path[0], prepend=0)
            arrays["path.T"] = self.path[1][:, :3].reshape(-1, 12)
        return packed("measurements", {"pairs": [list(pair) for pair in self.pairs]}, arrays)


def read_kept(content: bytes, where: str) -> KeptLog:
    """The measurements of a log from the bytes of their file; errors as `read_partial`."""
    facts, arrays = unpacked(content, "measurements", where)
    pairs = {}
    for i, pair in enumerate(facts["pairs"]):
        triangle, pixels = arrays.get(f"{i}.covariances"), arrays.get(f"{i}.pixels")
        pairs[Pair(*pair)] = KeptPair(
            np.cumsum(arrays[f"{i}.stamps_ns"]),
            _poses(arrays["poses"][arrays[f"{i}.A"]]),
            _poses(arrays[f"{i}.B"]),
            None if triangle is None else full_covariances(triangle.astype(float)),
            None if pixels is None else pixels.astype(float),
        )
    path = None
    if "path.T" in arrays:
        path = np.cumsum(arrays["path.stamps_ns"]), _poses(arrays["path.T"])
    return KeptLog(pairs, path)


def full_covariances(triangle: Array) -> Array:
    """Covariances (N, 6, 6) from their upper triangles (N, 21)."""
    result = np.empty((len(triangle), 6, 6))
    result[:, _TRIANGLE[0], _TRIANGLE[1]] = triangle
    result[:, _TRIANGLE[1], _TRIANGLE[0]] = triangle
    return result


def in_single(covariances: Array) -> Array:
    """Covariances as a file keeps them, rounded to single precision (6e-8): what moments and refinement both use."""
    return full_covariances(covariances[:, _TRIANGLE[0], _TRIANGLE[1]].astype(np.float32).astype(float))


def checksum(content: bytes) -> str:
    """Of a file's bytes, in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def _poses(rows: Array) -> Array:
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3] = rows.reshape(-1, 3, 4)
    return T
