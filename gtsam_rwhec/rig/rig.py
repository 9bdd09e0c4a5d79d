"""A whole rig file: its sections, with a check for contradictions between them."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, ValidationError, model_validator
from pydantic import Tag as UnionTag
from pydantic_core import InitErrorDetails, PydanticCustomError

from gtsam_rwhec.rig.contradictions import contradictions
from gtsam_rwhec.rig.field_types import Name
from gtsam_rwhec.rig.sections import Carriers, Cleaning, DetectionNoise, Section, Sensor
from gtsam_rwhec.rig.target_sections import TargetSection
from gtsam_rwhec.vision.options import DetectionOptions
from gtsam_rwhec.vision.targets import Target


class RigFile(Section):
    """The content of a rig file."""

    carriers: Carriers = Field(description="the frames that carry the sensors and the targets, and their poses")
    sensors: dict[Name, Sensor] = Field(description="by name, each with images or detections")
    targets: dict[Name, TargetSection] = Field(description="by name, each with type and sizes")
    sizes: Literal["known", "check", "estimate"] = "check"
    noise: Annotated[
        Annotated[DetectionNoise, UnionTag("numbers")] | Annotated[Literal["estimate"], UnionTag("word")],
        Discriminator(lambda given: "word" if isinstance(given, str) else "numbers"),
    ] = "estimate"
    detection: dict[str, Any] = Field(default={}, description="fields of vision's DetectionOptions")
    cleaning: Cleaning = Cleaning()

    @cached_property
    def target_list(self) -> tuple[Target, ...]:
        """The targets with their names, in the order of the file, for the vision package."""
        return tuple(section.target(name) for name, section in self.targets.items())

    @property
    def corner_px(self) -> float | None:
        """Standard deviation of a corner along each axis, pixels; None if the rig file does not state it."""
        return None if self.noise == "estimate" else self.noise.corner_px

    @property
    def detection_options(self) -> DetectionOptions:
        """The options of detection, with the values of the section ``detection``."""
        return DetectionOptions(**self.detection)

    def frame_of(self, sensor: str) -> str:
        """The name of a sensor's frame."""
        return self.sensors[sensor].frame or sensor

    @model_validator(mode="after")
    def _is_consistent(self) -> RigFile:
        # pydantic keeps the places of the faults of a ValidationError that is raised here.
        faults = [
            InitErrorDetails(type=PydanticCustomError("value_error", "{words}", {"words": words}), loc=path, input=None)
            for path, words in contradictions(self.carriers, self.sensors, self.targets, self.detection)
        ]
        if faults:
            raise ValidationError.from_exception_data("rig", faults)
        return self


class Rig(RigFile):
    """A rig file that was read: its content, and the folder that its relative paths start from."""

    folder: Path = Path()
