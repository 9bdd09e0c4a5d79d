"""The sections of a rig file that describe targets, one class for each type of target."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, TypeAlias

from pydantic import Field

from gtsam_rwhec.cameras.targets import (
    FAMILIES,
    AprilGrid,
    Bundle,
    BundleTag,
    Charuco,
    Checkerboard,
    CircleGrid,
    Tag,
    TagGrid,
    Target,
)
from gtsam_rwhec.rig.field_types import InSchema, Length, Positive, list_of
from gtsam_rwhec.rig.section import Section

#: How many there are across and down, as the board is printed upright.
Counts: TypeAlias = Annotated[tuple[int, int], list_of(2, "two whole numbers, [across, down]")]
#: The dictionary of a tag.
Family: TypeAlias = Annotated[str, InSchema(enum=list(FAMILIES))]


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
    family: Family = Field(description="dictionary of the tags", examples=["tag36h11"])
    id: int = Field(description="the number of the tag", examples=[0])
    size_m: Length = Field(description="side of the black square", examples=[0.12])


class CharucoTarget(_TargetSection):
    """A ChArUco board, counted by squares."""

    made: ClassVar = Charuco
    counted: ClassVar = "squares"
    type: Literal["charuco"]
    family: Family = Field(description="dictionary of the markers", examples=["aruco_5x5_100"])
    squares: Counts = Field(description="[across, down], whole squares, black and white", examples=[[7, 5]])
    square_m: Length = Field(description="side of a square", examples=[0.04])
    marker_m: Length = Field(description="side of a marker's black square", examples=[0.03])
    first_id: int = Field(default=0, description="the smallest number; the others follow it", examples=[0])


class AprilGridTarget(_TargetSection):
    """Kalibr's AprilGrid, counted by tags."""

    made: ClassVar = AprilGrid
    counted: ClassVar = "tags"
    type: Literal["aprilgrid"]
    family: Family = Field(description="dictionary of the tags, most often tag36h11", examples=["tag36h11"])
    tags: Counts = Field(description="[across, down], tags", examples=[[6, 6]])
    tag_m: Length = Field(description="side of a tag's black square (Kalibr's tagSize)", examples=[0.088])
    spacing: Positive = Field(description="gap between tags / side of a tag (Kalibr's tagSpacing)", examples=[0.3])
    first_id: int = Field(default=0, description="the smallest number; the others follow it", examples=[0])


class TagGridTarget(_TargetSection):
    """OpenCV's GridBoard, counted by tags."""

    made: ClassVar = TagGrid
    counted: ClassVar = "tags"
    type: Literal["tag_grid"]
    family: Family = Field(description="dictionary of the tags", examples=["aruco_5x5_100"])
    tags: Counts = Field(description="[across, down], tags", examples=[[5, 7]])
    tag_m: Length = Field(description="side of a tag's black square", examples=[0.04])
    gap_m: Length = Field(description="white gap between two tags", examples=[0.01])
    first_id: int = Field(default=0, description="at the top left; then to the right, then down", examples=[0])
    ids: Annotated[tuple[int, ...], Field(max_length=10_000)] | None = Field(
        default=None,
        description="of all tags, left to right, from the top, in place of first_id",
        examples=[[7, 3, 9, 4]],
    )

    def target(self, name: str) -> Target:
        """The target with this name."""
        columns, rows = self.tags
        sizes = {"tag_m": self.tag_m, "gap_m": self.gap_m}
        return TagGrid(name, self.family, columns, rows, **sizes, first_id=self.first_id, ids=self.ids or ())


class BundleTagPlace(Section):
    """A tag of a bundle, as apriltag_ros writes it."""

    id: int = Field(description="the number of the tag", examples=[0])
    size: Length = Field(description="side of the black square", examples=[0.05], json_schema_extra={"unit": "m"})
    x: float = Field(default=0.0, description="the tag's middle in the bundle's frame, metres", examples=[0.035])
    y: float = Field(default=0.0, description="as x", examples=[0.0])
    z: float = Field(default=0.0, description="as x", examples=[0.0])
    qw: float = Field(default=1.0, description="quaternion of the tag's axes in the bundle's frame", examples=[0.7071])
    qx: float = Field(default=0.0, description="as qw", examples=[0.0])
    qy: float = Field(default=0.0, description="as qw", examples=[0.7071])
    qz: float = Field(default=0.0, description="as qw", examples=[0.0])


class BundleTarget(_TargetSection):
    """apriltag_ros's bundle of tags at known places."""

    made: ClassVar = Bundle
    type: Literal["bundle"]
    family: Family = Field(description="dictionary of the tags", examples=["tag36h11"])
    layout: Annotated[tuple[BundleTagPlace, ...], Field(max_length=10_000)] = Field(
        description="the tags, each with size and pose, as in apriltag_ros's tags.yaml",
        examples=[[{"id": 0, "size": 0.05, "z": 0.035}]],
    )

    def target(self, name: str) -> Target:
        """The target with this name."""
        tags = (BundleTag(t.id, t.size, (t.x, t.y, t.z), (t.qw, t.qx, t.qy, t.qz)) for t in self.layout)
        return Bundle(name, self.family, tuple(tags))


class CheckerboardTarget(_TargetSection):
    """A checkerboard, counted by inner corners."""

    made: ClassVar = Checkerboard
    counted: ClassVar = "inner_corners"
    type: Literal["checkerboard"]
    inner_corners: Counts = Field(
        description="[across, down], corners where four squares meet: one less than squares", examples=[[9, 6]]
    )
    square_m: Length = Field(description="side of a square", examples=[0.04])


class CircleGridTarget(_TargetSection):
    """A grid of circles, counted by circles."""

    made: ClassVar = CircleGrid
    counted: ClassVar = "circles"
    type: Literal["circle_grid"]
    circles: Counts = Field(
        description="[across, down], circles in a row and rows (OpenCV's patternSize; Kalibr's targetCols, targetRows)",
        examples=[[10, 10]],
    )
    spacing_m: Length = Field(
        description="between the centres of neighbours; in an asymmetric grid between two rows, which is half the "
        "distance between neighbours in a row (OpenCV's square size, Kalibr's spacingMeters)",
        examples=[0.0254],
    )
    larger_dot: bool | Literal["lower_left", "lower_right", "upper_left", "upper_right"] = Field(
        default=False,
        description="whether one circle at a corner is larger, and at which as printed; true: lower_left",
        examples=[True],
    )
    asymmetric: bool = Field(
        default=False,
        description="every other row is shifted to the right by spacing_m, the first is not (Kalibr's asymmetricGrid)",
        examples=[True],
    )


TargetSection: TypeAlias = Annotated[
    TagTarget | CharucoTarget | AprilGridTarget | TagGridTarget | BundleTarget | CheckerboardTarget | CircleGridTarget,
    Field(discriminator="type"),
]
