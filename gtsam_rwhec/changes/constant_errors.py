"""The constant error of an arm, which two calibrations with the same arm share: taken out of a covariance again.

A Expmap(c) X = A X Expmap(Ad(X^-1) c): a constant error of A changes no residual, since X takes it up, and so does Y
for one on the other side. ``rw.calibrate`` adds its variance to the covariance. In the difference of two calibrations
it cancels.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.results.result_file import Result

#: An eigenvalue of correlations that is below zero by more than this is none of rounding.
ROUNDING = 1e-9


def has_constant_errors(result: Result) -> bool:
    """Whether the covariance holds a constant error of the carriers' poses, as the result says."""
    return result.calibration is not None and bool(np.any(result.calibration.constant_errors))


def without_constant_errors(result: Result) -> RefinedPoses:
    """The refined calibration with the covariance that it has beside a constant error of the carriers' poses.

    As it is where the result does not say what it holds, or where the covariance does not hold that much of it.
    """
    refined, fields = result.refined, result.calibration
    assert refined is not None
    if fields is None or not has_constant_errors(result):
        return refined
    joint = refined.joint
    finite = joint.finite.copy()
    for poses, deviations in zip((refined.X, refined.Y), fields.constant_errors, strict=True):
        shift = np.zeros((len(finite), 6))
        for name, pose in poses.items():
            unknown = Unknown(UnknownKind.FRAME, name)
            if unknown in joint.slots:
                shift[joint.slots[unknown]] = pose.inverse().AdjointMap() * np.array(deviations)
        finite -= shift @ shift.T
    size = np.sqrt(np.maximum(np.diagonal(finite), 0.0))
    has = np.diagonal(joint.finite) > 0.0
    if not (size[has] > 0.0).all():
        return refined
    correlations = finite[np.ix_(has, has)] / size[has, None] / size[has]
    if np.linalg.eigvalsh(correlations).min(initial=0.0) < -ROUNDING:
        return refined
    return replace(refined, joint=replace(joint, finite=finite))
