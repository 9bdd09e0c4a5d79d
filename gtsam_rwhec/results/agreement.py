"""Facts that a result file states twice, and the rows of its joint covariance: they must agree.

Every function raises `ValueError` with the JSON path, what was found, and what the file says elsewhere.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from gtsam_rwhec.refinement.joint_covariance import JointCovariance
from gtsam_rwhec.refinement.unknowns import Unknown, UnknownKind
from gtsam_rwhec.results.json_tree import POSED
from gtsam_rwhec.results.schema import RefinedFields, SolutionFields
from gtsam_rwhec.results.verdict import Verdict
from gtsam_rwhec.solver.cause import Cause
from gtsam_rwhec.solver.certificate import Certificate

#: Largest difference of two mirrored elements of a covariance, over the root of the product of their variances.
SYMMETRY = 1e-9


def check_top(tree: Mapping[str, Any]) -> None:
    """Without refined poses, the poses and the scale at the top of a file are the certified ones."""
    for name in POSED:
        if name not in tree:
            raise ValueError(f"$.{name}: Field required")
        if _text(tree[name]) != _text(tree["certified"][name]):
            given = _text(tree[name])
            value = f" (found {given})" if len(given) <= 60 else ""
            raise ValueError(
                f"$.{name}: differs from $.certified.{name}{value}, but the file has no refined poses; write it again"
            )


def check_certificates(solution: SolutionFields) -> None:
    """The status of a certificate is the status of its cause. Files of versions 1 to 3 have no causes."""
    _check_certificate(solution.certificate, "$.certified.certificate")
    for index, part in enumerate(solution.parts):
        _check_certificate(part.certificate, f"$.certified.parts[{index}].certificate")


def check_verdict(stated: Verdict, found: Verdict) -> None:
    """The verdict of a file is what its facts lead to."""
    if stated is not found:
        raise ValueError(f"$.verdict: the file says '{stated}', but its content leads to '{found}'; write it again")


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
    if given.keys() - known:
        raise ValueError(f"{place}: unknowns that have no value: {_names(given.keys() - known)}")
    missing = known - given.keys() - _fixed(refined, certified)
    if missing:
        raise ValueError(f"{place}: unknowns that have no rows: {_names(missing)}")
    end = 0
    for unknown, rows in sorted(given.items(), key=lambda item: item[1].start):
        if (rows.start, rows.stop) != (end, end + unknown.dimension):
            raise ValueError(
                f"{place}.{unknown}: must be [{end}, {end + unknown.dimension}], because rows may neither overlap nor "
                f"be left out (found [{rows.start}, {rows.stop}])"
            )
        end = rows.stop
    _check_matrices(refined.joint, end)


def _fixed(refined: RefinedFields, certified: SolutionFields) -> set[Unknown]:
    """Frames whose covariance is zero, and scales that refinement did not change: they may be known."""
    frames = (name for name, frame in refined.frames.items() if not any(map(any, frame.covariance)))
    scales: Iterable[str] = ()
    if isinstance(refined.scale, dict) and isinstance(certified.scale, dict):
        scales = (name for name, scale in refined.scale.items() if scale == certified.scale.get(name))
    return {Unknown(UnknownKind.FRAME, name) for name in frames} | {Unknown(UnknownKind.SCALE, name) for name in scales}


def _check_matrices(joint: JointCovariance, size: int) -> None:
    shapes = joint.unit.shape, joint.finite.shape, joint.free.shape[:1]
    if shapes != ((size,), (size, size), (size,)):
        raise ValueError(f"$.refined.joint: slots have {size} rows, but unit, finite and free are {shapes}")
    deviations = np.sqrt(np.abs(np.diagonal(joint.finite)))
    wrong = np.argwhere(np.abs(joint.finite - joint.finite.T) > SYMMETRY * np.outer(deviations, deviations))
    for i, j in wrong[:1]:
        raise ValueError(
            f"$.refined.joint.finite[{i}][{j}]: a covariance is symmetric, but [{j}][{i}] is {joint.finite[j, i]} "
            f"(found {joint.finite[i, j]})"
        )


def _check_certificate(certificate: Certificate, place: str) -> None:
    cause, status = certificate.cause, certificate.status
    if cause is not Cause.NOT_RECORDED and status is not cause.status:
        raise ValueError(f"{place}.status: must be '{cause.status}' with the cause '{cause}' (found '{status}')")


def _names(unknowns: Iterable[Unknown]) -> str:
    return ", ".join(sorted(map(str, unknowns)))


def _text(value: Any) -> str:
    return json.dumps(value, sort_keys=True)
