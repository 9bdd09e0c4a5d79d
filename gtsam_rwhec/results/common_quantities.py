"""The quantities that two refined calibrations have in common: their difference, and the covariances of both."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np
from rwhec_factors.se3 import right_jacobian_inverse

from gtsam_rwhec.files.terminal_text import rounded
from gtsam_rwhec.fitting.joint_covariance import SHARE
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.geometry.pose_covariances import error_of
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import scale_at


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

    def only(self, wanted: Callable[[Unknown], bool]) -> Quantities:
        """The quantities of the wanted unknowns; all others are marginalised."""
        kept = {unknown: rows for unknown, rows in self.slots.items() if wanted(unknown)}
        places = [np.arange(rows.start, rows.stop) for rows in kept.values()]
        rows = np.concatenate([np.zeros(0, int), *places])
        first, second = (covariance[np.ix_(rows, rows)] for covariance in self.covariances)
        not_compared = {unknown: why for unknown, why in self.not_compared.items() if wanted(unknown)}
        slots = _in_a_row({unknown: len(place) for unknown, place in zip(kept, places, strict=True)})
        return Quantities(self.difference[rows], (first, second), self.free[rows], slots, not_compared)


def _in_a_row(sizes: Mapping[Unknown, int]) -> dict[Unknown, slice]:
    """The rows of unknowns of these sizes, one after the other."""
    ends = np.cumsum([0, *sizes.values()]).tolist()
    return {unknown: slice(*rows) for unknown, rows in zip(sizes, pairwise(ends), strict=True)}


def quantities(old: RefinedPoses, new: RefinedPoses, without: Collection[UnknownKind] = ()) -> Quantities:
    """The frames, scales, time offsets and intrinsics that both have; kinds in ``without`` are left out."""
    not_compared = {}
    differences: dict[Unknown, Array] = {}
    units: list[Array] = []
    # Derivatives of the differences by all that each leaves unknown.
    by_errors: tuple[list[Array], list[Array]] = ([], [])
    for unknown in _common(old, new):
        if unknown.kind in without:
            continue
        G = [_selector(each, unknown) for each in (old, new)]
        joint = old.joint if unknown in old.joint.slots else new.joint  # the first of both that has the unknown
        unit = joint.unit[joint.rows((unknown,))] if unknown in joint.slots else np.ones(6)
        if why := _why_not(old, new, unknown, G, unit):
            not_compared[unknown] = why
            continue
        differences[unknown], J = _difference(old, new, unknown)
        units.append(unit)
        for side in (0, 1):
            by_errors[side].append(J[side] @ G[side] / unit[:, None])
    slots = _in_a_row({unknown: len(difference) for unknown, difference in differences.items()})
    if not slots:
        empty = np.zeros((0, 0))
        return Quantities(np.zeros(0), (empty, empty), empty, {}, not_compared)
    first, second = (np.concatenate(each) for each in by_errors)
    return Quantities(
        np.concatenate(list(differences.values())) / np.concatenate(units),
        (first @ old.joint.finite @ first.T, second @ new.joint.finite @ second.T),
        np.hstack([old.joint.reach(first), new.joint.reach(second)]),
        slots,
        not_compared,
    )


def _common(old: RefinedPoses, new: RefinedPoses) -> Iterator[Unknown]:
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


def _selector(refined: RefinedPoses, unknown: Unknown) -> Array:
    """The matrix (m, d) of an unknown's rows; zero for a frame that is known exactly."""
    if unknown in refined.joint.slots:
        return refined.joint.selector((unknown,))
    return np.zeros((6, len(refined.joint.unit)))


def _why_not(old: RefinedPoses, new: RefinedPoses, unknown: Unknown, G: list[Array], unit: Array) -> str:
    """Why a quantity cannot be compared; empty where it can."""
    if not G[0].any() and not G[1].any():
        return "its pose was given as known, in both"
    sides = zip(("OLD", "NEW"), (old, new), G, strict=True)
    free = [name for name, each, rows in sides if _is_free(each.joint.reach(rows) / unit[:, None], unknown)]
    what = "its rotation" if unknown.kind is UnknownKind.FRAME else "it"
    return f"the measurements of {' and of '.join(free)} leave {what} free" if free else ""


def _is_free(reach: Array, unknown: Unknown) -> bool:
    """Whether a free direction turns a frame (no linear model holds then), or changes a number."""
    rows = reach[:3] if unknown.kind is UnknownKind.FRAME else reach
    return bool(reach.shape[1]) and float(np.linalg.norm(rows, axis=1).max()) > SHARE


def _difference(old: RefinedPoses, new: RefinedPoses, unknown: Unknown) -> tuple[Array, tuple[Array, Array]]:
    """New less old, and its derivatives by the errors of both, old first."""
    if unknown.kind is UnknownKind.FRAME:
        first, second = ((each.Y if unknown.owner in each.Y else each.X)[unknown.owner] for each in (old, new))
        xi = error_of(first, second)
        return xi, (-right_jacobian_inverse(-xi[None])[0], right_jacobian_inverse(xi[None])[0])
    values = [numbers_of(refined, unknown) for refined in (old, new)]
    one = np.eye(len(values[0]))
    return values[1] - values[0], (-one, one)


def numbers_of(refined: RefinedPoses, unknown: Unknown) -> Array:
    """The numbers of a camera, a time offset or a scale."""
    if unknown.kind is UnknownKind.INTRINSICS:
        return np.array(refined.intrinsics[unknown.owner].values)
    if unknown.kind is UnknownKind.TIME_OFFSET:
        return np.array([refined.time_offsets_s[unknown.owner]])
    scale = refined.scale
    return np.array([scale_at(scale, unknown.owner)])


#: An eigenvalue of correlations below zero by more than this is not a rounding error.
ROUNDING = 1e-9


def less_common_errors(covariance: Array, common: Array) -> Array | None:
    """A covariance (m, m) less that of errors which several estimates share; None where it is smaller than this."""
    rest: Array = covariance - common
    has = np.diagonal(covariance) > 0.0
    size = np.sqrt(np.maximum(np.diagonal(rest), 0.0))[has]
    if not (size > 0.0).all():
        return None
    correlations = rest[np.ix_(has, has)] / size[:, None] / size
    return rest if np.linalg.eigvalsh(correlations).min(initial=0.0) >= -ROUNDING else None
