"""A whole rig file: its sections, with a check for contradictions between them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import ConfigDict, Discriminator, Field, ValidationError, model_validator
from pydantic import Tag as UnionTag
from pydantic_core import InitErrorDetails, PydanticCustomError

from gtsam_rwhec.cameras.targets import Target
from gtsam_rwhec.detect.detections import DetectionOptions
from gtsam_rwhec.files.yaml_lines import KeyPath, dotted
from gtsam_rwhec.rig.contradictions import contradictions
from gtsam_rwhec.rig.field_types import Name
from gtsam_rwhec.rig.given_section import GivenSection
from gtsam_rwhec.rig.odometry_contradictions import odometry_contradictions
from gtsam_rwhec.rig.odometry_section import OdometrySensor
from gtsam_rwhec.rig.reference_carrier import with_what_follows
from gtsam_rwhec.rig.section import Section
from gtsam_rwhec.rig.sections import Carriers, Cleaning, DetectionNoise, Sensor
from gtsam_rwhec.rig.target_sections import TargetSection

#: Sensors that see targets have images or detections; others have odometry.
AnySensor: TypeAlias = Annotated[
    Annotated[Sensor, UnionTag("sees")] | Annotated[OdometrySensor, UnionTag("moves")],
    Discriminator(
        lambda given: "moves" if "odometry" in (given if isinstance(given, dict) else dir(given)) else "sees"
    ),
]


def _may_leave_out(schema: dict[str, Any]) -> None:
    """In the JSON Schema: a reference takes the place of carriers, and odometries alone need no targets."""
    schema["required"] = ["sensors"]
    schema["oneOf"] = [{"required": ["carriers"]}, {"required": ["reference"]}]
    alone = {"properties": {"sensors": {"additionalProperties": {"required": ["odometry"]}}}}
    schema |= {"if": alone, "then": {}, "else": {"required": ["targets"]}}


class RigFile(Section):
    """The content of a rig file."""

    model_config = ConfigDict(json_schema_extra=_may_leave_out)

    carriers: Carriers = Field(description="the frames that carry the sensors and the targets, and their poses")
    all_sensors: dict[Name, AnySensor] = Field(
        alias="sensors",
        description="by name, each with images or detections of targets, or with the odometry of its own motion",
    )
    targets: dict[Name, TargetSection] = Field(
        description="by name, each with type and sizes; sensors that all have odometry need none"
    )
    sizes: Literal["known", "check", "estimate"] = Field(
        default="check",
        description="known: the targets' sizes are right. check: they are taken as stated if the motion agrees, else "
        "estimated and named. estimate: from the motion",
        examples=["known"],
    )
    noise: Annotated[
        Annotated[DetectionNoise, UnionTag("numbers")] | Annotated[Literal["estimate"], UnionTag("word")],
        Discriminator(lambda given: "word" if isinstance(given, str) else "numbers"),
    ] = Field(
        default="estimate",
        description="of the detections: the word estimate, from the residuals, or a section",
        examples=[{"corner_px": 0.1}],
    )
    detection: dict[str, Any] = Field(
        default={}, description="limits beyond which a detection is not used", examples=[{"min_side_px": 20}]
    )
    cleaning: Cleaning = Field(
        default=Cleaning(),
        description="which measurements are left out before solving",
        examples=[{"max_rotation_deg_s": 60.0}],
    )
    reference: Name | None = Field(
        default=None,
        description="in place of carriers: the sensor with odometry in whose frame all others are calibrated",
        examples=["lidar_front"],
    )
    given: GivenSection = Field(
        default=GivenSection(),
        description="what a person measured where the motion does not tell: heights, directions, distances",
        examples=[{"heights_m": {"lidar_front": 0.52, "lidar_rear": 0.71}}],
    )

    @cached_property
    def sensors(self) -> dict[str, Sensor]:
        """The sensors that see targets, by name."""
        return {name: sensor for name, sensor in self.all_sensors.items() if isinstance(sensor, Sensor)}

    @cached_property
    def odometries(self) -> dict[str, OdometrySensor]:
        """The sensors that know only their own motion, by name; with the reference."""
        return {name: sensor for name, sensor in self.all_sensors.items() if isinstance(sensor, OdometrySensor)}

    @property
    def is_of_odometries(self) -> bool:
        """Whether no sensor sees a target, and only the sensors' own motions are known."""
        return self.reference is not None and not self.sensors

    @cached_property
    def calibrated(self) -> tuple[str, ...]:
        """The names of all sensors whose poses are asked for: all but the reference, which carries them."""
        return tuple(name for name in self.all_sensors if name != self.reference)

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
        return self.carriers.sensors if sensor == self.reference else self.all_sensors[sensor].frame or sensor

    @model_validator(mode="before")
    @classmethod
    def _what_follows(cls, data: Any) -> Any:
        return with_what_follows(data)

    @model_validator(mode="after")
    def _is_consistent(self) -> RigFile:
        # pydantic keeps the places of the faults of a ValidationError that is raised here.
        faults = [
            InitErrorDetails(type=PydanticCustomError("value_error", "{words}", {"words": words}), loc=path, input=None)
            for path, words in (
                *contradictions(self.carriers, self.all_sensors, self.targets, self.detection, self.reference),
                *odometry_contradictions(self.carriers, self.odometries, len(self.sensors), self.reference, self.given),
            )
        ]
        if faults:
            raise ValidationError.from_exception_data("rig", faults)
        return self


@dataclass(frozen=True)
class Lines:
    """Where the values of a rig file stand, for messages; rig files of equal content are equal wherever they stand.

    Attributes
    ----------
    where : str
        The file; empty for a rig that was made in Python.
    lines : mapping of key path to int
        The line of each value.
    """

    where: str = field(default="", compare=False)
    lines: Mapping[KeyPath, int] = field(default_factory=dict, compare=False)

    def place(self, *paths: KeyPath) -> str:
        """``FILE, lines N and M: a.b and a.c``, as far as known; of a value that is not written, its section's line."""
        names = " and ".join(map(dotted, paths))
        numbers = list(dict.fromkeys(filter(None, map(self._line, paths))))
        if not self.where or not numbers:
            return names
        return f"{self.where}, line{'s' * (len(numbers) > 1)} {' and '.join(map(str, numbers))}: {names}"

    def _line(self, path: KeyPath) -> int | None:
        while path and path not in self.lines:
            path = path[:-1]
        return self.lines.get(path)


class Rig(RigFile):
    """A rig file that was read: its content, the folder that its relative paths start from, and its lines."""

    folder: Path = Path()
    source: Lines = Lines()
