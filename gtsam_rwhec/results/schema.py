"""The fields of a result file, one by one: what `gtsam_rwhec.results.solution_file` writes, and all that it reads.

The file is JSON, one object of type `ResultFile`. Lengths are in metres, angles in radians, times in seconds; each
field's name says which. JSON has no infinity: where a number may be infinite the field's description says what ``null``
stands for. Numbers are written with as many digits as bring back the same double.
"""

from __future__ import annotations

import math
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, model_validator

from gtsam_rwhec.results.stage_reports import LogFields
from gtsam_rwhec.solver.cause import Status

FORMAT: Final = "gtsam-rwhec result"
FORMAT_VERSION: Final = 3
"""Raised whenever a reader of the last version would misread or refuse the file: 3 with what became of a log."""
REFINED_VERSION: Final = 2
UNREFINED_VERSION: Final = 1
"""Still written where there is less, for readers of these."""

CONVENTIONS = {
    "pose": (
        "T_parent_child is the pose of frame child in frame parent: p_parent = T_parent_child p_child. "
        "quaternion_wxyz is scalar first, of unit norm, and says the same as rotation_matrix (rows)."
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
    "infinity": "null stands for a number that is infinite; which infinity is said in the field's description",
}

POSE_TOLERANCE = 1e-6
"""How far a file's rotation may be from a rotation, and its quaternion from it, before it is taken for damaged."""

Triple = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
Quadruple = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]


def _finite_or(infinity: float) -> tuple[BeforeValidator, AfterValidator]:
    """Read null as this infinity, and refuse what would be written as null without being it."""

    def check(number: float) -> float:
        if not math.isfinite(number) and number != infinity:
            raise ValueError(f"must be finite, or {infinity} (null)")
        return number

    return BeforeValidator(lambda given: infinity if given is None else given), AfterValidator(check)


InfinityIfNull = Annotated[float, *_finite_or(math.inf)]
MinusInfinityIfNull = Annotated[float, *_finite_or(-math.inf)]
Positive = Annotated[FiniteFloat, Field(gt=0.0)]
Count = Annotated[int, Field(ge=0)]
Deviations = tuple[InfinityIfNull, InfinityIfNull, InfinityIfNull]
Row = tuple[
    FiniteFloat | None,
    FiniteFloat | None,
    FiniteFloat | None,
    FiniteFloat | None,
    FiniteFloat | None,
    FiniteFloat | None,
]
Name = Annotated[str, Field(min_length=1)]


class _Model(BaseModel):
    """Everything that is not described here is an error, and nothing is converted."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, ser_json_inf_nan="null")


class Pose(_Model):
    """T_parent_child."""

    parent: Literal["targetcarrier", "sensorcarrier"] = Field(description="the frame in which the pose is given")
    child: Name = Field(description="the frame whose pose it is: the target's or sensor's name")
    translation_m: Triple = Field(description="origin of child in parent, m")
    quaternion_wxyz: Quadruple = Field(description="rotation, scalar first, for readers that want quaternions")
    rotation_matrix: tuple[Triple, Triple, Triple] = Field(
        description="the same rotation, row by row; this is what is read back, as a quaternion loses the last bit"
    )

    @model_validator(mode="after")
    def _is_a_rotation(self) -> Pose:
        R = np.array(self.rotation_matrix)
        w, *v = self.quaternion_wxyz
        x, y, z = v
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        from_quaternion = (w * w - np.dot(v, v)) * np.eye(3) + 2.0 * np.outer(v, v) + 2.0 * w * cross
        if np.abs(R.T @ R - np.eye(3)).max() > POSE_TOLERANCE or np.linalg.det(R) < 0.0:
            raise ValueError(f"rotation_matrix of {self.child} is not a rotation")
        if np.abs(R - from_quaternion).max() > POSE_TOLERANCE:
            raise ValueError(f"rotation_matrix and quaternion_wxyz of {self.child} are different rotations")
        return self


class Scale(_Model):
    """Measured length = scale * true length."""

    mode: Literal["known", "shared", "per_target"] = Field(description="what was known about it")
    value: Positive | None = Field(description="the scale of all; 1 when known; null when each has its own")
    by_frame: dict[str, Positive] | None = Field(description="the scale of each target, when each has its own; or null")

    @model_validator(mode="after")
    def _fits_its_mode(self) -> Scale:
        needed, other = ("by_frame", "value") if self.mode == "per_target" else ("value", "by_frame")
        if getattr(self, needed) is None or getattr(self, other) is not None:
            raise ValueError(f"a scale of mode {self.mode!r} needs {needed}, and {other} must be null")
        return self


class CertificateFields(_Model):
    """What is proven about the cost."""

    status: Status = Field(description="certified, certified_not_unique, gap or failed")
    reason: str = Field(description="what the certificate needed, or why there is none")
    objective: str = Field(description="which cost it is about")
    path: str = Field(description="which method gave the answer and the bound")
    cost: FiniteFloat = Field(description="the objective at the answer")
    lower_bound: MinusInfinityIfNull = Field(description="no answer costs less, rounding included; null: no bound")
    float_bound: MinusInfinityIfNull = Field(description="the same without the allowance for rounding; null: no bound")
    min_eigenvalue: MinusInfinityIfNull = Field(
        description="a lower bound on the smallest eigenvalue of the certificate's matrix; null: no bound"
    )
    tolerance: FiniteFloat = Field(description="the absolute gap up to which the status says certified")
    is_relative: bool = Field(description="true: unit weights, so the cost has no statistical meaning")
    seconds: dict[str, FiniteFloat] = Field(description="time of each stage, s")


class Part(_Model):
    """Frames that measurements connect, solved apart from all others."""

    names: tuple[Name, ...] = Field(description="its targets and sensors")
    certificate: CertificateFields = Field(description="the certificate of this part alone")


class PairFields(_Model):
    """One target seen by one sensor; or one sensor's own motion, then both names are the sensor's."""

    target: Name = Field(description="its name, as in targets; or the sensor's")
    sensor: Name = Field(description="its name, as in sensors")
    number_of_measurements: Count = Field(description="poses of this pair")
    translation_rms_m: FiniteFloat = Field(description="root mean square of the translation residual, true metres")
    rotation_rms_rad: FiniteFloat = Field(description="root mean square of the rotation residual's angle, rad")
    is_unique: bool = Field(description="whether this pair's measurements determine its frames without any others")
    free_directions: tuple[str, ...] = Field(description="what they do not determine, in words")
    rotation_axes: Count = Field(description="about how many axes the motion turned: 0, 1, or 2 for two and more")
    weakest: InfinityIfNull = Field(
        description="information of the weakest direction over what noise would create; null: nothing to determine"
    )
    threshold: FiniteFloat = Field(description="up to which weakest counts as free")


class IdentifiabilityFields(_Model):
    """What all measurements together determine."""

    is_unique: bool = Field(description="whether every frame and scale is determined")
    free_directions: tuple[str, ...] = Field(description="each frame's free directions, in words")
    weakest: InfinityIfNull = Field(description="as for a pair; null: nothing to determine")
    threshold: FiniteFloat = Field(description="up to which weakest counts as free")
    explanation: str = Field(description="how what a pair determines spreads to the whole")
    parts: tuple[tuple[Name, ...], ...] = Field(description="the frames of each unconnected part")


class RefinedFrame(_Model):
    """How well a refined frame is known, and how far refining moved it."""

    name: Name = Field(description="as in targets or sensors")
    standard_deviations_deg: Deviations = Field(description="about the frame's own x, y, z; null: infinite, free")
    standard_deviations_mm: Deviations = Field(description="along the frame's own x, y, z; null: infinite, free")
    covariance: tuple[Row, Row, Row, Row, Row, Row] = Field(
        description="6 x 6, rows [omega (rad), v (m)]; zero for a fixed frame; null: infinite, of either sign"
    )
    moved_mm: FiniteFloat = Field(description="from the certified solution")
    moved_deg: FiniteFloat = Field(description="from the certified solution")


class RefinedPair(_Model):
    """The noise of a pair's T_sensor_target that the covariances rest on, and its inliers."""

    target: Name = Field(description="its name, as in targets; or the sensor's")
    sensor: Name = Field(description="its name, as in sensors")
    noise_rad: FiniteFloat = Field(description="of the rotation, root mean square an axis")
    noise_m: FiniteFloat = Field(description="of the translation, root mean square an axis")
    redundancy: tuple[InfinityIfNull, InfinityIfNull] = Field(
        description="equations to spare behind the two; null: infinitely many, the noise was given"
    )
    inliers: tuple[Count, Count] | None = Field(
        description="measurements kept, and all of them; null: outliers were not looked for"
    )


class Unknown(_Model):
    """Some rows of the joint covariance."""

    name: Name = Field(description="a frame, scale, scale:TARGET or time_offset:SENSOR")
    rows: Literal[1, 6] = Field(description="how many rows it has; 6 for a frame, [omega (rad), v (m)]")


class Joint(_Model):
    """Covariance of everything that was unknown: finite, and infinite along the columns of free."""

    unknowns: tuple[Unknown, ...] = Field(description="what the rows are of, in this order")
    units: tuple[Positive, ...] = Field(description="what counts as one of each row, in rad, m, s")
    finite: tuple[tuple[FiniteFloat, ...], ...] = Field(description="lower triangle, row by row, with the diagonal")
    free: tuple[tuple[FiniteFloat, ...], ...] = Field(
        description="orthonormal directions of infinite variance, each with a number for each row, in the units above"
    )

    @model_validator(mode="after")
    def _sizes_fit(self) -> Joint:
        size = sum(unknown.rows for unknown in self.unknowns)
        if len(self.units) != size or [len(row) for row in self.finite] != list(range(1, size + 1)):
            raise ValueError(f"unknowns have {size} rows, units {len(self.units)} and finite {len(self.finite)}")
        if any(len(direction) != size for direction in self.free):
            raise ValueError(f"a direction in free has not {size} numbers")
        return self


class RefinedFields(_Model):
    """The calibration refined under the noise that there is, and how well it is known."""

    targets: tuple[Pose, ...] = Field(description="X: T_targetcarrier_target of each target")
    sensors: tuple[Pose, ...] = Field(description="Y: T_sensorcarrier_sensor of each sensor")
    scale: Scale
    time_offsets_s: dict[Name, FiniteFloat] = Field(description="by sensor: its stamp t is the carriers' t + offset")
    noise_source: Literal["given", "estimated"] = Field(description="where the noise of pairs comes from")
    residual: str = Field(description="geodesic or chordal")
    robust: str = Field(description="the loss; gnc: outliers were left out; or none")
    cost: FiniteFloat = Field(description="of the refined graph, at the end")
    initial_cost: FiniteFloat = Field(description="of the refined graph, at the certified solution")
    iterations: Count = Field(description="Levenberg-Marquardt steps")
    free_directions: tuple[str, ...] = Field(description="in words; none where everything is determined")
    frames: tuple[RefinedFrame, ...] = Field(description="every target and sensor, for people; joint is read back")
    pairs: tuple[RefinedPair, ...] = Field(description="every pair whose measurements were used")
    joint: Joint

    @model_validator(mode="after")
    def _names_fit_together(self) -> RefinedFields:
        names = {pose.child for pose in (*self.targets, *self.sensors)}
        if {frame.name for frame in self.frames} != names:
            raise ValueError(f"frames are not the targets and sensors {', '.join(sorted(names))}")
        offsets = {f"time_offset:{name}" for name in self.time_offsets_s}
        scales = {"scale", *(f"scale:{name}" for name in self.scale.by_frame or {})}
        unknown = {unknown.name for unknown in self.joint.unknowns} - names - offsets - scales
        if unknown:
            raise ValueError(f"unknowns that have no value: {', '.join(sorted(unknown))}")
        return self


class ResultFile(_Model):
    """A calibration and everything that is known about it."""

    format: Literal["gtsam-rwhec result"] = Field(description="what kind of file this is")
    format_version: Literal[1, 2, 3] = Field(
        description="the version of these fields: 1 without refined, 2 with it, 3 with it and log"
    )
    written_by: str = Field(description="the library and its version")
    conventions: dict[str, str] = Field(description="what poses, scale and units mean, for people; not read back")
    targets: tuple[Pose, ...] = Field(description="X: T_targetcarrier_target of each target")
    sensors: tuple[Pose, ...] = Field(description="Y: T_sensorcarrier_sensor of each sensor")
    scale: Scale
    cost: FiniteFloat = Field(description="J at the answer; half a chi-square unless is_relative")
    is_relative: bool = Field(description="true: weights were left out, so costs and covariances are relative")
    certificate: CertificateFields
    identifiability: IdentifiabilityFields
    pairs: tuple[PairFields, ...] = Field(description="every pair that was measured")
    parts: tuple[Part, ...] = Field(description="the unconnected parts; one when all is connected")
    refined: RefinedFields | None = Field(default=None, description="left out where nothing was refined")
    log: LogFields | None = Field(default=None, description="left out where the measurements are of no log")

    @model_validator(mode="after")
    def _names_fit_together(self) -> ResultFile:
        version = 1 + (self.refined is not None) + (self.log is not None)
        if self.format_version != version or (self.refined is None and self.log is not None):
            raise ValueError(
                f"a file of version {self.format_version} with refined: {self.refined is not None}, log: "
                f"{self.log is not None}"
            )
        names = [pose.child for pose in (*self.targets, *self.sensors)]
        twice = {name for name in names if names.count(name) > 1}
        if twice:
            raise ValueError(f"two poses have the same name: {', '.join(sorted(twice))}")
        for kind, carrier in (("targets", "targetcarrier"), ("sensors", "sensorcarrier")):
            poses: tuple[Pose, ...] = getattr(self, kind)
            wrong = [pose.child for pose in poses if pose.parent != carrier]
            if wrong:
                raise ValueError(f"{kind} are given in {carrier}, but {', '.join(wrong)} in another frame")
        unknown = {name for pair in self.pairs for name in (pair.target, pair.sensor)} - set(names)
        if unknown:
            raise ValueError(f"pairs name frames that have no pose: {', '.join(sorted(unknown))}")
        return self
