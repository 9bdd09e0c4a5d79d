"""The sections of a rig file that describe targets, one class for each type of target."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, TypeAlias

from pydantic import Field

from gtsam_rwhec.rig.field_types import Length, Positive
from gtsam_rwhec.rig.sections import Section
from gtsam_rwhec.vision.targets import AprilGrid, Charuco, Checkerboard, Tag, Target


class _TargetSection(Section):
    """A section whose keys, except its type, are the fields of a target."""

    made: ClassVar[type[Target]]

    def target(self, name: str) -> Target:
        """The target with this name."""
        return self.made(name=name, **self.model_dump(exclude={"type"}))


class TagTarget(_TargetSection):
    """A single tag."""

    made: ClassVar = Tag
    type: Literal["tag"]
    family: str = Field(description="such as tag36h11")
    id: int = Field(description="the number of the tag")
    size_m: Length = Field(description="side of the black square, metres")


class CharucoTarget(_TargetSection):
    """A ChArUco board of columns x rows squares."""

    made: ClassVar = Charuco
    type: Literal["charuco"]
    family: str = Field(description="such as aruco_5x5_100")
    columns: int = Field(description="squares across")
    rows: int = Field(description="squares down")
    square_m: Length = Field(description="side of a square, metres")
    marker_m: Length = Field(description="side of a marker, metres")
    first_id: int = 0


class AprilGridTarget(_TargetSection):
    """Kalibr's AprilGrid."""

    made: ClassVar = AprilGrid
    type: Literal["aprilgrid"]
    family: str = Field(description="most often tag36h11")
    columns: int = Field(description="tags across")
    rows: int = Field(description="tags down")
    tag_m: Length = Field(description="side of a tag's black square, metres (Kalibr's tagSize)")
    spacing: Positive = Field(description="gap between tags / side of a tag (Kalibr's tagSpacing)")
    first_id: int = 0


class CheckerboardTarget(_TargetSection):
    """A checkerboard, counted by inner corners."""

    made: ClassVar = Checkerboard
    type: Literal["checkerboard"]
    columns: int = Field(description="inner corners across")
    rows: int = Field(description="inner corners down")
    square_m: Length = Field(description="side of a square, metres")


TargetSection: TypeAlias = Annotated[
    TagTarget | CharucoTarget | AprilGridTarget | CheckerboardTarget, Field(discriminator="type")
]
