"""Poses in JSON, YAML and OpenCV's XML: one, a list, or a mapping by name, in the words of ROS and of many tools.

A pose is a 4 x 4 matrix (nested, flat, or OpenCV's rows, cols and data), or a position (x, y, z) with a rotation (qx,
qy, qz, qw; a quaternion as a mapping or a list; a 3 x 3 matrix; three angles). What stands around it gives its name: an
image, a stamp, or its key. Rotations and positions may be apart, as OpenCV's users write them: R_gripper2base_0 and
t_gripper2base_0, or lists of the same length. Poses of a target that stand beside them are passed over.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from gtsam_rwhec.errors import FileFormatError, LogError
from gtsam_rwhec.files.yaml_lines import KeyPath, YamlFile, parse_storage
from gtsam_rwhec.logs.pose_tables import Kind, PoseRow

#: Files of trees.
TREES = (".json", ".yaml", ".yml", ".xml", ".samples")
_POSITION = ("position", "translation", "t", "tvec", "xyz", "pos", "trans", "translationvector")
_ROTATION = (
    "orientation", "rotation", "quaternion", "q", "quat", "r", "rot", "rotationmatrix", "rotmat", "rvec", "rotvec",
    "rotationvector", "rpy", "euler",
)  # fmt: skip
#: Their three numbers are a rotation vector, and not angles about axes.
_VECTORS = ("rvec", "rotvec", "rotationvector")
#: Six or seven numbers under these keys are a position with a rotation; elsewhere they may be joints.
_LISTED = re.compile(r"^(?!.*joint).*(pose|tcp|flange|tool|gripper|effector|hand|transform|base|eef)", re.IGNORECASE)
_NAME = (
    "image", "imagepath", "imagefile", "imagename", "filepath", "file", "filename", "img", "timestamp", "stamp", "time",
    "name",
)  # fmt: skip
#: These keys hold poses, and are no names of images.
_HOLDERS = frozenset({
    "data", "poses", "pose", "frames", "transform", "transforms", "matrix", "samples", "robot", "tf", "entries",
    "images",
})  # fmt: skip
#: At most this many keys, values and items of a file of poses: some seconds' work. A pose has ten to sixty.
MOST_VALUES = 200_000
_LAST_ROW = (0.0, 0.0, 0.0, 1.0)
#: How many numbers a position has with a rotation in a list, and what the rotation is.
_OF_LISTS: tuple[tuple[int, Kind], ...] = ((7, "quaternion_of_any_order"), (6, "angles"))
#: The numbers of a rotation by these keys.
_NAMED_ROTATIONS: tuple[tuple[tuple[str, ...], Kind], ...] = (
    (("qx", "qy", "qz", "qw"), "quaternion"), (("x", "y", "z", "w"), "quaternion"),
    (("rx", "ry", "rz"), "angles"), (("roll", "pitch", "yaw"), "angles"),
)  # fmt: skip
#: Keys of rotations and of positions that belong together where the rest of both is the same.
_APART = (("R", "t"), ("r", "t"), ("rvec", "tvec"), ("rvecs", "tvecs"), ("rot", "trans"), ("R", "T"))
#: Keys of poses of a target, which are not the carriers' poses.
_OF_TARGET = re.compile(
    r"(target|board|marker|object|tag|pattern|obj)_?(2|to|in|wrt)|(camera|cam)_?marker|object_wrt_sensor|tracking$|optical$",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class PoseReference:
    """An entry that names an image and the file of its pose, as industrial_calibration's ``cal_data.yaml`` has them."""

    name: str
    place: str
    file: str


def read_pose_tree(path: str, text: str) -> list[PoseRow | PoseReference]:
    """The poses of a text in JSON, YAML or OpenCV's XML, in its order; a LogError if it is none, or has no poses."""
    file = pose_tree(path, text)
    found = list(PoseTree(file).poses(file.data, (), ""))
    if not found:
        raise LogError(
            f"{path} has no poses. A pose is a 4 x 4 matrix, or x, y, z with qx, qy, qz, qw, or position with "
            "orientation"
        )
    return found


def pose_tree(path: str, text: str) -> YamlFile:
    """The tree of a text in JSON, YAML or OpenCV's XML; a LogError if it is none."""
    try:
        return parse_storage(_one_document(text), path, MOST_VALUES)
    except FileFormatError as error:
        raise LogError(str(error)) from error


def _one_document(text: str) -> str:
    """YAML of several documents, as ``ros2 topic echo`` prints them, as a list of them; lines keep their numbers."""
    if len(re.findall(r"^---[ \t]*$", text, flags=re.MULTILINE)) < 2 or text.startswith("%"):
        return text
    lines, begins = [], True
    for line in text.split("\n"):
        if line.rstrip() in ("---", "..."):
            begins = True
            lines.append("")
        elif not line.strip() or line.startswith("#"):
            lines.append(line)
        else:
            lines.append(("- " if begins else "  ") + line)
            begins = False
    return "\n".join(lines)


@dataclass(frozen=True)
class PoseTree:
    """One file, walked from its root."""

    file: YamlFile

    def poses(self, node: Any, path: KeyPath, name: str) -> Iterator[PoseRow | PoseReference]:
        """The poses in a value; `name` is what stands around it. Those of a target are passed over."""
        fields = _fields(node)
        name = _name(fields) or name
        if isinstance(fields.get("pose"), str) and isinstance(fields.get("image"), str):
            yield PoseReference(fields["image"], self.file.place(path), fields["pose"])
            return
        row = self.pose(node, path, name)
        if row is not None:
            yield row
        elif isinstance(node, dict):
            apart = {rotation: self.apart(path, rotation, position) for rotation, position in pairs_of_keys(node)}
            used = {key for pair in pairs_of_keys(node) if apart[pair[0]] for key in pair}
            for key, value in node.items():
                if _OF_TARGET.search(key):
                    continue
                yield from apart.get(key, [])
                if key not in used and isinstance(value, (dict, tuple)):
                    under = name if key.lower() in _HOLDERS else name or key
                    yield from self.poses(value, (*path, key), under)
        elif isinstance(node, tuple):
            for i, value in enumerate(node):
                if isinstance(value, (dict, tuple)):
                    yield from self.poses(value, (*path, i), name if len(node) == 1 else "")

    def apart(self, path: KeyPath, rotation: str, position: str) -> list[PoseRow]:
        """The poses of rotations and positions that have keys of their own; empty if they are none."""
        of = self.file.data
        for key in path:
            of = of[key]
        turned, moved = of[rotation], of[position]
        number = re.search(r"\d+$", rotation)
        one = _joined(turned, moved)
        if one is not None:
            return [PoseRow(number[0] if number else "", self.file.place((*path, rotation)), *one)]
        turned, moved = _items(turned), _items(moved)
        rows = [
            PoseRow("", self.file.place((*path, rotation, i)), *joined)
            for i, pair in enumerate(zip(turned, moved, strict=False))
            if (joined := _joined(*pair)) is not None
        ]
        if rows and not len(rows) == len(turned) == len(moved):
            raise LogError(
                f"{self.file.place((*path, rotation))}: {len(turned)} rotations and {len(moved)} positions in "
                f"{position}, of which {len(rows)} are poses; give one of each"
            )
        return rows

    def pose(self, node: Any, path: KeyPath, name: str = "") -> PoseRow | None:
        """The pose that a value is, or None."""
        fields = _fields(node)
        place = self.file.place(path) if path else self.file.where
        if matrix := _matrix(node):
            return PoseRow(name, place, "matrix", matrix)
        key = next((part for part in reversed(path) if isinstance(part, str)), "pose")
        for count, kind in _OF_LISTS:
            if isinstance(node, tuple) and _LISTED.search(key) and (numbers := _flat(node, count)) is not None:
                return PoseRow(name, place, kind, numbers)
        position = _three(next((fields[key] for key in _POSITION if key in fields), node))
        if position is None:
            return None
        turned = next((fields[key] for key in _ROTATION if key in fields), node)
        by_name = _fields(turned)
        for keys, kind in _NAMED_ROTATIONS:
            if all(_is_number(by_name.get(key)) for key in keys):
                numbers = (*position, *(float(by_name[key]) for key in keys))
                return PoseRow(name, place, kind, numbers, kind == "angles")
        joined = _joined(turned, position) if turned is not node else None
        if joined is not None and joined[0] == "rotation_vector" and not any(key in fields for key in _VECTORS):
            joined = "angles", joined[1]
        return None if joined is None else PoseRow(name, place, *joined)


def pairs_of_keys(node: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """The keys of rotations and positions that belong together, as ``R_gripper2base`` and ``t_gripper2base``."""
    for key in node:
        for rotation, position in _APART:
            rest = key.removeprefix(rotation)
            if key.startswith(rotation) and (not rest or rest[0] in "_0123456789") and position + rest in node:
                yield key, position + rest
                break


def _joined(turned: Any, moved: Any) -> tuple[Kind, tuple[float, ...]] | None:
    """The kind and numbers of a pose of a rotation (a matrix, a quaternion or a vector) and a position."""
    position = _flat(moved, 3)
    if position is None:
        return None
    if (numbers := _flat(turned, 9)) is not None:
        rows = [(*numbers[3 * r : 3 * r + 3], position[r]) for r in range(3)]
        return "matrix", (*sum(rows, ()), *_LAST_ROW)
    kinds: tuple[tuple[int, Kind], ...] = ((4, "quaternion_of_any_order"), (3, "rotation_vector"))
    found = ((kind, numbers) for count, kind in kinds if (numbers := _flat(turned, count)) is not None)
    return next(((kind, (*position, *numbers)) for kind, numbers in found), None)


def _items(node: Any) -> tuple[Any, ...]:
    """The items of a list, or the slices of OpenCV's matrix by its first dimension."""
    if isinstance(node, dict) and isinstance(node.get("data"), tuple):
        sizes = node.get("sizes", (node.get("rows"), node.get("cols")))
        data, count = node["data"], sizes[0] if isinstance(sizes, tuple) and sizes else 0
        if not isinstance(count, int) or count < 1 or len(data) % count:
            return ()
        each = len(data) // count
        return tuple(data[i : i + each] for i in range(0, len(data), each)) if each else ()
    return node if isinstance(node, tuple) else ()


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
