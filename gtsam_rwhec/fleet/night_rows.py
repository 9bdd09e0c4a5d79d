"""The rows of one robot as nights of a control chart: its frames' tangents from a reference, with their information."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.calibration.verdict import Ground, Verdict
from gtsam_rwhec.fleet.fleet_rows import RobotRow
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.results.common_quantities import Movement

#: Verdicts "do not use" for these grounds alone still say what is determined.
DETERMINES_SOMETHING = {Ground.NOT_UNIQUE, Ground.NO_ANSWER, Ground.FEW_MEASUREMENTS}
#: An eigenvalue of a covariance's correlations is at least this: below is rounding.
ROUNDING = 1e-12
#: A correlation matrix that is negative by more is not one.
NEGATIVE = 1e-9
#: Names of a tangent's numbers.
AXES = ("rotation about x", "rotation about y", "rotation about z", "x", "y", "z")


@dataclass(frozen=True, eq=False)
class RobotFrames:
    """The frames of a robot over all its nights, and where each is in the chart's numbers."""

    #: By name; a name that is a sensor in some nights and a target in others has "(target)" after it for these
    groups: dict[str, slice]
    reference: dict[str, Array]  #: The pose of its first night
    unit: Array  #: (m,): the deviation of each number at its first night, rad and m: the numbers are multiples of it

    @staticmethod
    def of(rows: Sequence[RobotRow]) -> RobotFrames:
        """Of rows that can be used, in order of time."""
        reference: dict[str, Array] = {}
        units: dict[str, Array] = {}
        names = _names(rows)
        for row in rows:
            assert row.covariance is not None
            variances = np.diagonal(row.covariance)
            for i, frame in enumerate(row.frames):
                name = names[frame.name, frame.kind]
                reference.setdefault(name, frame.T)
                own = variances[6 * i : 6 * i + 6]
                known = np.isfinite(own) & (own > 0.0)
                unit = units.setdefault(name, np.zeros(6))
                fresh = known & (unit == 0.0)
                unit[fresh] = np.sqrt(own[fresh])
        unit = np.concatenate([np.where(each > 0.0, each, 1.0) for each in units.values()] or [np.zeros(0)])
        return RobotFrames({name: slice(6 * i, 6 * i + 6) for i, name in enumerate(reference)}, reference, unit)

    def night(self, row: RobotRow, names: dict[tuple[str, str], str]) -> Night:
        """The numbers of one row."""
        assert row.covariance is not None
        m = len(self.unit)
        x, J, rows = np.zeros(m), np.zeros((m, 6 * len(row.frames))), np.zeros(m, bool)
        called = [names[frame.name, frame.kind] for frame in row.frames]
        before = np.stack([self.reference[name] for name in called])
        xi = se3.logmap(se3.inverse(before) @ np.stack([frame.T for frame in row.frames]))
        inward = se3.right_jacobian_inverse(xi)
        variances = np.diagonal(row.covariance).reshape(-1, 6)
        # A rotation that is free leaves nothing linear; a number without variance was given, not found.
        known = (variances > 0.0) & np.isfinite(variances) & np.isfinite(variances[:, :3]).all(axis=1, keepdims=True)
        for i, name in enumerate(called):
            at = self.groups[name]
            x[at], rows[at] = np.where(known[i], xi[i], 0.0), known[i]
            J[at, 6 * i : 6 * i + 6] = inward[i]
        J[~rows] = 0.0
        finite = _without_constant_errors(row)
        C = (J @ finite @ J.T) / self.unit[:, None] / self.unit
        assert row.begin_ns is not None
        return Night(row.begin_ns, x / self.unit, _information(C, rows), np.where(np.outer(rows, rows), C, 0.0), rows)

    def movement(self, name: str, before: Array, change: Array) -> Movement:
        """How a frame moved by a change (6,) of the numbers that it had before."""
        unit = self.unit[self.groups[name]]
        T = gtsam.Pose3(self.reference[name])
        return Movement.of(T.expmap(unit * before), T.expmap(unit * (before + change)))

    def free_of(self, night: Night) -> dict[str, tuple[str, ...]]:
        """What a night leaves free of frames that it has some of, by name."""
        found = {}
        for name, rows in self.groups.items():
            seen = night.seen[rows]
            if seen.any() and not seen.all():
                found[name] = tuple(axis for axis, there in zip(AXES, seen, strict=True) if not there)
        return found


@dataclass(frozen=True, eq=False)
class Night:
    """One night in the chart's numbers."""

    when_ns: int
    x: Array  #: (m,)
    #: information, covariance: (m, m): zero in rows that the night does not determine
    information: Array
    covariance: Array
    seen: np.ndarray  #: (m,): rows that it determines


def names_of(rows: Iterable[RobotRow]) -> dict[tuple[str, str], str]:
    """The chart's name of each frame and kind."""
    return _names(list(rows))


def why_not(row: RobotRow) -> str:
    """Why a row says nothing of where the frames are; empty where it does."""
    if row.verdict is None or not row.frames:
        return row.failure or row.reason or "there is no calibration"
    if row.verdict is Verdict.DO_NOT_USE and not set(row.grounds) <= DETERMINES_SOMETHING:
        return f"its poses are not to be used: {row.reason}"
    if row.covariance is None:
        return "its poses have no covariance, because it was not refined"
    variances = np.diagonal(row.covariance)
    finite = np.flatnonzero(np.isfinite(variances))
    is_damaged = np.isnan(variances).any() or (variances < 0.0).any()
    if is_damaged or not np.isfinite(row.covariance[np.ix_(finite, finite)]).all():
        return "its covariance has a variance below zero or what is no number; run this night again"
    if not all(np.isfinite(frame.T).all() for frame in row.frames):
        return "a pose of it has what is no finite number; run this night again"
    if not ((variances > 0.0) & np.isfinite(variances)).any():
        return "nothing of it is determined"
    if row.begin_ns is None:
        return "its measurements have no time"
    return ""


def _names(rows: Iterable[RobotRow]) -> dict[tuple[str, str], str]:
    names: dict[tuple[str, str], str] = {}
    for row in rows:
        for frame in row.frames:
            taken = any(name == frame.name and kind != frame.kind for name, kind in names)
            names.setdefault((frame.name, frame.kind), f"{frame.name} ({frame.kind})" if taken else frame.name)
    return names


def _without_constant_errors(row: RobotRow) -> Array:
    """The finite covariances without what all nights share; as they are where they do not hold that much of it."""
    assert row.covariance is not None
    finite: Array = np.where(np.isfinite(row.covariance), row.covariance, 0.0)
    if not row.constant_errors:
        return finite
    shift = np.zeros((len(finite), 6))
    for i, frame in enumerate(row.frames):
        deviations = np.array(row.constant_errors[frame.kind == "sensor"])
        shift[6 * i : 6 * i + 6] = se3.adjoint(se3.inverse(frame.T)[None])[0] * deviations
    known = np.isfinite(np.diagonal(row.covariance)) & (np.diagonal(row.covariance) > 0.0)
    rest = finite - shift @ shift.T
    size = np.sqrt(np.maximum(np.diagonal(rest), 0.0))[known]
    if not (size > 0.0).all():
        return finite
    correlations = rest[np.ix_(known, known)] / size[:, None] / size
    return rest if np.linalg.eigvalsh(correlations).min(initial=0.0) >= -NEGATIVE else finite


def _information(C: Array, rows: np.ndarray) -> Array:
    """The inverse of the covariance over some rows, zero in the others."""
    found: Array = np.zeros_like(C)
    at = np.flatnonzero(rows)
    if len(at):
        size = np.sqrt(np.diagonal(C)[at])
        values, vectors = np.linalg.eigh(C[np.ix_(at, at)] / size[:, None] / size)
        root = vectors / np.sqrt(np.maximum(values, ROUNDING * len(at))) / size[:, None]
        found[np.ix_(at, at)] = root @ root.T
    return found
