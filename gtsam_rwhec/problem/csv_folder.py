"""Folders of CSV files: one pair of files for every target and sensor that saw each other.

The format is the one in which the RWHEC paper's dataset was published. A folder holds files named

    <targets>_<id>_<sensors>_<id>_A.csv      A_i = T_sensorcarrier_targetcarrier
    <targets>_<id>_<sensors>_<id>_B.csv      B_i = T_sensor_target

for example ``tag_17_cam_2_A.csv`` and ``tag_17_cam_2_B.csv``. There is no header; each line is one pose,
``qw,qx,qy,qz,tx,ty,tz`` (unit quaternion, scalar first; metres), and line i of A and line i of B are one measurement
of A_i X = Y B_i. Which word of the file names stands for the targets and which for the sensors is for the caller to
say; either may come first in the names.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from gtsam_rwhec.errors import FileFormatError, RwhecWarning
from gtsam_rwhec.files.natural_order import natural_key
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem

COLUMNS = ("qw", "qx", "qy", "qz", "tx", "ty", "tz")

QUATERNION_TOLERANCE = 1e-2
"""How far a quaternion's norm may be from 1, as in `poses`; checked here too because only here the line is known."""


class CsvWarning(RwhecWarning):
    """Something in the folder was not read; says what."""


def read_csv(
    folder: str | Path,
    scale: ScaleMode = "known",
    sigma: float | None = None,
    kappa: float | None = None,
    targets: str = "tag",
    sensors: str = "cam",
    *,
    keep_measurements: bool = True,
) -> Problem:
    """Read every pair of files of a folder into one problem.

    Parameters
    ----------
    folder
        Where the files are; folders inside it are not entered.
    scale
        ``"known"``, ``"shared"`` or ``"per_target"``, as in `Problem`.
    sigma
        Standard deviation of a measured translation along each axis, in metres; None for unit weights.
    kappa
        Concentration of a measured rotation, 1 / rad^2: about each axis its standard deviation is 1 / sqrt(2 kappa)
        radians; None for unit weights.
    targets, sensors
        The words that stand for targets and for sensors in the file names. The frames are named with them:
        ``tag_0``, ``cam_0``. Exchange them and the roles are exchanged.
    keep_measurements
        False to keep only what the certified solution needs: memory then does not grow with the number of lines.

    Returns
    -------
    Problem
        Pairs in the order of their numbers (``tag_2`` before ``tag_10``).

    Raises
    ------
    FileFormatError
        No such folder, no such files in it, one file of a pair missing, an empty file, a line that is not seven finite
        numbers, or two files of a pair with different numbers of lines.
    RwhecError
        A pose or a weight that `Problem.add` refuses; its message starts with the names of both files.

    Warns
    -----
    CsvWarning
        Names everything in the folder that is not one of these files.
    """
    folder = Path(folder)
    _check_words(targets, sensors)
    pairs = _find_pairs(folder, targets, sensors)
    problem = Problem(scale=scale, keep_measurements=keep_measurements)
    for (target, sensor), (path_a, path_b) in pairs.items():
        rows_a, rows_b = read_pose_rows(path_a), read_pose_rows(path_b)
        if len(rows_a) != len(rows_b):
            raise FileFormatError(
                f"{path_a} has {len(rows_a)} lines and {path_b} has {len(rows_b)}: line i of both is one measurement, "
                "so the two must have the same number of lines."
            )
        problem.add(
            target=target,
            sensor=sensor,
            A=rows_a,
            B=rows_b,
            order="wxyz",
            sigma=sigma,
            kappa=kappa,
            source=f"{path_a} and {path_b.name}",
        )
    return problem


def read_pose_rows(path: str | Path) -> NDArray[np.float64]:
    """Read one file of poses.

    Parameters
    ----------
    path
        Text in UTF-8; lines of ``qw,qx,qy,qz,tx,ty,tz``.

    Returns
    -------
    rows : (N, 7) array
        N >= 1, all finite; quaternions of norm 1 but for rounding, which `Problem.add` takes away.

    Raises
    ------
    FileFormatError
        The file cannot be read, is empty, or has a line that is not seven finite numbers or whose quaternion is far
        from norm 1; names the file and the line.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8-sig").rstrip().split("\n")
    except UnicodeDecodeError as error:
        raise FileFormatError(
            f"{path} is not a text file in UTF-8 (byte {error.start}); expected lines of {_row()}."
        ) from error
    except OSError as error:
        raise FileFormatError(f"{path} cannot be read: {error.strerror}.") from error
    if lines == [""]:
        raise FileFormatError(
            f"{path} is empty; expected lines of {_row()}. Delete both files of a pair without measurements."
        )
    try:
        rows = np.loadtxt(lines, delimiter=",", comments=None, ndmin=2, dtype=np.float64)
    except ValueError as error:
        _raise_for_first_bad_line(path, lines, str(error))
    # loadtxt passes over blank lines and accepts nan: both would put A and B out of step, or worse, without a word.
    if rows.shape != (len(lines), len(COLUMNS)) or not np.isfinite(rows).all():
        _raise_for_first_bad_line(path, lines, f"read {rows.shape[0]} rows of {rows.shape[1]} numbers")
    norms = np.linalg.norm(rows[:, :4], axis=1)
    worst = int(np.argmax(np.abs(norms - 1.0)))
    if abs(norms[worst] - 1.0) > QUATERNION_TOLERANCE:
        raise FileFormatError(
            f"{path}, line {worst + 1}: the quaternion qw,qx,qy,qz = {','.join(map(str, rows[worst, :4]))} has norm "
            f"{norms[worst]:.6g} in place of 1. Are the columns in the order {_row()}?"
        )
    return rows


def _row() -> str:
    return ",".join(COLUMNS)


def _raise_for_first_bad_line(path: Path, lines: list[str], otherwise: str) -> NoReturn:
    """Find what the fast reader stumbled over; `otherwise` is its own message, for what is not found here."""
    for number, line in enumerate(lines, start=1):
        where = f"{path}, line {number}"
        if not line.strip():
            raise FileFormatError(
                f"{where}: blank line between poses; a measurement may be missing here. Expected {_row()}."
            )
        fields = [field.strip() for field in line.split(",")]
        faults = [
            f"{name} is {field!r}" for name, field in zip(COLUMNS, fields, strict=False) if not _is_finite_number(field)
        ]
        if len(fields) != len(COLUMNS):
            raise FileFormatError(
                f"{where}: {len(fields)} fields in place of {len(COLUMNS)} ({_row()}): {_shorten(line)!r}."
            )
        if faults:
            header = " If it is a header, delete it." if number == 1 and len(faults) == len(COLUMNS) else ""
            raise FileFormatError(f"{where}: not a finite number: {', '.join(faults)}.{header}")
    raise FileFormatError(f"{path} cannot be read as lines of {_row()}: {otherwise}.")


def _is_finite_number(field: str) -> bool:
    try:
        return math.isfinite(float(field)) and "_" not in field
    except ValueError:
        return False


def _shorten(line: str, length: int = 80) -> str:
    return line if len(line) <= length else line[:length] + "..."


def _check_words(targets: str, sensors: str) -> None:
    for argument, word in (("targets", targets), ("sensors", sensors)):
        if not word or "/" in word:
            raise FileFormatError(
                f'{argument}={word!r}: give the word that file names have for them, such as "tag" or "cam".'
            )
    if f"{targets}_".startswith(f"{sensors}_") or f"{sensors}_".startswith(f"{targets}_"):
        raise FileFormatError(
            f"targets={targets!r} and sensors={sensors!r} cannot be told apart in file names: one begins with the "
            "other; rename the files."
        )


def _find_pairs(folder: Path, targets: str, sensors: str) -> dict[Pair, tuple[Path, Path]]:
    """Both files of every (target, sensor), in natural order; warn of everything else in the folder."""
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "does not exist"
        raise FileFormatError(f"{folder} {what}; expected a folder with files such as {_example(targets, sensors)}.")
    found: dict[Pair, dict[str, Path]] = {}
    unknown = []
    for path in folder.iterdir():
        parsed = _parse_name(path.name, targets, sensors) if path.is_file() else None
        if parsed is None:
            unknown.append(path.name)
            continue
        target, sensor, side = parsed
        sides = found.setdefault(Pair(target, sensor), {})
        if side in sides:
            raise FileFormatError(f"{sides[side]} and {path} are both {side} of {target} and {sensor}; keep one.")
        sides[side] = path
    if unknown:
        unknown.sort(key=natural_key)
        warnings.warn(
            f"{folder}: not read, {_count(len(unknown), 'entry', 'entries')} with other names than "
            f"{_example(targets, sensors)}: {', '.join(unknown)}",
            CsvWarning,
            stacklevel=3,
        )
    if not found:
        raise FileFormatError(
            f"{folder} has no files named like {_example(targets, sensors)}. Say which words the names have for "
            f"targets (now {targets!r}) and sensors (now {sensors!r})."
        )
    return {pair: _both(found[pair], folder) for pair in _naturally_sorted(found)}


def _both(sides: dict[str, Path], folder: Path) -> tuple[Path, Path]:
    if len(sides) == 1:
        ((side, path),) = sides.items()
        other = path.name.removesuffix(f"{side}.csv") + ("B.csv" if side == "A" else "A.csv")
        raise FileFormatError(f"{folder / other} is missing: {path.name} is there, and a pair needs both files.")
    return sides["A"], sides["B"]


def _parse_name(name: str, targets: str, sensors: str) -> tuple[str, str, str] | None:
    """(target, sensor, "A" or "B") of a file name, whichever word comes first; None if it is none of ours."""
    side = name[-5:-4]
    if side not in ("A", "B") or not name.endswith(f"_{side}.csv"):
        return None
    stem = name.removesuffix(f"_{side}.csv")
    for first, second in ((targets, sensors), (sensors, targets)):
        ids = stem.removeprefix(f"{first}_").split(f"_{second}_")
        if stem.startswith(f"{first}_") and len(ids) == 2 and all(ids):
            names = {first: f"{first}_{ids[0]}", second: f"{second}_{ids[1]}"}
            return names[targets], names[sensors], side
    return None


def _naturally_sorted(pairs: Iterable[Pair]) -> list[Pair]:
    return sorted(pairs, key=lambda pair: (natural_key(pair.target), natural_key(pair.sensor)))


def _example(targets: str, sensors: str) -> str:
    return f"{targets}_0_{sensors}_0_A.csv"


def _count(number: int, one: str, many: str) -> str:
    return f"{number} {one if number == 1 else many}"
