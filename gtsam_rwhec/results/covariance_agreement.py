"""Covariances in a result file: rows for every unknown, matrices that can be covariances, and the same in two places.

Every function raises `ValueError` with the JSON path, what was found, and what the file says elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from gtsam_rwhec.files.terminal_text import shown
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.fitting.reprojection_record import SIZE
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.geometry.pose_covariances import standard_deviations
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.results.schema import FrameFields, RefinedFields, SolutionFields

#: Largest difference of two mirrored elements of a covariance, over the root of the product of their variances.
SYMMETRY = 1e-9
#: An eigenvalue of a matrix of correlations may be below zero by this much times its size: rounding.
SEMIDEFINITE = 1e-10
#: Largest difference of an element of F'F from the identity for free directions F, which are orthonormal.
ORTHONORMAL = 1e-6
#: Largest difference of an element that the file has twice, over the root of the product of its variances. Libraries
#: sum in their own order, and the sums cancel where a direction is nearly free.
TWICE = 1e-6


def check_joint(refined: RefinedFields, certified: SolutionFields) -> None:
    """Each unknown has its own rows of the joint covariance, and there are no other rows."""
    names = refined.X.keys() | refined.Y.keys()
    if refined.frames.keys() != names or refined.moved.keys() != names:
        raise ValueError(
            f"$.refined: frames and moved must have the targets and sensors {', '.join(sorted(names))} (found "
            f"{', '.join(sorted(refined.frames))} and {', '.join(sorted(refined.moved))})"
        )
    given, place = refined.joint.slots, "$.refined.joint.slots"
    owners = refined.scale if isinstance(refined.scale, dict) else [""]
    known = {Unknown(UnknownKind.FRAME, name) for name in names}
    known |= {Unknown(UnknownKind.TIME_OFFSET, name) for name in refined.time_offsets_s}
    known |= {Unknown(UnknownKind.SCALE, name) for name in owners if refined.scale_mode != "known"}
    known |= {unknown for unknown in given if _is_of_corners(unknown, refined)}
    if given.keys() - known:
        raise ValueError(f"{place}: unknowns that have no value: {_names(given.keys() - known)}")
    missing = known - given.keys() - _fixed(refined, certified)
    if missing:
        raise ValueError(f"{place}: unknowns that have no rows: {_names(missing)}")
    end = 0
    for unknown, rows in sorted(given.items(), key=lambda item: item[1].start):
        width = _width_of(unknown, refined)
        if (rows.start, rows.stop) != (end, end + width):
            raise ValueError(
                f"{place}.{unknown}: must be [{end}, {end + width}], because rows may neither overlap nor "
                f"be left out (found [{rows.start}, {rows.stop}])"
            )
        end = rows.stop
    _check_matrices(refined.joint, end)


def _is_of_corners(unknown: Unknown, refined: RefinedFields) -> bool:
    """Whether an unknown is one of a camera, or of a board, that the file tells of."""
    boards = {} if refined.reprojection is None else refined.reprojection.boards
    return (unknown.kind is UnknownKind.INTRINSICS and unknown.owner in refined.intrinsics) or (
        unknown.kind is UnknownKind.SHAPE and unknown.owner in boards
    )


def _width_of(unknown: Unknown, refined: RefinedFields) -> int:
    """The rows that an unknown must have."""
    if unknown.kind is UnknownKind.INTRINSICS:
        return len(refined.intrinsics[unknown.owner].names)
    if unknown.kind is UnknownKind.SHAPE and refined.reprojection is not None:
        return len([name for name in refined.reprojection.boards[unknown.owner].names if name != SIZE])
    return unknown.dimension


def _fixed(refined: RefinedFields, certified: SolutionFields) -> set[Unknown]:
    """Frames whose covariance is zero, and scales that refinement did not change: they may be known."""
    frames = (name for name, frame in refined.frames.items() if not any(map(any, frame.covariance)))
    scales: Iterable[str] = ()
    if isinstance(refined.scale, dict):
        before = certified.scale if isinstance(certified.scale, dict) else dict.fromkeys(refined.scale, certified.scale)
        scales = (name for name, scale in refined.scale.items() if scale == before.get(name))
    return {Unknown(UnknownKind.FRAME, name) for name in frames} | {Unknown(UnknownKind.SCALE, name) for name in scales}


def _check_matrices(joint: JointCovariance, size: int) -> None:
    shapes = joint.unit.shape, joint.finite.shape, joint.free.shape[:1]
    if shapes != ((size,), (size, size), (size,)):
        raise ValueError(f"$.refined.joint: slots have {size} rows, but unit, finite and free are {shapes}")
    variances = np.diagonal(joint.finite)
    for i in np.flatnonzero(variances < 0.0)[:1]:
        raise ValueError(f"$.refined.joint.finite[{i}][{i}]: a variance is not negative (found {variances[i]})")
    deviations = np.sqrt(variances)
    with np.errstate(over="ignore"):  # an infinite difference is none that a covariance has
        difference = np.abs(joint.finite - joint.finite.T)
    wrong = np.argwhere(difference > SYMMETRY * np.outer(deviations, deviations))
    for i, j in wrong[:1]:
        raise ValueError(
            f"$.refined.joint.finite[{i}][{j}]: a covariance is symmetric, but [{j}][{i}] is {joint.finite[j, i]} "
            f"(found {joint.finite[i, j]})"
        )
    if not _is_semidefinite(joint.finite, deviations):
        raise ValueError("$.refined.joint.finite: not positive semidefinite, so it is the covariance of nothing")
    with np.errstate(over="ignore", invalid="ignore"):
        gram = joint.free.T @ joint.free
    if not np.abs(gram - np.eye(len(gram))).max(initial=0.0) <= ORTHONORMAL:  # NaN is not
        raise ValueError("$.refined.joint.free: its columns, the free directions, must be orthonormal")


def _is_semidefinite(covariance: Array, deviations: Array) -> bool:
    """Whether the correlations have no eigenvalue below zero; a row of zeros must be zero throughout."""
    unit = np.where(deviations > 0.0, deviations, 1.0)
    with np.errstate(over="ignore", invalid="ignore"):
        correlations = covariance / unit[:, None] / unit
    if not np.isfinite(correlations).all():
        return False
    np.fill_diagonal(correlations, 1.0 + SEMIDEFINITE * len(unit))
    try:
        np.linalg.cholesky(correlations)
    except np.linalg.LinAlgError:
        return False
    return True


def check_frames(file: RefinedFields, refined: RefinedPoses) -> None:
    """The covariance and the standard deviations of each frame are those that follow from the joint covariance."""
    for name, frame in file.frames.items():
        place = f"$.refined.frames.{shown(name)}"
        for what in ("standard_deviations_deg", "standard_deviations_mm"):
            if min(getattr(frame, what)) < 0.0:
                raise ValueError(f"{place}.{what}: must not be negative (found {list(getattr(frame, what))})")
        expected = refined.covariance(name)
        _check_covariance(_matrix(frame, place), expected, f"{place}.covariance")
        degrees, millimetres = standard_deviations(expected)
        for what, values in (("standard_deviations_deg", degrees), ("standard_deviations_mm", millimetres)):
            given = list(getattr(frame, what))
            if not np.allclose(given, values, rtol=TWICE, atol=0.0):
                raise ValueError(f"{place}.{what}: must be {values.tolist()}, by $.refined.joint (found {given})")


def _check_covariance(given: Array, expected: Array, place: str) -> None:
    """NaN in `given` stands for an infinity of either sign in `expected`."""
    finite = np.isfinite(expected)
    if not np.array_equal(finite, np.isfinite(given)):
        raise ValueError(f"{place}: null must stand where the joint covariance is infinite, and nowhere else")
    known = np.where(finite, expected, 0.0)
    deviations = _deviations(known)
    off = np.where(finite, given, 0.0) - known
    for i, j in np.argwhere(np.abs(off) > TWICE * np.maximum(np.outer(deviations, deviations), np.abs(known)))[:1]:
        raise ValueError(f"{place}[{i}][{j}]: must be {expected[i, j]}, by $.refined.joint (found {given[i, j]})")


def _deviations(known: Array) -> Array:
    """The size of each row of a covariance (m, m) with 0 for infinities: its deviation, or what its covariances imply.

    A row whose own variance is infinite may have finite covariances with others.
    """
    deviations = np.sqrt(np.maximum(np.diagonal(known), 0.0))
    implied = np.abs(known) / np.where(deviations > 0.0, deviations, np.inf)
    return np.where(deviations > 0.0, deviations, implied.max(axis=1, initial=0.0))


def _matrix(frame: FrameFields, place: str) -> Array:
    """A frame's covariance (6, 6), with NaN for null."""
    if [len(row) for row in frame.covariance] != [6] * 6:
        raise ValueError(f"{place}.covariance: must be 6 x 6")
    return np.array([[np.nan if value is None else value for value in row] for row in frame.covariance])


def _names(unknowns: Iterable[Unknown]) -> str:
    return ", ".join(sorted(map(str, unknowns)))
