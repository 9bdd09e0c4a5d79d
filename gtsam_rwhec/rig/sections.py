"""The sections of a rig file, field by field, with units; `target_sections` has the sections of targets.

No value is converted, and an unknown key is an error.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from gtsam_rwhec.rig.field_types import Name, Positive, Text, TimeOffset, list_of
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
    """Where the carriers' poses are: in tf (two frames), or on a topic whose poses are T_parent_child."""

    tf: Annotated[tuple[Name, Name], list_of(2, "two frames, [parent, child]")] | None = None
    topic: Text | None = None
    parent: Name | None = None
    child: Name | None = None

    @property
    def frames(self) -> tuple[str, str]:
        """The parent and the child frame of the poses."""
        return self.tf if self.tf is not None else (self.parent or "", self.child or "")

    @model_validator(mode="after")
    def _is_one(self) -> PoseSource:
        if len(self._given("tf", "topic")) != 1:
            raise ValueError("give one of tf: [parent, child] and topic: ... (with parent and child)")
        if self.tf is not None and self._given("parent", "child"):
            raise ValueError("tf names both frames already; leave parent and child out")
        if self.topic is not None and len(self._given("parent", "child")) < 2:
            raise ValueError(f"name the frames of the poses of {self.topic}: parent: ..., child: ...")
        return self


class Carriers(Section):
    """The frame that carries the sensors, the frame that carries the targets, and where their poses are."""

    sensors: Name = Field(description="the frame that carries the sensors, such as hand")
    targets: Name = Field(description="the frame that carries the targets, such as base")
    poses: PoseSource = Field(description="where their poses are: {tf: [parent, child]} or {topic, parent, child}")
    max_gap_s: Positive = 0.2
    noise: PoseNoise | None = None


class Intrinsics(Section):
    """Where a camera's intrinsics are: a topic, a Kalibr camchain, another YAML file, or numbers in this section."""

    topic: Text | None = None
    kalibr: Text | None = None
    camera: Text | None = None
    file: Text | None = None
    model: str | None = None
    width: int | None = None
    height: int | None = None
    K: Annotated[tuple[float, float, float, float], list_of(4, "[fx, fy, cx, cy] in pixels")] | None = None
    D: tuple[float, ...] | None = None

    @model_validator(mode="after")
    def _is_one(self) -> Intrinsics:
        numbers = self._given("model", "width", "height", "K", "D")
        sources = self._given("topic", "kalibr", "file") + (["numbers"] if numbers else [])
        if len(sources) != 1:
            raise ValueError(
                f"{' and '.join(sources) or 'nothing'} given; give one of topic, kalibr (with camera), file, or "
                "numbers (model, width, height, K, D)"
            )
        if (self.kalibr is None) != (self.camera is None):
            raise ValueError("kalibr and camera go together: {kalibr: camchain.yaml, camera: cam0}")
        if numbers:
            self.camera_of_numbers("these numbers")
        return self

    def camera_of_numbers(self, where: str) -> Camera:
        """The camera of model, width, height, K and D; `ValueError` if a number is missing or absurd."""
        if self.width is None or self.height is None or self.K is None or self.model is None:
            missing = [name for name in ("model", "width", "height", "K") if getattr(self, name) is None]
            raise ValueError(f"{' and '.join(missing)} missing")
        fx, fy, cx, cy = self.K
        K = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
        return Camera.of(self.width, self.height, self.model, K, self.D or (), where)


class Sensor(Section):
    """A camera with images, or with the detections of a driver."""

    images: Text | None = Field(default=None, description="topic of the camera's images")
    detections: Text | None = Field(default=None, description="topic of a driver's detections")
    intrinsics: Intrinsics | None = None
    time_offset: TimeOffset = 0.0
    frame: Name | None = None

    @model_validator(mode="after")
    def _is_one(self) -> Sensor:
        given = self._given("images", "detections")
        if len(given) != 1:
            raise ValueError(
                f"{' and '.join(given) or 'nothing'} given; give one of images and detections, which are topics"
            )
        if self.images is not None and self.intrinsics is None:
            raise ValueError(
                "images without intrinsics; give {topic: ...}, {kalibr: ..., camera: ...}, {file: ...} or numbers"
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
