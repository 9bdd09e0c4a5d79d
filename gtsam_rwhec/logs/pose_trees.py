"""Poses in JSON and YAML: one pose, a list of them, or a mapping by name, in the words of ROS and of many tools.

A pose is a 4 x 4 matrix (nested, flat, or OpenCV's rows, cols and data), or a position (x, y, z) with a rotation (qx,
qy, qz, qw; a quaternion as a mapping or a list; a 3 x 3 matrix; three angles). What stands around it gives its name: an
image, a stamp, or its key.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from gtsam_rwhec.errors import FileFormatError, LogError
from gtsam_rwhec.files.yaml_lines import OPENCV_MATRIX, YamlFile, parse_yaml
from gtsam_rwhec.logs.pose_rows import PoseRow

_POSITION = ("position", "translation", "t", "tvec", "xyz", "pos", "trans")
_ROTATION = ("orientation", "rotation", "quaternion", "q", "quat", "r", "rot", "rvec", "rpy", "euler")
_NAME = (
    "image",
    "imagepath",
    "imagefile",
    "imagename",
    "filepath",
    "file",
    "filename",
    "img",
    "timestamp",
    "stamp",
    "time",
    "name",
)
#: These keys hold poses, and are no names of images.
_HOLDERS = frozenset({
    "data", "poses", "pose", "frames", "transform", "transforms", "matrix", "samples", "robot", "tf", "entries",
    "images",
})  # fmt: skip
_LAST_ROW = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class PoseReference:
    """An entry that names an image and the file of its pose, as industrial_calibration's ``cal_data.yaml`` has them."""

    name: str
    place: str
    file: str


def read_pose_tree(path: str, text: str) -> list[PoseRow | PoseReference]:
    """The poses of a text in JSON or YAML, in its order; a LogError if it is neither, or has no poses."""
    text = re.sub(r"\A%YAML:", "%YAML ", text)
    if path.lower().endswith(".json"):
        text = text.replace("\t", " ")
    try:
        file = parse_yaml(text, path, tags=(OPENCV_MATRIX,))
    except FileFormatError as error:
        raise LogError(str(error)) from error
    found = list(_Tree(file).poses(file.data, (), ""))
    if not found:
        raise LogError(
            f"{path} has no poses. A pose is a 4 x 4 matrix, or x, y, z with qx, qy, qz, qw, or position with "
            "orientation"
        )
    return found


@dataclass(frozen=True)
class _Tree:
    """One file, walked from its root."""

    file: YamlFile

    def poses(self, node: Any, path: tuple[str | int, ...], name: str) -> Iterator[PoseRow | PoseReference]:
        """The poses in a value; `name` is what stands around it."""
        fields = _fields(node)
        name = _name(fields) or name
        if isinstance(fields.get("pose"), str) and isinstance(fields.get("image"), str):
            yield PoseReference(fields["image"], self.file.place(path), fields["pose"])
            return
        row = self._pose(node, fields, path, name)
        if row is not None:
            yield row
        elif isinstance(node, dict):
            for key, value in node.items():
                if isinstance(value, (dict, tuple)):
                    under = name if key.lower() in _HOLDERS else name or key
                    yield from self.poses(value, (*path, key), under)
        elif isinstance(node, tuple):
            for i, value in enumerate(node):
                if isinstance(value, (dict, tuple)):
                    yield from self.poses(value, (*path, i), name if len(node) == 1 else "")

    def _pose(self, node: Any, fields: dict[str, Any], path: tuple[str | int, ...], name: str) -> PoseRow | None:
        """The pose that a value is, or None."""
        place = self.file.place(path) if path else self.file.where
        if matrix := _matrix(node):
            return PoseRow(name, place, "matrix", matrix)
        position = _three(next((fields[key] for key in _POSITION if key in fields), node))
        if position is None:
            return None
        turned = next((fields[key] for key in _ROTATION if key in fields), node)
        by_name = _fields(turned)
        for keys in ("qx", "qy", "qz", "qw"), ("x", "y", "z", "w"):
            if all(_is_number(by_name.get(key)) for key in keys):
                return PoseRow(name, place, "quaternion", (*position, *(float(by_name[key]) for key in keys)))
        for axes in ("rx", "ry", "rz"), ("roll", "pitch", "yaw"):
            if all(_is_number(by_name.get(key)) for key in axes):
                return PoseRow(name, place, "angles", (*position, *(float(by_name[key]) for key in axes)), True)
        if (numbers := _flat(turned, 4)) is not None:
            return PoseRow(name, place, "quaternion_of_any_order", (*position, *numbers))
        if turned is not node and (numbers := _flat(turned, 3)) is not None:
            return PoseRow(name, place, "angles", (*position, *numbers))
        if (numbers := _flat(turned, 9)) is not None:
            rows = [(*numbers[3 * r : 3 * r + 3], position[r]) for r in range(3)]
            return PoseRow(name, place, "matrix", (*sum(rows, ()), *_LAST_ROW))
        return None


def _fields(node: Any) -> dict[str, Any]:
    """A mapping's values by keys in small letters without underscores; empty for other values."""
    return {key.lower().replace("_", ""): value for key, value in node.items()} if isinstance(node, dict) else {}


def _name(fields: dict[str, Any]) -> str:
    header = _fields(fields.get("header"))
    for key in _NAME:
        value = fields.get(key, header.get(key))
        of_stamp = _fields(value)
        seconds = of_stamp.get("sec", of_stamp.get("secs"))
        nanoseconds = of_stamp.get("nanosec", of_stamp.get("nsec", of_stamp.get("nsecs", 0)))
        if isinstance(seconds, int) and isinstance(nanoseconds, int):  # ROS
            return str(seconds * 10**9 + nanoseconds)
        if isinstance(value, str) or _is_number(value):
            return str(value)
    return ""


def _matrix(node: Any) -> tuple[float, ...] | None:
    """The 16 numbers of a 4 x 4 or 3 x 4 matrix, or None."""
    if isinstance(node, dict):
        if not {"rows", "cols", "data"} <= set(node):
            return None
        node = node["data"] if (node["rows"], node["cols"]) in ((4, 4), (3, 4)) else None
    numbers = _flat(node, 16)
    if numbers is None and (short := _flat(node, 12)) is not None:
        numbers = (*short, *_LAST_ROW)
    return numbers


def _three(node: Any) -> tuple[float, ...] | None:
    fields = _fields(node)
    for keys in (("x", "y", "z"), ("tx", "ty", "tz")):
        if all(_is_number(fields.get(key)) for key in keys):
            return tuple(float(fields[key]) for key in keys)
    return _flat(node, 3)


def _flat(node: Any, count: int) -> tuple[float, ...] | None:
    """So many numbers, in a list, in a list of rows, or in OpenCV's matrix; else None."""
    if isinstance(node, dict) and "data" in node:
        node = node["data"]
    if not isinstance(node, tuple):
        return None
    if node and all(isinstance(row, tuple) for row in node):
        node = tuple(number for row in node for number in row)
    if len(node) != count or not all(map(_is_number, node)):
        return None
    return tuple(map(float, node))


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
