"""Touched points: known points that a sensor measured, and their CSV file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from gtsam_rwhec.errors import CountError, FileFormatError, PoseError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.files.whole_files import read_whole
from gtsam_rwhec.geometry.poses import LARGEST_M, Array, PosesLike, as_transforms, checked_rows, rows_to_transforms
from gtsam_rwhec.geometry.real_numbers import real_array

#: The columns of a file of touches; the last seven may be left out.
POINTS = ("sensor_x_m", "sensor_y_m", "sensor_z_m", "known_x_m", "known_y_m", "known_z_m")
POSES = ("A_qw", "A_qx", "A_qy", "A_qz", "A_x_m", "A_y_m", "A_z_m")
#: A file of touches has at most this many bytes.
MOST_OF_TOUCHES = 50_000_000


#: No sensor's touched points are farther away, metres.
FARTHEST_M = 100.0


@dataclass(frozen=True, eq=False)
class Touches:
    """Known points that a sensor measured."""

    sensor_m: Array  #: (n, 3): the points in the sensor's frame, as it measured them, metres
    #: (n, 3): the same points as they are known (the robot's pose times the tool tip), metres: in the frame that
    #: carries the sensor; with ``A`` in the frame that carries the targets
    known_m: Array
    #: (n, 4, 4): T_sensorcarrier_targetcarrier at the moment at which the sensor measured each point; None: not needed
    A: Array | None = None
    source: str = ""  #: The file's name

    @staticmethod
    def of(sensor_m: ArrayLike, known_m: ArrayLike, A: PosesLike | None = None, source: str = "") -> Touches:
        """Checked touches; points (n, 3) in metres, and poses as ``Problem.add`` takes them (quaternions w first)."""
        points = []
        for name, given in (("sensor_m", sensor_m), ("known_m", known_m)):
            try:
                array = real_array(given)
            except ValueError as error:
                raise PoseError(f"{name} cannot be read as numbers: {error}") from error
            if array.ndim != 2 or array.shape[1:] != (3,) or not (np.abs(array) <= LARGEST_M).all():
                raise PoseError(f"{name} has the shape {array.shape}; give (n, 3) finite numbers, metres")
            points.append(array)
        away_m = float(np.median(np.linalg.norm(points[0], axis=1))) if len(points[0]) else 0.0
        if away_m > FARTHEST_M:
            raise PoseError(f"the points of the sensor are {away_m:.4g} m away (median): give metres, not millimetres")
        poses = None if A is None else _checked_poses(A, f"A of {source or 'the touches'}")
        counts = [len(each) for each in (*points, *([] if poses is None else [poses]))]
        if len(set(counts)) > 1 or not counts[0]:
            raise CountError(f"sensor_m, known_m and A have {', '.join(map(str, counts))} rows; give one of each touch")
        return Touches(points[0], points[1], poses, source)


def _checked_poses(A: PosesLike, where: str) -> Array:
    """Valid poses (n, 4, 4)."""
    transforms = as_transforms(A, "wxyz" if np.ndim(A) == 2 else None, where)  # type: ignore[arg-type]
    return rows_to_transforms(checked_rows(transforms, 0, where).rows)


def is_touches_file(path: str | Path) -> bool:
    """Whether a path names a CSV file, as touches are, and no folder; it may not be there."""
    return Path(path).suffix.lower() == ".csv" and not Path(path).is_dir()


def read_touches(path: str | Path) -> Touches:
    """Read a CSV file of touches: a header with the names `POINTS` (and `POSES`) in any order, one touch a line.

    Raises
    ------
    FileFormatError
        The file cannot be read, or a column or a number is missing or wrong; the message has the line.
    """
    path = Path(path)
    try:
        text = read_whole(path, MOST_OF_TOUCHES, "Touches were").decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{path} is not a text file in UTF-8 (byte {error.start}).") from error
    lines = text.splitlines()
    if not text.strip():
        raise FileFormatError(f"{path} is empty: give a header with {', '.join(POINTS)} (metres), and touches below.")
    names = [name.strip() for name in lines[0].split(",")] if lines else []
    wanted = (*POINTS, *POSES) if any(name in POSES for name in names) else POINTS
    if sorted(names) != sorted(wanted):
        raise FileFormatError(
            f"{path}, line 1: the columns are {brief(', '.join(names))}; give a header with {', '.join(POINTS)} "
            f"(metres), and, where known is in the frame that carries the targets, {', '.join(POSES)}."
        )
    rows = [_numbers(path, number, line, names) for number, line in enumerate(lines[1:], start=2) if line.strip()]
    if not rows:
        raise FileFormatError(f"{path} has no touches: give a line for each.")
    of = dict(zip(names, np.array(rows).T, strict=True))
    columns = [np.stack([of[name] for name in group], axis=1) for group in (POINTS[:3], POINTS[3:])]
    poses = np.stack([of[name] for name in POSES], axis=1) if wanted is not POINTS else None
    return Touches.of(columns[0], columns[1], poses, path.name)


def _numbers(path: Path, number: int, line: str, names: list[str]) -> list[float]:
    fields = [field.strip() for field in line.split(",")]
    if len(fields) != len(names):
        raise FileFormatError(f"{path}, line {number}: {len(fields)} fields in place of {len(names)}.")
    values = []
    for name, field in zip(names, fields, strict=True):
        try:
            value = float(field)
        except ValueError:
            value = math.nan
        if not abs(value) <= LARGEST_M:
            raise FileFormatError(f"{path}, line {number}: {name} is {brief(field)}; give a finite number.")
        values.append(value)
    return values
