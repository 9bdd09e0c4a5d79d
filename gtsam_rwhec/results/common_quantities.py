"""The quantities that two refined calibrations have in common: their difference, and the covariances of both."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

import gtsam
import numpy as np
from rwhec_factors.se3 import right_jacobian_inverse

from gtsam_rwhec.files.terminal_text import rounded
from gtsam_rwhec.fitting.joint_covariance import SHARE, JointCovariance
from gtsam_rwhec.fitting.reprojection_record import Intrinsics
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.geometry.pose_covariances import error_of
from gtsam_rwhec.geometry.poses import Array


@dataclass(frozen=True)
class Movement:
    """How a frame moved: old pose Expmap(xi) = new pose."""

    xi: Array  #: (6,): [omega (rad), v (m)], in the frame's own old axes

    @staticmethod
    def of(old: gtsam.Pose3, new: gtsam.Pose3) -> Movement:
        """From one pose to the other."""
        return Movement(error_of(old, new))

    @property
    def translation_mm(self) -> float:
        """How far the origin moved, mm."""
        return 1e3 * float(np.linalg.norm(np.asarray(gtsam.Pose3.Expmap(self.xi).translation())))

    @property
    def rotation_deg(self) -> float:
        """By how much the frame turned, degrees."""
        return math.degrees(float(np.linalg.norm(self.xi[:3])))

    def __str__(self) -> str:
        return f"{rounded(self.translation_mm, 3)} mm and {rounded(self.rotation_deg)} degrees"


@dataclass(frozen=True)
class Quantities:
    """The common quantities as vectors, in units in which all are of similar size."""

    difference: Array  #: (m,): new less old
    covariances: tuple[Array, Array]
    free: Array  #: (m, k): directions of infinite variance of either
    slots: dict[Unknown, slice]
    not_compared: dict[Unknown, str]  #: What both have and is not in the vectors, with the reason

    @property
    def groups(self) -> dict[str, slice]:
        """The rows of each group of quantities by its name."""
        return {str(unknown): rows for unknown, rows in self.slots.items()}


class Answer(Protocol):
    """Poses and numbers with their joint covariance: ``Refined``, or what a new log says near an old answer."""

    @property
    def X(self) -> Mapping[str, gtsam.Pose3]:
        """T_targetcarrier_target."""

    @property
    def Y(self) -> Mapping[str, gtsam.Pose3]:
        """T_sensorcarrier_sensor."""

    @property
    def scale(self) -> float | Mapping[str, float]:
        """Measured length / true length."""

    @property
    def time_offsets_s(self) -> Mapping[str, float]:
        """By sensor."""

    @property
    def intrinsics(self) -> Mapping[str, Intrinsics]:
        """By sensor, where they were estimated."""

    @property
    def joint(self) -> JointCovariance:
        """Of all unknowns."""


def quantities(old: Answer, new: Answer, without: Collection[UnknownKind] = ()) -> Quantities:
    """The frames, scales, time offsets and intrinsics that both have; kinds in ``without`` are left out."""
    unknowns = [unknown for unknown in _common(old, new) if unknown.kind not in without]
    not_compared = {}
    rows: list[tuple[Unknown, Array, tuple[Array, Array], tuple[Array, Array], Array]] = []
    for unknown in unknowns:
        G = _selector(old, unknown), _selector(new, unknown)
        why = _why_not(old, new, unknown, G)
        if why:
            not_compared[unknown] = why
            continue
        difference, J = _difference(old, new, unknown)
        # Jacobians of Log(old^-1 new) by both right perturbations.
        rows.append((unknown, difference, (J[0] @ G[0], J[1] @ G[1]), G, _unit(old, new, unknown)))
    slots, first = {}, 0
    for unknown, difference, *_ in rows:
        slots[unknown] = slice(first, first + len(difference))
        first += len(difference)
    if not rows:
        empty = np.zeros((0, 0))
        return Quantities(np.zeros(0), (empty, empty), empty, {}, not_compared)
    unit = np.concatenate([row[4] for row in rows])
    covariances, free = [], []
    for side, refined in enumerate((old, new)):
        joint = refined.joint
        G = np.concatenate([row[2][side] for row in rows]) / unit[:, None]
        covariances.append(G @ joint.finite @ G.T)
        free.append(joint.reach(G))
    return Quantities(
        np.concatenate([row[1] for row in rows]) / unit,
        (covariances[0], covariances[1]),
        np.hstack(free),
        slots,
        not_compared,
    )


def _common(old: Answer, new: Answer) -> Iterator[Unknown]:
    """Frames that both have, and unknowns of other kinds that both estimated."""
    for poses, others in ((old.X, new.X), (old.Y, new.Y)):
        yield from (Unknown(UnknownKind.FRAME, name) for name in poses if name in others)
    for unknown in old.joint.slots:
        if unknown not in new.joint.slots or unknown.kind in (UnknownKind.FRAME, UnknownKind.SHAPE):
            continue
        if unknown.kind is UnknownKind.INTRINSICS:
            first, second = old.intrinsics[unknown.owner], new.intrinsics[unknown.owner]
            if (first.model, first.width, first.height, first.names) != (
                second.model, second.width, second.height, second.names,
            ):  # fmt: skip
                continue
        yield unknown


def _selector(refined: Answer, unknown: Unknown) -> Array:
    """The matrix (m, d) of an unknown's rows; zero for a frame that is known exactly."""
    if unknown in refined.joint.slots:
        return refined.joint.selector((unknown,))
    return np.zeros((6, len(refined.joint.unit)))


def _why_not(old: Answer, new: Answer, unknown: Unknown, G: tuple[Array, Array]) -> str:
    """Why a quantity cannot be compared; empty where it can."""
    if not G[0].any() and not G[1].any():
        return "its pose was given as known, in both"
    reached = [
        refined.joint.reach(rows) / _unit(old, new, unknown)[:, None]
        for refined, rows in zip((old, new), G, strict=True)
    ]
    which = [name for name, reach in zip(("OLD", "NEW"), reached, strict=True) if _is_free(reach, unknown)]
    return (
        f"the measurements of {' and of '.join(which)} leave its rotation free"
        if which and unknown.kind is UnknownKind.FRAME
        else (f"the measurements of {' and of '.join(which)} leave it free" if which else "")
    )


def _is_free(reach: Array, unknown: Unknown) -> bool:
    """Whether a free direction turns a frame (no linear model holds then), or changes a number."""
    rows = reach[:3] if unknown.kind is UnknownKind.FRAME else reach
    return bool(reach.shape[1]) and float(np.linalg.norm(rows, axis=1).max()) > SHARE


def _difference(old: Answer, new: Answer, unknown: Unknown) -> tuple[Array, tuple[Array, Array]]:
    """New less old, and its derivatives by the errors of both, old first."""
    if unknown.kind is UnknownKind.FRAME:
        first, second = ((each.Y if unknown.owner in each.Y else each.X)[unknown.owner] for each in (old, new))
        xi = error_of(first, second)
        return xi, (-right_jacobian_inverse(-xi[None])[0], right_jacobian_inverse(xi[None])[0])
    values = [_values(refined, unknown) for refined in (old, new)]
    one = np.eye(len(values[0]))
    return values[1] - values[0], (-one, one)


def _values(refined: Answer, unknown: Unknown) -> Array:
    if unknown.kind is UnknownKind.INTRINSICS:
        return np.array(refined.intrinsics[unknown.owner].values)
    if unknown.kind is UnknownKind.TIME_OFFSET:
        return np.array([refined.time_offsets_s[unknown.owner]])
    scale = refined.scale
    return np.array([scale[unknown.owner] if isinstance(scale, Mapping) else scale])


def _unit(old: Answer, new: Answer, unknown: Unknown) -> Array:
    """The unit of each row, from the first of both that has the unknown."""
    joint = old.joint if unknown in old.joint.slots else new.joint
    found: Array = joint.unit[joint.rows((unknown,))] if unknown in joint.slots else np.ones(6)
    return found
