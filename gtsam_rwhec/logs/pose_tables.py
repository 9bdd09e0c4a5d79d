"""Tables of poses in text: CSV, TUM, KITTI, one 4 x 4 matrix or many, with names of columns or without.

Fields are parted by commas, semicolons or blanks. A line of column names, if there is one, says what each column is,
and may have units, ``x [mm]``. Without it, a line is

- 7 numbers (a position, then a quaternion), 8 fields (a name or a stamp first: TUM), or 6 and 7 with three angles;
- 12 or 16 numbers of a matrix, row by row (KITTI), or 13 and 17 fields with a name first;
- 4 numbers: four lines, or three, are a matrix.

First the poses as files give them, before they are transforms: names, places, and numbers of a known or stated kind.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from rwhec_factors.se3 import pose
from scipy.spatial.transform import Rotation

from gtsam_rwhec.errors import FileFormatError, LogError
from gtsam_rwhec.files.budgets import POSES_TEXT
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.files.whole_files import read_whole
from gtsam_rwhec.logs.records import LARGEST_M, Array, transforms

#: What a pose's numbers are: 16 of a matrix, row by row; a position and a quaternion (x, y, z, w or in an order that
#: the file does not say); a position and three angles, or OpenCV's rotation vector.
Kind = Literal["matrix", "quaternion", "quaternion_of_any_order", "angles", "rotation_vector"]
#: A rotation matrix R may differ from a rotation by this much in R'R.
ROTATION_TOLERANCE = 1e-3
#: Angles beyond a turn are degrees.
FULL_TURN = 2.0 * np.pi + 1e-6
#: Arms, tables and rooms are smaller, in metres, than this.
WORKSPACE_M = 50.0


@dataclass(frozen=True)
class PoseRow:
    """One pose as its file has it."""

    name: str  #: An image's name or a stamp; empty where the file has neither
    place: str  #: The file, and its line where it has several poses
    kind: Kind
    #: 16 of a matrix; 3 of a position, then 4 or 3 of the rotation. Angles are about x, y and z if `is_named`.
    numbers: tuple[float, ...]
    is_named: bool = False  #: Whether the file names the angles' axes
    unit_m: float | None = None  #: The position's unit in metres; None if the file does not say it


@dataclass(frozen=True)
class PoseStatement:
    """How the numbers of a file of poses are meant, where the file does not say it; None is not stated."""

    #: ``"xyzw"`` or ``"wxyz"``; a file that names no columns has x, y, z, w unless stated
    quaternion: Literal["xyzw", "wxyz"] | None = None
    #: Axes as SciPy has them (``"ZYX"`` about turning axes, ``"xyz"`` about fixed ones), or ``"rotation_vector"``
    euler: str | None = None
    angles: Literal["degrees", "radians"] | None = None
    length: Literal["m", "mm"] | None = None
    #: Names of a line's numbers, as ``"qw qx qy qz tx ty tz"``, in tables without names of columns
    columns: str | None = None


@dataclass(frozen=True, eq=False)
class NamedPoses:
    """Poses (N, 4, 4) in metres, with their names and places as in `PoseRow`."""

    names: tuple[str, ...]
    places: tuple[str, ...]
    T: Array


def poses_of(rows: Sequence[PoseRow], stated: PoseStatement) -> NamedPoses:
    """The transforms of rows.

    Raises `LogError` if a row is no pose, has angles without a stated convention or unit, or positions look like
    millimetres. The message has the place, and what to write.
    """
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    for kind, made in (
        ("matrix", _of_matrices), ("quaternion", _of_quaternions), ("quaternion_of_any_order", _of_quaternions),
        ("angles", _of_angles), ("rotation_vector", _of_rotation_vectors),
    ):  # fmt: skip
        at = [i for i, row in enumerate(rows) if row.kind == kind]
        if at:
            T[at] = made([rows[i] for i in at], stated)
    units = np.array([row.unit_m or (1e-3 if stated.length == "mm" else 1.0) for row in rows])
    T[:, :3, 3] *= units[:, None]
    if stated.length is None and any(row.unit_m is None for row in rows):
        _check_workspace(T, rows)
    return NamedPoses(tuple(row.name for row in rows), tuple(row.place for row in rows), T)


def _of_matrices(rows: list[PoseRow], _: PoseStatement) -> Array:
    T = np.array([row.numbers for row in rows]).reshape(-1, 4, 4)
    with np.errstate(over="ignore", invalid="ignore"):
        R = T[:, :3, :3]
        off = np.abs(R.swapaxes(1, 2) @ R - np.eye(3)).max(axis=(1, 2))
        good = (off <= ROTATION_TOLERANCE) & (np.linalg.det(np.nan_to_num(R)) > 0.0) & np.isfinite(T).all(axis=(1, 2))
        good &= (np.abs(T[:, 3] - [0.0, 0.0, 0.0, 1.0]) < ROTATION_TOLERANCE).all(axis=1)
        good &= (np.abs(T[:, :3, 3]) <= LARGEST_M).all(axis=1)
    if not good.all():
        i = int(np.argmin(good))
        shape = " It has the position in the last row: transpose it." if (T[i, :3, 3] == 0.0).all() else ""
        raise LogError(
            f"{rows[i].place}: {T[i].tolist()} is no transform: its first three columns must be a rotation, and its "
            f"last row 0 0 0 1.{shape}"
        )
    T[:, :3, :3] = Rotation.from_matrix(R).as_matrix()  # R'R = 1 to the last digit
    T[:, 3] = [0.0, 0.0, 0.0, 1.0]
    return T


def _of_quaternions(rows: list[PoseRow], stated: PoseStatement) -> Array:
    numbers = np.array([row.numbers for row in rows])
    order = [3, 4, 5, 6]
    if rows[0].kind == "quaternion_of_any_order" and stated.quaternion == "wxyz":
        order = [4, 5, 6, 3]
    T, faults = transforms(numbers[:, :3], numbers[:, order])
    for i, fault in faults.items():
        cure = ""
        if "norm" in fault and rows[i].kind == "quaternion_of_any_order" and stated.euler is None:
            cure = (
                " If the numbers after the position are three angles, write euler: AXES (such as ZYX) and "
                "angles: degrees or radians where the rig file has the frames."
            )
        raise LogError(f"{rows[i].place}: {fault}.{cure}")
    return T


def _of_angles(rows: list[PoseRow], stated: PoseStatement) -> Array:
    if stated.euler is None:
        raise LogError(
            f"{rows[0].place}: three angles, and their convention is not stated. Write it where the rig file has the "
            "frames, {frames: [...], euler: ZYX, angles: degrees}: the axes in the order of the turns, capitals for "
            "turning axes and small letters for fixed ones, or rotation_vector"
        )
    if stated.angles is None:
        raise LogError(f"{rows[0].place}: angles without a unit. Write angles: degrees or angles: radians beside euler")
    numbers = np.array([row.numbers for row in rows])
    angles = numbers[:, 3:]
    if not np.isfinite(numbers).all():
        i = int(np.argmin(np.isfinite(numbers).all(axis=1)))
        raise LogError(f"{rows[i].place}: {list(rows[i].numbers)} is not finite")
    if stated.angles == "degrees":
        angles = np.radians(angles)
    elif (np.abs(angles) > FULL_TURN).any():
        i = int(np.argmax((np.abs(angles) > FULL_TURN).any(axis=1)))
        raise LogError(
            f"{rows[i].place}: angles {angles[i].tolist()} are more than a turn in radians. Are they degrees? "
            "Write angles: degrees"
        )
    if stated.euler == "rotation_vector":
        turned = Rotation.from_rotvec(angles)
    else:
        if rows[0].is_named:  # about x, y and z: in the order of the turns
            angles = angles[:, ["xyz".index(axis) for axis in stated.euler.lower()]]
        turned = Rotation.from_euler(stated.euler, angles)
    return pose(turned.as_matrix(), numbers[:, :3])


def _of_rotation_vectors(rows: list[PoseRow], stated: PoseStatement) -> Array:
    return _of_angles(rows, replace(stated, euler="rotation_vector", angles=stated.angles or "radians"))


def _check_workspace(T: Array, rows: Sequence[PoseRow]) -> None:
    """Refuse positions that are spread, or away from the origin, as millimetres are."""
    t = T[:, :3, 3]
    with np.errstate(over="ignore"):
        extent, away = float(np.ptp(t, axis=0).max()), float(np.abs(np.median(t, axis=0)).max())
    if len(rows) > 1 and max(extent, away) > WORKSPACE_M:
        far = int(np.argmax(np.abs(t - np.median(t, axis=0)).max(axis=1)))
        how = f"spread over {extent:.4g} m" if extent > WORKSPACE_M else f"{away:.4g} m from their origin"
        raise LogError(
            f"{rows[far].place}: position {t[far].tolist()}; the poses are {how} if these are "
            "metres. Are they millimetres? Write length: mm where the rig file has the frames, or length: m if it is "
            "true"
        )


def stem_of(name: str) -> str:
    """A name without folders and without the ending of an image or a cloud."""
    bare = re.split(r"[/\\]", name.strip().strip("\"'"))[-1]
    return re.sub(
        r"\.(png|jpe?g|webp|bmp|tiff?|ya?ml|json|xml|csv|tum|txt|pcd|ply|np[yz]|(pcd\.)?bin)$",
        "",
        bare,
        flags=re.IGNORECASE,
    )


#: A table has at most this many lines, and a line at most this many characters.
MOST_LINES, LONGEST_LINE = 500_000, 10_000
#: The last row of a transform.
_LAST = (0.0, 0.0, 0.0, 1.0)
_UNITS_M = {"m": 1.0, "mm": 1e-3, "cm": 1e-2}
#: Columns of names, the best first.
_NAMES = ("image", "image_name", "imagename", "filename", "file", "img", "frame", "name")
_STAMPS = ("timestamp", "stamp", "time", "t", "secs", "sec", "time_s", "timestamp_s", "timestamp_ns", "index", "id")

Line = tuple[int, list[str]]


def read_pose_table(path: str, text: str, *, stated: PoseStatement) -> list[PoseRow]:
    """The poses of a text; `stated` says what lines without names of columns have.

    Raises `LogError` if a line is no pose, with the line and what was expected.
    """
    header, lines = _lines(path, text)
    if not lines:
        raise LogError(f"{path} has no poses.")
    if header is None and stated.columns is not None and len(names := stated.columns.split()) == len(lines[0][1]):
        if not (columns := _columns(names)):
            _refuse_names(path, names)
        return _by_columns(path, columns, names, lines, stated)
    if header is not None and (columns := _columns(header)):
        return _by_columns(path, columns, header, lines, stated)
    if header is not None and len(header) >= 7 and all(len(fields) == len(header) for _, fields in lines):
        _refuse_names(path, header)
    counts = {len(fields) for _, fields in lines}
    if counts == {4} and not any(_number(fields[0]) is None for _, fields in lines):
        return _stacked(path, lines)
    return [_row(path, line, stated) for line in lines]


def pose_text(path: object) -> str:
    """The text of a file of poses, UTF-8; a LogError if it is too large or no text."""
    try:
        content = read_whole(str(path), POSES_TEXT, "A table of poses was")
        number_of_lines = content.count(b"\n") + content.count(b"\r")
        if number_of_lines > MOST_LINES:
            raise LogError(f"{path} has {number_of_lines} lines; at most {MOST_LINES} are read.")
        return content.decode("utf-8-sig")
    except FileFormatError as error:
        raise LogError(str(error)) from error
    except UnicodeDecodeError as error:
        raise LogError(f"{path} is not text in UTF-8 (byte {error.start}); give lines of poses.") from error


def _lines(path: str, text: str) -> tuple[list[str] | None, list[Line]]:
    """The names of columns, None without; the lines that have fields, with their numbers."""
    header: list[str] | None = None
    lines: list[Line] = []
    for number, line in enumerate(text.splitlines(), start=1):
        bare = line.strip()
        if len(bare) > LONGEST_LINE:
            raise LogError(f"{path}, line {number}: longer than {LONGEST_LINE} characters; is it a table of poses?")
        is_comment = bare.startswith(("#", "%"))
        if not bare or (is_comment and (lines or header)):
            continue
        fields = _fields(bare.lstrip("#% ") if is_comment else bare)
        if not lines and header is None and sum(_number(field) is None for field in fields) > max(1, len(fields) // 2):
            if not is_comment or _columns(fields):
                header = fields
        elif not is_comment:
            lines.append((number, fields))
    return header, lines


def _fields(line: str) -> list[str]:
    separator = next((mark for mark in (",", ";", "\t") if mark in line), None)
    line = re.sub(r"\s*[\[(]\s*([A-Za-z]*)\s*[\])]", r"_[\1]", line)  # units stay with their column
    fields = re.split(rf"\s*{separator}\s*", line) if separator else line.split()
    while fields and not fields[-1]:
        fields.pop()
    return fields


def _columns(header: Sequence[str]) -> dict[str, int]:
    """The places of tx ty tz, with qx qy qz qw, rx ry rz or m00 to m23; empty if the names do not say them."""
    found: dict[str, int] = {}
    for i, word in enumerate(header):
        found.setdefault(_role(word), i)
    if "m11" in found and "m00" not in found and "m01" not in found:  # counted from one
        found |= {
            f"m{r}{c}": found[f"m{r + 1}{c + 1}"] for r in range(3) for c in range(4) if f"m{r + 1}{c + 1}" in found
        }
    if all(f"m{r}{c}" in found for r in range(3) for c in range(4)):
        return found
    for axes in ("c", "b", "a"), ("qw", "p", "r"):  # KUKA's A, B, C and FANUC's W, P, R
        if all(axis in found for axis in axes) and not {"qx", "rx"} & set(found):
            found |= {f"r{axis}": found[name] for axis, name in zip("xyz", axes, strict=True)}
    is_whole = all(f"t{axis}" in found for axis in "xyz") and (
        all(f"q{axis}" in found for axis in "xyzw")
        or all(f"r{axis}" in found for axis in "xyz")
        or all(f"m{r}{c}" in found for r in range(3) for c in range(3))
    )
    return found if is_whole else {}


def _refuse_names(path: str, header: Sequence[str]) -> None:
    """Refuse names of columns that tell no pose: an order that is guessed would give other poses."""
    is_imu = any(re.search(r"omega|alpha|gyr|acc|w_RS", word, re.IGNORECASE) for word in header)
    what = "Are they the rates and accelerations of an IMU? These are no poses. " if is_imu else ""
    raise LogError(
        f"{path}, line 1: the names of columns {brief(', '.join(header))} tell no position with a rotation. {what}"
        "Known names: x, y, z (tx, p_x, position.x, ...) with qx, qy, qz, qw (orientation.x, q_x, ...), rx, ry, "
        "rz (roll, pitch, yaw; a, b, c), or m00 to m23. Without that line, columns go by their order"
    )


def _role(word: str) -> str:
    """The meaning of a column's name: tx, qw, rz, m01, or the name itself."""
    bare = re.sub(r"_?\[.*\]$", "", word.strip("\"' ").lower())
    bare = re.sub(r"_(mm|cm|m|deg|rad|degrees|radians)$", "", bare)
    turned = {"roll": "rx", "pitch": "ry", "yaw": "rz"}.get(re.split(r"[._/ ]", bare)[-1])
    if turned:
        return turned
    if match := re.fullmatch(r"(?:m|t|r|rot|mat)?_?([0-3])_?([0-3])", bare):
        return f"m{match[1]}{match[2]}"
    match = re.fullmatch(r"(?P<of>.*?)[._/ ]?(?P<axis>[xyzw])", bare)
    if match is None:
        return bare
    of, axis = match["of"], match["axis"]
    if re.search(r"(^|[._/ ])(q|o|quat\w*|orient\w*|rot|rotation)($|[._/ ])", of) or re.search(r"(^|[._/ ])q_", of):
        return f"q{axis}"
    if axis == "w" and not of:
        return "qw"
    if axis != "w" and re.fullmatch(r"r|rv|rotvec|euler|angle", of):
        return f"r{axis}"
    if axis != "w" and (not of or re.search(r"(^|[._/ ])(t|p|pos\w*|trans\w*|loc\w*)($|[._/ ])", of)):
        return f"t{axis}"
    return bare


def _by_columns(
    path: str, columns: dict[str, int], header: Sequence[str], lines: list[Line], stated: PoseStatement
) -> list[PoseRow]:
    named = next((columns[name] for name in _NAMES + _STAMPS if name in columns), None)
    if named is None:
        named = next((i for i, word in enumerate(header) if "stamp" in word.lower() or "time" in word.lower()), None)
    parted = None if any(name in columns for name in _NAMES) else _seconds_and_nanoseconds(header)
    keys, kind = _wanted(columns)
    if kind == "quaternion" and stated.quaternion is not None:
        by_place = "".join(sorted("xyzw", key=lambda axis: columns[f"q{axis}"]))
        if by_place != stated.quaternion:
            raise LogError(
                f"{path}, line {lines[0][0] - 1}: the columns are named {', '.join(header)}, and quaternion: "
                f"{stated.quaternion} is stated. Names count before a statement: leave quaternion out, or rename the "
                "columns if their names are wrong"
            )
    unit_m = _unit_m(header[columns["tx"]]) if "tx" in columns else None
    rows = []
    for number, fields in lines:
        if len(fields) != len(header):
            raise LogError(f"{path}, line {number}: {len(fields)} fields, and {len(header)} names of columns.")
        numbers = _numbers(path, number, [fields[columns[key]] for key in keys])
        if kind == "matrix":
            numbers = (*numbers, *_LAST)
        name = "" if named is None else fields[named].strip("\"'")
        if parted is not None and re.fullmatch(r"\d{1,10}", fields[parted[0]]) and fields[parted[1]].isdigit():
            name = str(int(fields[parted[0]]) * 10**9 + int(fields[parted[1]]))
        rows.append(PoseRow(name, f"{path}, line {number}", kind, numbers, kind == "angles", unit_m))
    return rows


def _seconds_and_nanoseconds(header: Sequence[str]) -> tuple[int, int] | None:
    """The two columns of a ROS stamp, such as ``secs`` and ``nsecs``; None if the table lacks them."""
    words = [word.strip("\"' ").lower() for word in header]
    whole = next((i for i, word in enumerate(words) if re.search(r"(^|[._ ])secs?(onds)?$", word)), None)
    part = next((i for i, word in enumerate(words) if re.search(r"(^|[._ ])n(ano)?secs?(onds)?$", word)), None)
    return None if whole is None or part is None else (whole, part)


def _wanted(columns: dict[str, int]) -> tuple[list[str], Kind]:
    position = [f"t{axis}" for axis in "xyz"]
    if all(f"q{axis}" in columns for axis in "xyzw"):
        return position + [f"q{axis}" for axis in "xyzw"], "quaternion"
    if all(f"r{axis}" in columns for axis in "xyz"):
        return position + [f"r{axis}" for axis in "xyz"], "angles"
    has_fourth = all(f"m{r}3" in columns for r in range(3))
    return [f"m{r}{c}" if c < 3 or has_fourth else position[r] for r in range(3) for c in range(4)], "matrix"


def _unit_m(word: str) -> float | None:
    match = re.search(r"[\[(_](mm|cm|m)[\])]?$", word.strip("\"' ").lower())
    return _UNITS_M[match[1]] if match else None


def _stacked(path: str, lines: list[Line]) -> list[PoseRow]:
    """Matrices of four lines each, or one of three."""
    table = [_numbers(path, number, fields) for number, fields in lines]
    if len(table) == 3:
        table.append(_LAST)
        lines = [*lines, lines[-1]]
    if len(table) % 4:
        raise LogError(f"{path}: {len(table)} lines of four numbers; a 4 x 4 matrix has four lines.")
    places = [f"{path}, line {lines[i][0]}" if len(table) > 4 else path for i in range(0, len(table), 4)]
    return [PoseRow("", place, "matrix", sum(table[4 * i : 4 * i + 4], ())) for i, place in enumerate(places)]


def _row(path: str, line: Line, stated: PoseStatement) -> PoseRow:
    number, fields = line
    kinds: dict[int, Kind] = {6: "angles"} if stated.euler is not None else {7: "quaternion_of_any_order"}
    kinds |= {12: "matrix", 16: "matrix"}
    count = len(fields)
    has_name = count not in kinds
    if count - has_name not in kinds:
        raise LogError(
            f"{path}, line {number}: {count} fields, {brief(' '.join(fields))}. Give a position and a quaternion (7 "
            "numbers), a matrix (12 or 16 numbers), or a position and three angles with euler: stated; a name or a "
            "stamp may come first."
        )
    if not has_name and count == 7 and stated.euler is None and _number(fields[0]) is None:
        raise LogError(
            f"{path}, line {number}: {brief(fields[0])} and six numbers. If they are a position and three angles, "
            "write euler: AXES (such as ZYX) and angles: degrees or radians where the rig file has the frames"
        )
    numbers = _numbers(path, number, fields[has_name:])
    if len(numbers) == 12:
        numbers = (*numbers, *_LAST)
    place = f"{path}, line {number}"
    kind = kinds[count - has_name]
    if kind == "quaternion_of_any_order" and stated.columns is not None:
        at = stated.columns.split().index
        kind, numbers = "quaternion", tuple(numbers[at(name)] for name in ("tx", "ty", "tz", "qx", "qy", "qz", "qw"))
    return PoseRow(fields[0].strip("\"'") if has_name else "", place, kind, numbers)


def _numbers(path: str, line: int, fields: Sequence[str]) -> tuple[float, ...]:
    numbers = [_number(field) for field in fields]
    if None in numbers:
        raise LogError(f"{path}, line {line}: {brief(fields[numbers.index(None)])} is not a number.")
    return tuple(number for number in numbers if number is not None)


def _number(field: str) -> float | None:
    try:
        return float(field)
    except ValueError:
        return None
