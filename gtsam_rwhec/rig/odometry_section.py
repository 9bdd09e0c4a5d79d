"""The sections of a sensor that knows only its own motion: LiDAR odometry, visual odometry, wheels, an INS."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, GetJsonSchemaHandler, model_validator
from pydantic_core import CoreSchema

from gtsam_rwhec.rig.field_types import FramePair, Name, Positive, Text, TimeOffset
from gtsam_rwhec.rig.section import Section, one_of


class OrEstimate:
    """In the JSON Schema: the word estimate may stand in place of a section."""

    def __get_pydantic_json_schema__(self, core: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"anyOf": [{"const": "estimate"}, handler(core)]}


def _none_for_estimate(given: Any) -> Any:
    return None if isinstance(given, str) and given == "estimate" else given


class OdometryNoiseSection(Section):
    """How the errors of an odometry grow: as a random walk, whose steps are independent of one another."""

    rotation_deg_per_sqrt_s: Positive = Field(
        description="standard deviation about each axis after one second; after t seconds it is sqrt(t) times this",
        examples=[0.05],
        json_schema_extra={"unit": "degrees/sqrt(s)"},
    )
    translation_mm_per_sqrt_s: Positive = Field(
        description="standard deviation along each axis after one second",
        examples=[4.0],
        json_schema_extra={"unit": "mm/sqrt(s)"},
    )


class OdometrySource(Section):
    """Where an odometry's poses are, in the frame in which it began, and what is known of them."""

    model_config = one_of("topic", "tf", "file")

    topic: Text | None = Field(
        default=None, description="a topic of Odometry, PoseStamped or PoseInFrame", examples=["/lidar_front/odom"]
    )
    tf: FramePair | None = Field(
        default=None, description="two frames of tf, [start, sensor]", examples=[["lidar_odom", "lidar_link"]]
    )
    file: Text | None = Field(
        default=None,
        description="a file of poses (TUM: t x y z qx qy qz qw; CSV), in the folder that is given as the log, or "
        "beside the rig file",
        examples=["lidar_front.tum"],
    )
    scale: Literal["known", "estimate"] = Field(
        default="known",
        description="known: lengths are metres. estimate: they are metres times one unknown factor, as those of visual "
        "odometry with one camera",
        examples=["estimate"],
    )
    noise: Annotated[OdometryNoiseSection | None, BeforeValidator(_none_for_estimate), OrEstimate()] = Field(
        default=None,
        description="how its errors grow; without it, or with the word estimate, from the data",
        examples=[{"rotation_deg_per_sqrt_s": 0.05, "translation_mm_per_sqrt_s": 4.0}],
    )
    max_gap_s: Positive = Field(
        default=0.5,
        description="poses further apart in time than this are of two pieces: no motion is taken over the gap",
        examples=[0.2],
    )
    max_turn_deg_s: Positive = Field(
        default=345.0,
        description="a step between two poses that turns faster is lost tracking (the DQ paper's 11.5 degrees a frame, "
        "at 30 frames a second)",
        examples=[120.0],
    )
    max_speed_m_s: Positive = Field(
        default=70.0,
        description="a step between two poses that is faster is lost tracking, in the odometry's own lengths; the DQ "
        "paper has 0.1 m a frame, for sensors that are carried",
        examples=[3.0],
    )

    @model_validator(mode="after")
    def _is_one(self) -> OdometrySource:
        given = self._given("topic", "tf", "file")
        if len(given) != 1:
            raise ValueError(
                f"{' and '.join(given) or 'nothing'} given; give one of topic (of Odometry or PoseStamped), "
                "tf: [start, sensor] and file (TUM)"
            )
        return self

    @property
    def place(self) -> str:
        """Where the poses are, for messages."""
        if self.tf is not None:
            return f"tf {self.tf[0]} to {self.tf[1]}"
        return f"topic {self.topic}" if self.topic is not None else f"file {self.file}"


class OdometrySensor(Section):
    """A sensor that knows only its own motion, as a LiDAR, a camera with visual odometry, wheels, an INS."""

    odometry: OdometrySource = Field(
        description="{topic: ...}, {tf: [start, sensor]} or {file: ...}, and what is known of these poses",
        examples=[{"topic": "/lidar_front/odom"}],
    )
    time_offset: TimeOffset = Field(
        default=0.0,
        description="the sensor's stamp t is t + offset of the carriers, or of the reference; or the word estimate",
        examples=["estimate"],
        json_schema_extra={"unit": "s"},
    )
    frame: Name | None = Field(
        default=None,
        description="its frame in the results; without it the sensor's name",
        examples=["lidar_front_link"],
    )
