"""The fields of a result file: the library's own frozen dataclasses, which pydantic reads and checks.

A class here declares again the few fields of its base that JSON writes in another way: poses, arrays, and dictionaries
whose keys are pairs. An unknown field is an error, and no value is converted to another type. The docstrings of the
bases describe the fields. Lengths are in metres, angles in radians, times in seconds, unless a name says otherwise.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

import gtsam
import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, GetPydanticSchema, model_validator

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.point_uncertainty import PointUncertainty, point_sentence
from gtsam_rwhec.calibration.verdict import Choice, Finding, Ground, Verdict
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.refined import PairNoise, RefinedPoses
from gtsam_rwhec.fitting.unknowns import Unknown
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.results.acceptance_record import Acceptance
from gtsam_rwhec.results.log_history import LogFields
from gtsam_rwhec.solver.answers import Residual
from gtsam_rwhec.solver.identification import Identifiability, PairIdentifiability
from gtsam_rwhec.solver.solution import Solution

FORMAT: Final = "gtsam-rwhec result"
#: It grows whenever a reader of the version before would misread or refuse the file.
FORMAT_VERSION: Final = 1

#: Name of the frame that carries the sensors, if no rig file names it.
SENSOR_CARRIER = "sensorcarrier"
#: Name of the frame that carries the targets, if no rig file names it.
TARGET_CARRIER = "targetcarrier"
#: Largest difference of an element of R' R from the identity, and of R from its quaternion, in an undamaged file.
POSE_TOLERANCE = 1e-6

CONFIG = ConfigDict(extra="forbid", frozen=True, strict=True)
Triple = tuple[float, float, float]
Name = Annotated[str, Field(min_length=1)]


class Pose(BaseModel):
    """The pose T_parent_child of a frame on its carrier."""

    model_config = CONFIG

    parent: Name = Field(description="the carrier: the frame in which the pose is given, with its name in the rig file")
    child: Name = Field(description="name of the target or sensor whose pose this is")
    translation_m: Triple = Field(description="origin of child in parent, m")
    quaternion_wxyz: tuple[float, float, float, float] = Field(description="rotation, scalar first, for other programs")
    rotation_matrix: tuple[Triple, Triple, Triple] = Field(
        description="the same rotation, row by row. Only the matrix is read back: a quaternion loses the last bit"
    )

    contradicted: bool = Field(
        default=False,
        description="whether the frame's own measurements contradict the answer, for the most part: do not use this "
        "pose; not read back",
    )

    @model_validator(mode="after")
    def _is_a_rotation(self) -> Pose:
        R = np.array(self.rotation_matrix)
        if np.abs(R).max() > 2.0 or np.abs(self.quaternion_wxyz).max() > 2.0:  # larger ones could not be squared
            raise ValueError(f"rotation_matrix or quaternion_wxyz of {self.child} is not a rotation")
        w, *v = self.quaternion_wxyz
        x, y, z = v
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        from_quaternion = (w * w - np.dot(v, v)) * np.eye(3) + 2.0 * np.outer(v, v) + 2.0 * w * cross
        if np.abs(R.T @ R - np.eye(3)).max() > POSE_TOLERANCE or np.linalg.det(R) < 0.0:
            raise ValueError(f"rotation_matrix of {self.child} is not a rotation")
        if np.abs(R - from_quaternion).max() > POSE_TOLERANCE:
            raise ValueError(f"rotation_matrix and quaternion_wxyz of {self.child} are different rotations")
        return self


def pose_rows(
    parent: str, poses: Mapping[str, gtsam.Pose3], contradicted: Collection[str] | None = None
) -> list[dict[str, Any]]:
    """The poses of the frames on one carrier as JSON: rows with the fields of `Pose`.

    Without ``contradicted``, the frames whose poses are not to be used, rows do not say whether they are.
    """
    rows = []
    for name, pose in poses.items():
        q: Any = pose.rotation().toQuaternion()  # Eigen's quaternion, which gtsam's stubs do not type
        rows.append(
            {
                "parent": parent,
                "child": name,
                "translation_m": pose.translation().tolist(),
                "quaternion_wxyz": [q.w(), q.x(), q.y(), q.z()],
                "rotation_matrix": pose.rotation().matrix().tolist(),
                **({} if contradicted is None else {"contradicted": name in contradicted}),
            }
        )
    return rows


def _poses_of(rows: tuple[Pose, ...]) -> dict[str, gtsam.Pose3]:
    names, parents = [row.child for row in rows], {row.parent for row in rows}
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise ValueError(f"two poses have the same name: {', '.join(sorted(twice))}")
    if len(parents) > 1:
        raise ValueError(f"poses are given in several frames: {', '.join(sorted(parents))}")
    return {
        row.child: gtsam.Pose3(gtsam.Rot3(np.array(row.rotation_matrix)), np.array(row.translation_m)) for row in rows
    }


def _array_of(rows: list[list[float]]) -> Array:
    width = len(rows[0]) if rows else 0
    if any(len(row) != width for row in rows):
        raise ValueError("rows of different lengths")
    return np.array(rows, dtype=float).reshape(len(rows), width)


def _as(kind: Any, made: Any) -> GetPydanticSchema:
    """Let pydantic read `kind` and call `made` for a value of the annotated type."""
    return GetPydanticSchema(lambda _, handler: handler.generate_schema(Annotated[kind, AfterValidator(made)]))


def _told_as(kind: type[Any]) -> GetPydanticSchema:
    """Let pydantic read the class `kind` and make a record of its base, which is the library's own class."""
    return _as(kind, lambda record: kind.__bases__[0](**vars(record)))


def _pair_of(key: str) -> Pair:
    try:
        names = json.loads(key)
    except (json.JSONDecodeError, RecursionError):
        names = None
    if not (isinstance(names, list) and len(names) == 2 and all(isinstance(name, str) for name in names)):
        raise ValueError("rows with a target and a sensor were expected")
    return Pair(*names)


#: `json_tree.from_json` makes such keys of a file's rows {target, sensor, ...}.
PairKey = Annotated[Pair, BeforeValidator(_pair_of)]
UnknownKey = Annotated[Unknown, BeforeValidator(Unknown.of)]
Rows = Annotated[slice, _as(tuple[int, int], lambda ends: slice(*ends))]
Poses = _as(tuple[Pose, ...], _poses_of)
Positive = Annotated[float, Field(gt=0.0)]
Scale = Positive | dict[str, Positive]
Matrix = Annotated[Array, _as(list[list[float]], _array_of)]


@dataclass(frozen=True)
class IdentifiabilityFields(Identifiability):
    """What all measurements together determine, in a file."""

    pairs: dict[PairKey, PairIdentifiability]


@dataclass(frozen=True)
class SolutionFields(Solution):
    """The certified solution in a file."""

    X: Annotated[dict[str, gtsam.Pose3], Poses, Field(alias="targets")]
    Y: Annotated[dict[str, gtsam.Pose3], Poses, Field(alias="sensors")]
    scale: Scale
    identifiability: Annotated[Identifiability, _told_as(IdentifiabilityFields)]
    residuals: dict[PairKey, Residual]


@dataclass(frozen=True)
class JointFields(JointCovariance):
    """The joint covariance in a file: a slot is the first row of an unknown, and the row after its last."""

    slots: dict[UnknownKey, Rows]
    finite: Matrix
    free: Matrix
    unit: Annotated[Array, _as(list[Positive], np.array)]


@dataclass(frozen=True)
class FrameFields:
    """How well a refined frame is known. This is for people; only the joint covariance is read back."""

    #: Rotations about the frame's own x, y and z axes, degrees; null: infinite, because a direction is free
    standard_deviations_deg: Triple
    standard_deviations_mm: Triple  #: Translations along the same axes, millimetres; null as above
    #: Covariance of [omega (rad), v (m)]; zero for a fixed frame; null: infinite, of either sign
    covariance: list[list[float | None]]


@dataclass(frozen=True)
class RefinedFields(RefinedPoses):
    """The refined calibration in a file; its poses and scale stand at the top of the file."""

    X: Annotated[dict[str, gtsam.Pose3], Poses, Field(alias="targets")]
    Y: Annotated[dict[str, gtsam.Pose3], Poses, Field(alias="sensors")]
    scale: Scale
    noise: dict[PairKey, PairNoise]
    inlier_counts: dict[PairKey, tuple[int, int]]
    joint: Annotated[JointCovariance, _told_as(JointFields)]
    residual: str  #: "geodesic" or "chordal"
    robust: str  #: The robust loss; "gnc" if outliers were left out; or "none"
    frames: dict[str, FrameFields]  #: How well each target and sensor is known


class ResultFile(BaseModel):
    """A calibration in a file."""

    model_config = CONFIG

    format: Literal["gtsam-rwhec result"] = Field(description="what kind of file this is")
    format_version: Literal[1] = Field(description="the version of these fields")
    written_by: str = Field(description="the library and its version")
    verdict: Verdict = Field(description="use, care or do_not_use")
    verdict_reason: str = Field(description="the reasons as a sentence")
    verdict_grounds: tuple[Ground, ...] = Field(description="reasons not to use the poses, the most serious first")
    conventions: dict[str, str] = Field(description="what poses, scale and units mean; not read back")
    certified: SolutionFields = Field(description="the certified solution, at which a refinement began")
    refined: RefinedFields | None = Field(default=None, description="the refined calibration, if there is one")
    calibration: CalibrationFields | None = Field(default=None, description="what calibrate found and chose, if it ran")
    log: LogFields | None = Field(default=None, description="what became of the measurements, if they come from a log")
    acceptance: tuple[Acceptance, ...] = Field(
        default=(),
        description="by sensor, whether known points that are new to it show that it is off by less than a limit",
    )

    @model_validator(mode="after")
    def _names_fit_together(self) -> ResultFile:
        for answer in (self.certified, self.refined):
            if answer is None:
                continue
            if isinstance(answer.scale, dict) != (answer.scale_mode == "per_target"):
                raise ValueError(f"scale_mode {answer.scale_mode!r} does not go with a scale of {answer.scale!r}")
            names = answer.X.keys() | answer.Y.keys()
            twice = answer.X.keys() & answer.Y.keys()
            if twice:
                raise ValueError(f"two poses have the same name: {', '.join(sorted(twice))}")
            pairs = answer.residuals if isinstance(answer, SolutionFields) else answer.noise
            unknown = {name for pair in pairs for name in pair} - names
            if unknown:
                raise ValueError(f"pairs name frames that have no pose: {', '.join(sorted(unknown))}")
            targets = {pair.target for pair in pairs}
            if isinstance(answer.scale, dict) and not targets <= answer.scale.keys() <= names:
                raise ValueError(
                    f"scale has {', '.join(answer.scale)}, but the targets are {', '.join(sorted(targets))}"
                )
        if self.certified.residuals.keys() != self.certified.identifiability.pairs.keys():
            raise ValueError("residuals and identifiability.pairs have different pairs")
        return self


CONVENTIONS = {
    "poses": (
        "sensors and targets at the top are the poses to use: the refined poses if the answer was refined, and then "
        "certified has the certified poses; otherwise the certified poses"
    ),
    "pose": (
        "T_parent_child is the pose of frame child in frame parent: p_parent = T_parent_child p_child. "
        "quaternion_wxyz is scalar first, of unit norm, and the same rotation as rotation_matrix (rows)."
    ),
    "model": (
        "T_sensorcarrier_targetcarrier T_targetcarrier_target = T_sensorcarrier_sensor T_sensor_target (A X = Y B); "
        "X are the targets' poses and Y the sensors'."
    ),
    "scale": "length of the measured translation of T_sensor_target = scale * true length",
    "units": "m, rad, s; sigma in m, kappa in 1/rad^2 (1/(2 s^2) for a standard deviation of s about each axis)",
    "covariance": (
        "of xi in T_parent_child Expmap(xi), xi = [omega (rad), v (m)], rotation first, in the axes and about the "
        "origin of child (GTSAM's right perturbation)"
    ),
    "intrinsics": (
        "of refined.intrinsics: fx, fy, cx, cy in pixels, with the middle of the upper left pixel at (0, 0), and the "
        "coefficients of the model, as OpenCV has them: radtan k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 (4, 5, 8 "
        "or 12 of them), equidistant k1, k2, k3, k4 of the fisheye model, pinhole none, unified xi, k1, "
        "k2, p1, p2 of the omnidir model, whose fx and fy are divided by 1 + xi here. Their covariance is that of "
        "intrinsics:SENSOR in refined.joint, in the order of names"
    ),
    "shape": (
        "of refined.reprojection.boards: size is the true size less the stated one, a share of 1 (its covariance is "
        "that of the target's scale, 1 / (1 + size)); warp_x and warp_y are heights of its edge over its middle, and "
        "warp_xy that along x = y less that along x = -y, metres; corners_off_m is how far each corner is from its "
        "place on that board, x, y, z in the target's frame, where corners were free"
    ),
    "infinity": (
        "null means an infinite number: minus infinity in lower_bound, float_bound and min_eigenvalue (no bound was "
        "found), infinity of either sign in a covariance, and plus infinity elsewhere"
    ),
    "sentence": "the meaning of a record in words; not read back",
}


@dataclass(frozen=True)
class PointFields:
    """How far off a point is that a sensor sees; ``str()`` is a sentence."""

    #: The sensor's frame, and the frame in which the point is expressed
    frame: str
    seen_from: str
    point_m: tuple[float, float, float]  #: The point in ``frame``, metres
    level: float  #: The true point is within ``radius_mm`` of the given one with this probability
    radius_mm: float  #: Millimetres; infinite (null) where a free direction moves the point
    measurement_mm: float | None  #: The same for the noise of one new measurement alone; None where it is not known

    def __str__(self) -> str:
        distance_m = math.hypot(*self.point_m)
        return point_sentence(self.frame, self.seen_from, distance_m, self.level, self.radius_mm, self.measurement_mm)

    @staticmethod
    def of(point: PointUncertainty) -> PointFields:
        """The record of a point."""
        x, y, z = point.point_m.tolist()
        return PointFields(point.frame, point.seen_from, (x, y, z), point.level, point.radius_mm, point.measurement_mm)


@dataclass(frozen=True)
class CalibrationFields:
    """What ``calibrate`` found and chose."""

    #: What it found against the poses, besides what certificate, free directions and log say; the verdict counts it
    findings: tuple[Finding, ...]
    choices: tuple[Choice, ...]  #: Every choice, with its evidence
    points: tuple[PointFields, ...]  #: How far off a point is, where each sensor typically saw its targets
    noise: str  #: The noise that the answer counts with, in words
    outliers: str  #: How many measurements were left out, in words
    notes: tuple[str, ...]  #: Warnings on the way that changed no choice
    #: Deviations of a constant error of the carriers' poses, which the covariance holds although no residual shows it:
    #: [omega (rad), v (m)] of the targets' carrier in its own axes, and of the sensors'. Another calibration with the
    #: same carriers has the same error.
    constant_errors: tuple[tuple[float, ...], ...] = ()
    cannot_tell: tuple[str, ...] = ()  #: What no residual shows, so that nobody checked it

    @staticmethod
    def of(calibration: Calibration) -> CalibrationFields:
        """What a file keeps of a calibration, besides its solution and its refined poses."""
        return CalibrationFields(
            findings=calibration.findings,
            choices=calibration.choices,
            points=tuple(map(PointFields.of, calibration.points.values())),
            noise=str(calibration.noise),
            outliers=str(calibration.outliers),
            notes=calibration.notes,
            constant_errors=() if calibration.noise.model is None else calibration.noise.model.constant_deviations,
            cannot_tell=calibration.cannot_tell,
        )
