"""Folders of CSV files: two files for every pair of a target and a sensor.

The RWHEC paper's dataset was published in this format. A folder holds files named

    <targets>_<id>_<sensors>_<id>_A.csv      A_i = T_sensorcarrier_targetcarrier
    <targets>_<id>_<sensors>_<id>_B.csv      B_i = T_sensor_target

for example ``tag_17_cam_2_A.csv`` and ``tag_17_cam_2_B.csv``. There is no header; each line is one pose,
``qw,qx,qy,qz,tx,ty,tz`` (unit quaternion, scalar first; metres), and line i of A and line i of B are one measurement
of A_i X = Y B_i. The caller names the words for targets and sensors; either word may come first in the file names.
"""

from __future__ import annotations

import codecs
import io
import math
import re
import warnings
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from gtsam_rwhec.errors import FileFormatError, RwhecWarning
from gtsam_rwhec.files.terminal_text import brief, natural_key, shown, some
from gtsam_rwhec.files.whole_files import checked_path, read_whole
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.problem.measurements import GivenMeasurements, LongTranslations, Pair, warn_of_millimetres
from gtsam_rwhec.problem.problem import Problem

COLUMNS = ("qw", "qx", "qy", "qz", "tx", "ty", "tz")

#: A warning names at most this many entries of a folder that are not read.
MOST_NAMED = 20
#: A quaternion's norm may be this far from 1, as in `geometry.poses`; the check here can name the line.
QUATERNION_TOLERANCE = 1e-2
#: A file of more bytes than this is not read; seven million poses fit.
MOST_BYTES = 1 << 30
#: A line of more bytes than this is no pose, however many digits its seven numbers have.
LONGEST_LINE = 10_000
#: A line of a file, for messages.
ROW = ",".join(COLUMNS)


class CsvWarning(RwhecWarning):
    """Files and folders that were not read, by name."""


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
        Where the files are; folders inside it are not read.
    scale
        ``"known"``, ``"shared"`` or ``"per_target"``, as in `Problem`.
    sigma
        Standard deviation of a measured translation along each axis, in metres; None for unit weights.
    kappa
        Concentration of a measured rotation, 1 / rad^2: about each axis its standard deviation is 1 / sqrt(2 kappa)
        radians; None for unit weights.
    targets, sensors
        The words for targets and for sensors in the file names, which are in the frames' names too: ``tag_0``,
        ``cam_0``. Exchange the words to exchange the roles.
    keep_measurements
        False keeps the moments alone, as in `Problem`: memory then does not grow with the number of lines.

    Returns
    -------
    Problem
        Pairs in the order of their numbers (``tag_2`` before ``tag_10``).

    Raises
    ------
    FileFormatError
        The folder or its files do not exist, one file of a pair is missing, a file is empty, a line is not seven
        finite numbers, or the two files of a pair have different numbers of lines.
    RwhecError
        A pose or a weight that `Problem.add` refuses; its message starts with the names of both files.

    Warns
    -----
    CsvWarning
        The folder has other entries; the warning names them.
    UnitsWarning
        Translations look like millimetres; one warning for all pairs.
    """
    folder = checked_path(folder)
    _check_words(targets, sensors)
    pairs = _find_pairs(folder, targets, sensors)
    problem = Problem(scale=scale, keep_measurements=keep_measurements)
    long: list[LongTranslations] = []
    for (target, sensor), (path_a, path_b) in pairs.items():
        rows_a, rows_b = read_pose_rows(path_a), read_pose_rows(path_b)
        if len(rows_a) != len(rows_b):
            raise FileFormatError(
                f"{path_a} has {len(rows_a)} lines and {path_b} has {len(rows_b)}: give both the same number of lines; "
                "line i of both is one measurement. Take out the line without a partner (of an image without a "
                "detection?), and not the last one: later lines would belong to others."
            )
        source = f"{path_a} and {path_b.name}"
        problem.add_batch(
            Pair(target, sensor), GivenMeasurements(rows_a, rows_b, sigma, kappa, "wxyz", None, None, source), long
        )
    warn_of_millimetres(long, stacklevel=2)
    return problem


def read_pose_rows(path: str | Path) -> NDArray[np.float64]:
    """Read the rows (N, 7), N >= 1, of one file of poses: text in UTF-8, lines of ``qw,qx,qy,qz,tx,ty,tz``.

    All are finite, with quaternions of norm 1 up to `QUATERNION_TOLERANCE`, which `Problem.add` normalises. For a file
    that cannot be read or is empty, and for any other line, a FileFormatError has the file and the line.
    """
    path = Path(path)
    content = read_whole(path, MOST_BYTES, "Lines of poses were").removeprefix(codecs.BOM_UTF8).rstrip()
    if not content:
        raise FileFormatError(
            f"{path} is empty; give lines of {ROW}. Delete both files of a pair without measurements."
        )
    number_of_lines = content.count(b"\n") + 1
    if too_long := re.search(rb"[^\n]{%d}" % (LONGEST_LINE + 1), content):
        number = content.count(b"\n", 0, too_long.start()) + 1
        raise FileFormatError(f"{path}, line {number}: longer than {LONGEST_LINE} bytes. Give {ROW}.")
    if not content.isascii():
        _raise_for_first_bad_line(path, content, "it has characters that no number has")
    try:
        # Read line by line from a stream: a list of all lines takes many times the bytes of the file.
        text = io.TextIOWrapper(io.BytesIO(content), "ascii", newline="\n")
        rows = np.loadtxt(text, delimiter=",", comments=None, ndmin=2, dtype=np.float64)
    except ValueError as error:
        _raise_for_first_bad_line(path, content, brief(str(error)))
    # loadtxt skips blank lines and accepts nan: lines of A and B would no longer match, without a message.
    if rows.shape != (number_of_lines, len(COLUMNS)) or not np.isfinite(rows).all():
        _raise_for_first_bad_line(path, content, f"read {rows.shape[0]} rows of {rows.shape[1]} numbers")
    with np.errstate(over="ignore"):  # an infinite norm is not 1 either
        norms = np.linalg.norm(rows[:, :4], axis=1)
    worst = int(np.argmax(np.abs(norms - 1.0)))
    if abs(norms[worst] - 1.0) > QUATERNION_TOLERANCE:
        raise FileFormatError(
            f"{path}, line {worst + 1}: the quaternion qw,qx,qy,qz = {','.join(map(str, rows[worst, :4]))} has norm "
            f"{norms[worst]:.6g} in place of 1. Are the columns in the order {ROW}?"
        )
    return rows


def _raise_for_first_bad_line(path: Path, content: bytes, otherwise: str) -> NoReturn:
    """Find the line that `np.loadtxt` cannot read; where there is none, the message is `otherwise`."""
    begins = 0
    for number, raw in enumerate(io.BytesIO(content), start=1):
        try:
            line = raw.decode()
        except UnicodeDecodeError as error:
            at = begins + error.start
            raise FileFormatError(f"{path} is not a text file in UTF-8 (byte {at}); give lines of {ROW}.") from error
        begins += len(raw)
        count = line.count(",") + 1
        fields = [field.strip() for field in line.split(",", len(COLUMNS))]
        wrong = [(name, field) for name, field in zip(COLUMNS, fields, strict=False) if not _is_finite_number(field)]
        fault = ""
        if not line.strip():
            fault = f"blank line between poses; a measurement may be missing here. Give {ROW}."
        elif count != len(COLUMNS):
            fault = f"{count} fields in place of {len(COLUMNS)} ({ROW}): {line.strip()[:80]!r}."
        elif wrong:
            fault = f"not a finite number: {', '.join(f'{name} is {brief(field)}' for name, field in wrong)}."
            if number == 1 and len(wrong) == len(COLUMNS):
                fault += " If it is a header, delete it."
        if fault:
            raise FileFormatError(f"{path}, line {number}: {fault}")
    raise FileFormatError(f"{path} cannot be read as lines of {ROW}: {otherwise}.")


def _is_finite_number(field: str) -> bool:
    try:
        return field.isascii() and "_" not in field and math.isfinite(float(field))
    except ValueError:
        return False


def _check_words(targets: str, sensors: str) -> None:
    for argument, word in (("targets", targets), ("sensors", sensors)):
        if not isinstance(word, str) or not word or "/" in word:
            raise FileFormatError(
                f'{argument}={brief(word)}: give the word for {argument} in the file names, such as "tag" or "cam".'
            )
    if f"{targets}_".startswith(f"{sensors}_") or f"{sensors}_".startswith(f"{targets}_"):
        raise FileFormatError(
            f"targets={brief(targets)} and sensors={brief(sensors)} cannot be told apart in file names, because one "
            "word begins with the other word; rename the files."
        )


def _find_pairs(folder: Path, targets: str, sensors: str) -> dict[Pair, tuple[Path, Path]]:
    """Both files of every pair, in natural order; warn of all other entries of the folder."""
    example = shown(f"{targets}_0_{sensors}_0_A.csv")
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "does not exist"
        raise FileFormatError(f"{folder} {what}; give a folder with files such as {example}.")
    found: dict[Pair, dict[str, Path]] = {}
    unknown = []
    for path in folder.iterdir():
        parsed = _parse_name(path.name, targets, sensors) if path.is_file() else None
        if parsed is None:
            unknown.append(path.name)
            continue
        if any("\ud800" <= sign <= "\udfff" for sign in path.name):  # Python's surrogates for bytes that are no text
            raise FileFormatError(f"{path}: the file's name is not text in UTF-8; rename the file.")
        target, sensor, side = parsed
        sides = found.setdefault(Pair(target, sensor), {})
        if side in sides:
            raise FileFormatError(f"{sides[side]} and {path} are both {side} of {target} and {sensor}; keep one.")
        sides[side] = path
    if unknown:
        unknown.sort(key=natural_key)
        warnings.warn(
            f"{folder}: {len(unknown)} {'entry' if len(unknown) == 1 else 'entries'} not read, with other names than "
            f"{example}: {some(list(map(shown, unknown)), MOST_NAMED)}",
            CsvWarning,
            stacklevel=3,
        )
    if not found:
        raise FileFormatError(
            f"{folder} has no files named like {example}. Give the words of the file names for targets (now "
            f"{brief(targets)}) and sensors (now {brief(sensors)})."
        )
    in_order = sorted(found, key=lambda pair: (natural_key(pair.target), natural_key(pair.sensor)))
    return {pair: _both(found[pair], folder) for pair in in_order}


def _both(sides: dict[str, Path], folder: Path) -> tuple[Path, Path]:
    if len(sides) == 1:
        ((side, path),) = sides.items()
        other = f"{path.name.removesuffix(f'{side}.csv')}{'B' if side == 'A' else 'A'}.csv"
        raise FileFormatError(f"{folder / other} is missing: {path.name} is there, and a pair needs both files.")
    return sides["A"], sides["B"]


def _parse_name(name: str, targets: str, sensors: str) -> tuple[str, str, str] | None:
    """(target, sensor, "A" or "B") of a file name, whichever word comes first; None for other files."""
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
