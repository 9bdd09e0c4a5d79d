"""The result file of a calibration of odometries: poses, covariances, what is free, what was given, the proof.

It is another kind of file than the result of cameras that see targets: it has one certificate of a joint cost, and no
targets. ``null`` stands for what is infinite: a standard deviation along a free direction.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import Field, ValidationError

from gtsam_rwhec.calibration.verdict import Ground, Judgement, Verdict
from gtsam_rwhec.errors import FileFormatError, FrameError
from gtsam_rwhec.files.whole_files import read_whole, write_atomically
from gtsam_rwhec.geometry.poses import Array, one_transform
from gtsam_rwhec.geometry.quaternions import of_rotations
from gtsam_rwhec.geometry.real_numbers import finite_or_none
from gtsam_rwhec.odometry.odometry_record import OdometryCalibration, free_in_words
from gtsam_rwhec.results.file_record import FileRecord
from gtsam_rwhec.results.json_tree import in_words

FORMAT: Final = "gtsam-rwhec odometry result"
FORMAT_VERSION: Final = 1
#: A result is at most so many bytes.
MOST_BYTES = 50_000_000
CONVENTIONS = (
    "T_parent_child maps coordinates in the child's frame to those of the parent, which is the reference. Covariances "
    "are of right perturbations T Expmap([omega, v]), rad and m, in the sensor's own axes; null is infinite. A scale "
    "is measured length / true length. A sensor's stamp t is the reference's t + time_offset_s."
)

Row3 = tuple[float, float, float]
Row4 = tuple[float, float, float, float]


class NoiseRecord(FileRecord):
    """How the errors of an odometry grow."""

    rotation_deg_per_sqrt_s: float
    translation_mm_per_sqrt_s: float
    was_found: bool


class SensorRecord(FileRecord):
    """The pose of one sensor in the frame of the reference, its scale and its clock."""

    sensor: str
    parent: str = Field(description="the frame of the reference")
    child: str = Field(description="the sensor's frame")
    translation_m: Row3
    quaternion_wxyz: Row4
    T_parent_child: tuple[Row4, Row4, Row4, Row4]
    standard_deviations_deg: tuple[float | None, float | None, float | None]
    standard_deviations_mm: tuple[float | None, float | None, float | None]
    covariance: tuple[tuple[float | None, ...], ...]
    scale: float | None = Field(description="measured / true length; null where it is known, 1")
    scale_sigma: float | None
    time_offset_s: float
    time_offset_sigma_s: float | None


class TrackRecord(FileRecord):
    """What one sensor measured, the reference too: its noise, its residuals, and what is not used."""

    sensor: str
    noise: NoiseRecord
    residual_rotation: float = Field(description="root mean square, in standard deviations")
    residual_translation: float
    windows: int = Field(description="windows in which it is used")
    removed: dict[str, int] = Field(description="poses and windows that are not used, by reason")


class FreeRecord(FileRecord):
    """One direction in which the answer may move while the motions fit as well."""

    kind: str
    reason: str | None
    frames: Mapping[str, tuple[float, ...]]
    own_scales: dict[str, float]
    sentence: str


class GivenRecord(FileRecord):
    """A number that a person gave, and how the answer depends on it."""

    what: str
    value: float
    sigma: float
    unit: str
    off_by_sigmas: float
    per_unit: dict[str, tuple[float, ...]]
    moved_mm_per_sigma: dict[str, float]
    turned_deg_per_sigma: dict[str, float]


class TogetherRecord(FileRecord):
    """What the clouds of two LiDARs tell of their pose to each other."""

    first: str
    second: str
    used: bool
    T_first_second: tuple[Row4, Row4, Row4, Row4]
    information: tuple[tuple[float, ...], ...] = Field(
        description="of a right perturbation, rotation first; zero: slides"
    )
    places: int
    map_s: float = Field(description="seconds of sweeps in a map")
    overlap: float
    noise_mm: float = Field(description="standard deviation of a distance between both")
    scatter: tuple[float, float] = Field(description="of turns and shifts of places, over what each claims")
    sentence: str


class OtherRecord(FileRecord):
    """Another answer that fits as well."""

    why: str
    cost_above: float
    T_reference_sensor: dict[str, tuple[Row4, Row4, Row4, Row4]]


class CertificateRecord(FileRecord):
    """The proof of the joint cost."""

    status: str
    cost: float
    lower_bound: float | None
    tolerance: float
    region_m: float | None = Field(description="null: the bound is about all answers")
    sentence: str


class OdometryResult(FileRecord):
    """A result file."""

    format: Literal["gtsam-rwhec odometry result"] = FORMAT
    format_version: Annotated[int, Field(ge=1, le=FORMAT_VERSION)] = FORMAT_VERSION
    written_by: str
    verdict: Verdict
    verdict_reason: str
    verdict_grounds: tuple[Ground, ...]
    not_determined: tuple[str, ...]
    conventions: str
    reference: str
    sensors: tuple[SensorRecord, ...]
    tracks: tuple[TrackRecord, ...]
    window_s: float
    windows: int
    free_directions: tuple[FreeRecord, ...]
    given: tuple[GivenRecord, ...]
    other_answers: tuple[OtherRecord, ...]
    together: tuple[TogetherRecord, ...] = ()
    findings: tuple[str, ...]
    remarks: tuple[str, ...]
    certificate: CertificateRecord
    sources: tuple[str, ...]

    @property
    def judgement(self) -> Judgement:
        """The verdict with its grounds."""
        return Judgement(self.verdict, self.verdict_grounds, self.verdict_reason)

    def pose(self, sensor: str) -> Array:
        """T_reference_sensor (4, 4), metres."""
        if sensor == self.reference:
            return np.eye(4)
        found = [one.T_parent_child for one in self.sensors if one.sensor == sensor]
        if not found:
            there = ", ".join((self.reference, *(one.sensor for one in self.sensors)))
            raise FrameError(f"there is no sensor {sensor!r}; there are {there}")
        return one_transform(np.array(found[0]), f"the pose of {sensor}")


def result_of(
    found: OdometryCalibration, frames: Mapping[str, str] | None = None, sources: tuple[str, ...] = ()
) -> OdometryResult:
    """The record of a calibration; `frames` has the names of frames by sensor, `sources` the logs' file names."""
    judgement = found.judgement
    return OdometryResult(
        written_by=f"gtsam-rwhec {version('gtsam-rwhec')}",
        verdict=judgement.verdict,
        verdict_reason=judgement.reason,
        verdict_grounds=judgement.grounds,
        not_determined=free_in_words(found),
        conventions=CONVENTIONS,
        reference=found.reference,
        sensors=tuple(_sensor(found, name, frames or {}) for name in found.order),
        tracks=tuple(_track(found, name) for name in found.sensors),
        window_s=found.windows.seconds,
        windows=found.windows.count,
        free_directions=tuple(
            FreeRecord(
                kind=one.kind.value,
                reason=one.reason.value,
                frames=one.frames,
                own_scales=one.own_scales,
                sentence=str(one),
            )
            for one in found.free_directions
        ),
        given=tuple(
            GivenRecord(
                what=one.what,
                value=one.value,
                sigma=one.sigma,
                unit=one.unit,
                off_by_sigmas=one.off_by,
                per_unit=dict(one.per_unit),
                moved_mm_per_sigma={n: 1e3 * float(np.linalg.norm(t[3:])) for n, t in one.per_sigma.items()},
                turned_deg_per_sigma={n: float(np.degrees(np.linalg.norm(t[:3]))) for n, t in one.per_sigma.items()},
            )
            for one in found.influences
        ),
        other_answers=tuple(
            OtherRecord(
                why=one.why,
                cost_above=one.cost_above,
                T_reference_sensor={name: _rows(T) for name, T in one.T_reference_sensor.items()},
            )
            for one in found.others
        ),
        together=tuple(
            TogetherRecord(
                first=one.first,
                second=one.second,
                used=not one.why_not,
                T_first_second=_rows(one.T_first_second),
                information=_rows(one.information),
                places=one.places,
                map_s=2.0 * one.half_s,
                overlap=one.overlap,
                noise_mm=1e3 * one.noise_m,
                scatter=one.scatter,
                sentence=str(one),
            )
            for one in found.together
        ),
        findings=tuple(finding.words for finding in found.findings),
        remarks=found.remarks,
        certificate=CertificateRecord(
            status=found.certificate.status.value,
            cost=found.certificate.cost,
            lower_bound=finite_or_none(found.certificate.lower_bound),
            tolerance=found.certificate.tolerance,
            region_m=finite_or_none(found.certificate.region_m),
            sentence=str(found.certificate),
        ),
        sources=sources,
    )


def result_json(result: OdometryResult) -> bytes:
    """What `write_odometry_result` writes."""
    return (json.dumps(result.model_dump(mode="json"), indent=2, ensure_ascii=False) + "\n").encode()


def write_odometry_result(result: OdometryResult, path: str | Path) -> None:
    """Write a result file; an existing one is replaced. Raises `FileFormatError` if it cannot be written."""
    write_atomically(path, result_json(result))


def read_odometry_result(path: str | Path) -> OdometryResult:
    """Read a result file; `FileFormatError` if it cannot be read, or is another kind of file."""
    return parse_odometry_result(read_whole(path, MOST_BYTES, "A result was"), path)


def parse_odometry_result(content: bytes, path: str | Path) -> OdometryResult:
    """Read the content of a file; messages name `path`."""
    try:
        return OdometryResult.model_validate_json(content)
    except ValidationError as error:
        raise FileFormatError(f"{path} is no result of a calibration of odometries: {in_words(error)}") from error


def is_odometry_result(content: bytes) -> bool:
    """Whether this is the content of such a file, whole or not."""
    return FORMAT.encode() in content[:1000]


def _sensor(found: OdometryCalibration, name: str, frames: Mapping[str, str]) -> SensorRecord:
    T, covariance = found.T_reference_sensor[name], found.covariance_of(name)
    sigma = np.sqrt(np.diagonal(covariance))
    q = of_rotations(T[None, :3, :3])[0].tolist()  # x, y, z, w
    scale_sigma = None
    if name in found.scales:
        at = 6 * len(found.order) + list(found.scales).index(name)
        scale_sigma = finite_or_none(found.scales[name] * float(np.sqrt(found.covariance[at, at])))
    return SensorRecord(
        sensor=name,
        parent=frames.get(found.reference, found.reference),
        child=frames.get(name, name),
        translation_m=tuple(T[:3, 3].tolist()),
        quaternion_wxyz=(q[3], q[0], q[1], q[2]),
        T_parent_child=_rows(T),
        standard_deviations_deg=_finites(np.degrees(sigma[:3])),
        standard_deviations_mm=_finites(1e3 * sigma[3:]),
        covariance=tuple(map(_finites, covariance)),
        scale=found.scales.get(name),
        scale_sigma=scale_sigma,
        time_offset_s=found.time_offsets_s.get(name, 0.0),
        time_offset_sigma_s=finite_or_none(found.time_offset_sigmas_s.get(name, np.inf)),
    )


def _track(found: OdometryCalibration, name: str) -> TrackRecord:
    noise = found.noise[name]
    return TrackRecord(
        sensor=name,
        noise=NoiseRecord(
            rotation_deg_per_sqrt_s=float(np.degrees(noise.rotation_rad_per_sqrt_s)),
            translation_mm_per_sqrt_s=1e3 * noise.translation_m_per_sqrt_s,
            was_found=name in found.noise_was_found,
        ),
        residual_rotation=found.residuals[name][0],
        residual_translation=found.residuals[name][1],
        windows=found.windows.used[name],
        removed=dict(Counter(str(one.reason) for one in found.removed.get(name, ()))),
    )


def _rows(T: Array) -> Any:
    """The rows as tuples, whose lengths the records check."""
    return tuple(tuple(row) for row in T.tolist())


def _finites(numbers: Array) -> Any:
    return tuple(map(finite_or_none, numbers.tolist()))
