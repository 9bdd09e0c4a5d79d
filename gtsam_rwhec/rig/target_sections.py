"""The sections of a rig file that describe targets, one class for each type of target."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, TypeAlias

from pydantic import Field

from gtsam_rwhec.rig.field_types import Length, Positive, list_of
from gtsam_rwhec.rig.sections import Section
from gtsam_rwhec.vision.targets import AprilGrid, Charuco, Checkerboard, CircleGrid, Tag, Target

#: How many there are across and down, as the board is printed upright.
Counts: TypeAlias = Annotated[tuple[int, int], list_of(2, "two whole numbers, [across, down]")]


class _TargetSection(Section):
    """A section whose keys, except its type, are the fields of a target; `counted` becomes columns and rows."""

    made: ClassVar[type[Target]]
    counted: ClassVar[str] = ""

    def target(self, name: str) -> Target:
        """The target with this name."""
        given = self.model_dump(exclude={"type", self.counted})
        if self.counted:
            given["columns"], given["rows"] = getattr(self, self.counted)
        return self.made(name=name, **given)


class TagTarget(_TargetSection):
    """A single tag."""

    made: ClassVar = Tag
    type: Literal["tag"]
    family: str = Field(description="such as tag36h11")
    id: int = Field(description="the number of the tag")
    size_m: Length = Field(description="side of the black square, metres")


class CharucoTarget(_TargetSection):
    """A ChArUco board, counted by squares."""

    made: ClassVar = Charuco
    counted: ClassVar = "squares"
    type: Literal["charuco"]
    family: str = Field(description="such as aruco_5x5_100")
    squares: Counts = Field(description="[across, down], whole squares")
    square_m: Length = Field(description="side of a square, metres")
    marker_m: Length = Field(description="side of a marker, metres")
    first_id: int = 0


class AprilGridTarget(_TargetSection):
    """Kalibr's AprilGrid, counted by tags."""

    made: ClassVar = AprilGrid
    counted: ClassVar = "tags"
    type: Literal["aprilgrid"]
    family: str = Field(description="most often tag36h11")
    tags: Counts = Field(description="[across, down]")
    tag_m: Length = Field(description="side of a tag's black square, metres (Kalibr's tagSize)")
    spacing: Positive = Field(description="gap between tags / side of a tag (Kalibr's tagSpacing)")
    first_id: int = 0


class CheckerboardTarget(_TargetSection):
    """A checkerboard, counted by inner corners."""

    made: ClassVar = Checkerboard
    counted: ClassVar = "inner_corners"
    type: Literal["checkerboard"]
    inner_corners: Counts = Field(description="[across, down], corners where four squares meet")
    square_m: Length = Field(description="side of a square, metres")


class CircleGridTarget(_TargetSection):
    """A grid of circles, counted by circles."""

    made: ClassVar = CircleGrid
    counted: ClassVar = "circles"
    type: Literal["circle_grid"]
    circles: Counts = Field(description="[across, down]")
    spacing_m: Length = Field(description="between the centres of neighbours, metres")
    larger_dot: bool | Literal["lower_left", "lower_right", "upper_left", "upper_right"] = False


TargetSection: TypeAlias = Annotated[
    TagTarget | CharucoTarget | AprilGridTarget | CheckerboardTarget | CircleGridTarget, Field(discriminator="type")
]
