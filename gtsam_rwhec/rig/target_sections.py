"""The sections of a rig file that describe targets, one class for each type of target."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NoReturn, TypeAlias, get_args

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
from gtsam_rwhec.errors import FileFormatError, RigError
from gtsam_rwhec.files.yaml_lines import YamlFile, read_yaml, shown
from gtsam_rwhec.rig.section_types import InSchema, Length, Positive, Section, list_of, needed, optional

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
        given = self.model_dump(exclude={"type", self.counted}, exclude_none=True)
        if self.counted:
            given["columns"], given["rows"] = getattr(self, self.counted)
        return self.made(name=name, **given)


class TagTarget(_TargetSection):
    """A single tag."""

    made: ClassVar = Tag
    type: Literal["tag"]
    family: Family = needed("dictionary of the tags", "tag36h11")
    id: int = needed("the number of the tag", 0)
    size_m: Length = needed("side of the black square", 0.12)


class CharucoTarget(_TargetSection):
    """A ChArUco board, counted by squares."""

    made: ClassVar = Charuco
    counted: ClassVar = "squares"
    type: Literal["charuco"]
    family: Family = needed("dictionary of the markers", "aruco_5x5_100")
    squares: Counts = needed("[across, down], whole squares, black and white", [7, 5])
    square_m: Length = needed("side of a square", 0.04)
    marker_m: Length = needed("side of a marker's black square", 0.03)
    first_id: int = optional("the smallest number; the others follow it", 0, default=0)


class AprilGridTarget(_TargetSection):
    """Kalibr's AprilGrid, counted by tags."""

    made: ClassVar = AprilGrid
    counted: ClassVar = "tags"
    type: Literal["aprilgrid"]
    family: Family = needed("dictionary of the tags, most often tag36h11", "tag36h11")
    tags: Counts = needed("[across, down], tags", [6, 6])
    tag_m: Length = needed("side of a tag's black square (Kalibr's tagSize)", 0.088)
    spacing: Positive = needed("gap between tags / side of a tag (Kalibr's tagSpacing)", 0.3)
    first_id: int = optional("the smallest number; the others follow it", 0, default=0)


class TagGridTarget(_TargetSection):
    """OpenCV's GridBoard, counted by tags."""

    made: ClassVar = TagGrid
    counted: ClassVar = "tags"
    type: Literal["tag_grid"]
    family: Family = needed("dictionary of the tags", "aruco_5x5_100")
    tags: Counts = needed("[across, down], tags", [5, 7])
    tag_m: Length = needed("side of a tag's black square", 0.04)
    gap_m: Length = needed("white gap between two tags", 0.01)
    first_id: int = optional("at the top left; then to the right, then down", 0, default=0)
    ids: Annotated[tuple[int, ...], Field(max_length=10_000)] | None = optional(
        "of all tags, left to right, from the top, in place of first_id", [7, 3, 9, 4]
    )


class BundleTagPlace(Section):
    """A tag of a bundle, as apriltag_ros writes it."""

    id: int = needed("the number of the tag", 0)
    size: Length = needed("side of the black square", 0.05, unit="m")
    x: float = optional("the tag's middle in the bundle's frame, metres", 0.035, default=0.0)
    y: float = optional("as x", 0.0, default=0.0)
    z: float = optional("as x", 0.0, default=0.0)
    qw: float = optional("quaternion of the tag's axes in the bundle's frame", 0.7071, default=1.0)
    qx: float = optional("as qw", 0.0, default=0.0)
    qy: float = optional("as qw", 0.7071, default=0.0)
    qz: float = optional("as qw", 0.0, default=0.0)


class BundleTarget(_TargetSection):
    """apriltag_ros's bundle of tags at known places."""

    made: ClassVar = Bundle
    type: Literal["bundle"]
    family: Family = needed("dictionary of the tags", "tag36h11")
    layout: Annotated[tuple[BundleTagPlace, ...], Field(max_length=10_000)] = needed(
        "the tags, each with size and pose, as in apriltag_ros's tags.yaml", [{"id": 0, "size": 0.05, "z": 0.035}]
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
    inner_corners: Counts = needed("[across, down], corners where four squares meet: one less than squares", [9, 6])
    square_m: Length = needed("side of a square", 0.04)


class CircleGridTarget(_TargetSection):
    """A grid of circles, counted by circles."""

    made: ClassVar = CircleGrid
    counted: ClassVar = "circles"
    type: Literal["circle_grid"]
    circles: Counts = needed(
        "[across, down], circles in a row and rows (OpenCV's patternSize; Kalibr's targetCols, targetRows)", [10, 10]
    )
    spacing_m: Length = needed(
        "between the centres of neighbours; in an asymmetric grid between two rows, which is half the distance "
        "between neighbours in a row (OpenCV's square size, Kalibr's spacingMeters)",
        0.0254,
    )
    larger_dot: bool | Literal["lower_left", "lower_right", "upper_left", "upper_right"] = optional(
        "whether one circle at a corner is larger, and at which as printed; true: lower_left", True, default=False
    )
    asymmetric: bool = optional(
        "every other row is shifted to the right by spacing_m, the first is not (Kalibr's asymmetricGrid)",
        True,
        default=False,
    )


class ObjectTarget(Section):
    """Anything that stands there, in front of a 3D camera or a LiDAR: its clouds are registered with each other."""

    type: Literal["object"]


PrintedTarget: TypeAlias = (
    TagTarget | CharucoTarget | AprilGridTarget | TagGridTarget | BundleTarget | CheckerboardTarget | CircleGridTarget
)
TargetSection: TypeAlias = Annotated[PrintedTarget | ObjectTarget, Field(discriminator="type")]


#: The section of each type of target.
KINDS: dict[str, type[Section]] = {
    get_args(section.model_fields["type"].annotation)[0]: section for section in get_args(get_args(TargetSection)[0])
}

#: Kalibr detects this family on its AprilGrids.
FAMILY = "tag36h11"
#: Kalibr's keys of each type.
_KEYS = {
    "aprilgrid": ("tagCols", "tagRows", "tagSize", "tagSpacing"),
    "checkerboard": ("targetCols", "targetRows", "rowSpacingMeters", "colSpacingMeters"),
    "circlegrid": ("targetCols", "targetRows", "spacingMeters"),
}


def with_kalibr_targets(file: YamlFile, folder: Path) -> YamlFile:
    """The rig file with the sections that Kalibr's files stand for; their paths start from the rig file's folder.

    A RigError says that a file cannot be read, or is no target that is detected, with the lines of both files.
    """
    data = file.data
    targets = data.get("targets") if isinstance(data, dict) else None
    if not isinstance(targets, dict):
        return file
    named = {name: each for name, each in targets.items() if isinstance(each, dict) and "kalibr" in each}
    if not named:
        return file
    sections = {}
    for name, each in named.items():
        place = file.place(("targets", name, "kalibr"))
        if set(each) != {"kalibr"} or not isinstance(each["kalibr"], str):
            raise RigError(f"{place}: give the path of Kalibr's file, and no other key: {{kalibr: april.yaml}}")
        try:
            sections[name] = _section(read_yaml(folder / each["kalibr"]))
        except FileFormatError as error:
            raise RigError(f"{place}: {error}") from error
    return replace(file, data={**data, "targets": {**targets, **sections}})


def _section(file: YamlFile) -> dict[str, Any]:
    """The section of a target for Kalibr's file."""
    given = file.data if isinstance(file.data, dict) else {}
    kind = given.get("target_type")
    if not isinstance(kind, str) or kind not in _KEYS:
        _refuse(file, "target_type", f"{shown(kind)}; Kalibr's targets are {', '.join(_KEYS)}")
    for key in _KEYS[kind]:
        value = given.get(key)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            _refuse(file, key, "is missing" if key not in given else f"{shown(value)}; a number was expected")
    columns, rows, length = (given[key] for key in _KEYS[kind][:3])
    if kind == "aprilgrid":
        spacing = float(given["tagSpacing"])
        return {
            "type": "aprilgrid", "family": FAMILY, "tags": (columns, rows), "tag_m": float(length), "spacing": spacing,
        }  # fmt: skip
    if kind == "checkerboard":
        if given["colSpacingMeters"] != length:
            _refuse(file, "colSpacingMeters", "squares that are no squares are not detected")
        return {"type": "checkerboard", "inner_corners": (columns, rows), "square_m": float(length)}
    shifted = given.get("asymmetricGrid", False)
    if not isinstance(shifted, bool):
        _refuse(file, "asymmetricGrid", f"{shown(shifted)}; give True or False")
    section = {"type": "circle_grid", "circles": (columns, rows), "spacing_m": float(length)}
    return {**section, "asymmetric": True} if shifted else section


def _refuse(file: YamlFile, key: str, words: str) -> NoReturn:
    raise FileFormatError(file.fault((key,), words))
