"""A calibration from its result file, or from the folder that holds it."""

from __future__ import annotations

from pathlib import Path

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.results.result_file import Result, read_result

#: The name of the result in an output folder.
RESULT_FILE = "result.json"


def result_path(path: str | Path) -> Path:
    """The result file that a path means: itself, or the one in this folder; FileFormatError if there is none."""
    path = Path(path)
    if not path.is_dir():
        return path
    inside = path / RESULT_FILE
    if not inside.is_file():
        raise FileFormatError(
            f"{path} has no {RESULT_FILE}; give a folder that gtsam-rwhec calibrate wrote, or a result file"
        )
    return inside


def read_calibration(path: str | Path) -> Result:
    """Read ``result.json``, or the one in a folder that ``calibrate`` wrote; raises as ``rw.results.read_result``."""
    return read_result(result_path(path))
