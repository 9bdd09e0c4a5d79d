"""The sections of a rig file, field by field, with units; `target_sections` has the sections of targets.

No value is converted, and an unknown key is an error.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from gtsam_rwhec.rig.field_types import EulerAxes, FramePair, Name, Positive, Text, TimeOffset, list_of
from gtsam_rwhec.vision.camera import Camera


class Section(BaseModel):
    """Rules for all sections: no unknown keys, no conversion, only finite numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    def _given(self, *names: str) -> list[str]:
        """Those of these keys that the section has."""
        return [name for name in names if getattr(self, name) is not None]


class PoseNoise(Section):
    """Noise of poses: standard deviations about and along each axis."""

    rotation_deg: Positive = Field(description="standard deviation about each axis, degrees")
    translation_mm: Positive = Field(description="standard deviation along each axis, millimetres")


class PoseSource(Section):
    """Where the carriers' poses are: in tf (two frames), on a topic, or in files beside the images (frames).

    Poses are T_parent_child. How the numbers of files are meant is stated here where the files do not say it.
    """

    tf: FramePair | None = None
    topic: Text | None = None
    parent: Name | None = None
    child: Name | None = None
    frames: FramePair | None = None
    quaternion: Literal["xyzw", "wxyz"] | None = None
    euler: EulerAxes | None = None
    angles: Literal["degrees", "radians"] | None = None
    length: Literal["m", "mm"] | None = None
    one_instant: bool | None = None

    @property
    def parent_and_child(self) -> tuple[str, str]:
        """The parent and the child frame of the poses."""
        return self.tf or self.frames or (self.parent or "", self.child or "")

    @model_validator(mode="after")
    def _is_one(self) -> PoseSource:
        if len(self._given("tf", "topic", "frames")) != 1:
            raise ValueError(
                "give one of tf: [parent, child], topic: ... (with parent and child), and, for poses in files beside "
                "images, frames: [parent, child]"
            )
        if self.topic is None and self._given("parent", "child"):
            raise ValueError(f"{self._given('tf', 'frames')[0]} names both frames already; leave parent and child out")
        if self.topic is not None and len(self._given("parent", "child")) < 2:
            raise ValueError(f"name the frames of the poses of {self.topic}: parent: ..., child: ...")
        of_files = self._given("quaternion", "euler", "angles", "length", "one_instant")
        if of_files and self.frames is None:
            raise ValueError(f"{', '.join(of_files)}: only for poses in files, with frames: [parent, child]")
        return self


class Carriers(Section):
    """The frame that carries the sensors, the frame that carries the targets, and where their poses are."""

    sensors: Name = Field(description="the frame that carries the sensors, such as hand")
    targets: Name = Field(description="the frame that carries the targets, such as base")
    poses: PoseSource = Field(
        description="where their poses are: {tf: [parent, child]}, {topic, parent, child} or {frames: [parent, child]}"
    )
    max_gap_s: Positive = 0.2
    noise: PoseNoise | None = None


class Intrinsics(Section):
    """Where a camera's intrinsics are: a topic, a Kalibr camchain, another file, or numbers in this section."""

    topic: Text | None = None
    kalibr: Text | None = None
    camera: Text | None = None
    file: Text | None = None
    model: str | None = None
    width: int | None = None
    height: int | None = None
    size: Annotated[tuple[int, int], list_of(2, "[width, height] in pixels")] | None = None
    K: Annotated[tuple[float, float, float, float], list_of(4, "[fx, fy, cx, cy] in pixels")] | None = None
    D: tuple[float, ...] | None = None

    @model_validator(mode="after")
    def _is_one(self) -> Intrinsics:
        of_file = self.file is not None or self.kalibr is not None
        # A file of OpenCV may lack the size of the images.
        numbers = self._given("model", "width", "height", "K", "D", *([] if of_file else ["size"]))
        sources = self._given("topic", "kalibr", "file") + (["numbers"] if numbers else [])
        if len(sources) != 1:
            raise ValueError(
                f"{' and '.join(sources) or 'nothing'} given; give one of topic, kalibr (with camera), file, or "
                "numbers (K, size, and model and D with distortion)"
            )
        if self.camera is not None and not of_file:
            raise ValueError("camera goes with a file: {file: camchain.yaml, camera: cam0}")
        if numbers:
            self.camera_of_numbers("these numbers")
        return self

    def camera_of_numbers(self, where: str) -> Camera:
        """The camera of size, K, model and D; `ValueError` if a number is missing or absurd."""
        if self.size is not None and self._given("width", "height"):
            raise ValueError("size has the width and the height already; leave width and height out")
        width, height = self.size or (self.width, self.height)
        if width is None or height is None or self.K is None:
            given = {"size: [width, height]": width is not None and height is not None, "K": self.K is not None}
            raise ValueError(f"{' and '.join(name for name, there in given.items() if not there)} missing")
        if self.model is None and self.D and any(self.D):
            raise ValueError("D without model; say which coefficients these are: model: radtan or equidistant")
        fx, fy, cx, cy = self.K
        K = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
        return Camera.of(width, height, self.model or "pinhole", K, self.D or (), where)


def _file_or_section(given: Any) -> Any:
    """A section of intrinsics; text alone is a file."""
    return {"file": given} if isinstance(given, str) else given


class Sensor(Section):
    """A camera with images, or with the detections of a driver."""

    images: Text | None = Field(default=None, description="topic of the camera's images; in a folder, their path")
    poses: Text | None = Field(default=None, description="in a folder: path of the carriers' poses, a file or a folder")
    detections: Text | None = Field(default=None, description="topic of a driver's detections")
    intrinsics: Annotated[Intrinsics, BeforeValidator(_file_or_section)] | None = None
    time_offset: TimeOffset = 0.0
    frame: Name | None = None

    @model_validator(mode="after")
    def _is_one(self) -> Sensor:
        given = self._given("images", "detections")
        if len(given) != 1:
            raise ValueError(
                f"{' and '.join(given) or 'nothing'} given; give one of images (a topic of a log, or a path in a "
                "folder) and detections (a topic)"
            )
        if self.poses is not None and self.images is None:
            raise ValueError("poses go with images in a folder; poses of detections are in the log")
        if self.images is not None and self.intrinsics is None:
            raise ValueError(
                "images without intrinsics; give FILE, {topic: ...}, {kalibr: ..., camera: ...} or numbers, "
                "{K: [fx, fy, cx, cy], size: [width, height]}"
            )
        return self


class DetectionNoise(Section):
    """Noise of the detections (B): standard deviations about and along each axis, or of a corner in pixels."""

    rotation_deg: Positive | None = None
    translation_mm: Positive | None = None
    corner_px: Positive | None = None

    @model_validator(mode="after")
    def _is_one(self) -> DetectionNoise:
        given = self._given("rotation_deg", "translation_mm", "corner_px")
        if given not in (["rotation_deg", "translation_mm"], ["corner_px"]):
            raise ValueError(
                f"{' and '.join(given) or 'nothing'} given; give rotation_deg and translation_mm, or corner_px, or the "
                "word estimate in place of the section"
            )
        return self


class Cleaning(Section):
    """Which measurements cleaning removes before solving; a limit of null removes nothing."""

    min_rotation_deg: Positive = 0.5
    min_translation_mm: Positive = 3.0
    max_rotation_deg_s: Positive | None = None
    max_translation_m_s: Positive | None = None
    consensus: bool = True
    thin: bool = True
    robust: Literal["none", "huber", "cauchy", "tukey", "geman_mcclure", "gnc"] = "gnc"
