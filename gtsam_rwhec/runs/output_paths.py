"""Checks of the files and folders that a stage will write, before it begins its work."""

from __future__ import annotations

import os
from pathlib import Path

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.export.files import FILES, FOLDERS, SUFFIX
from gtsam_rwhec.files.whole_files import why_not_writable
from gtsam_rwhec.logs import Log
from gtsam_rwhec.runs.log_contract import CLEAN_LOG, DETECTED_LOG, EVIDENCE_FILE, REPORT_FILE, RESULT_FILE, SEEN_SHEET

#: All files that a calibration leaves in its folder, relative to it. A file that is written there has its name here.
LEFT = (CLEAN_LOG, REPORT_FILE, RESULT_FILE, EVIDENCE_FILE, *FILES, SEEN_SHEET)
#: With the log that it has during the work.
WRITTEN = (*LEFT, DETECTED_LOG)


def is_written(name: str) -> bool:
    """Whether a calibration writes a file of this name, relative to its folder."""
    folder, _, file = name.rpartition("/")
    return name in WRITTEN or (folder in FOLDERS and file.endswith(SUFFIX) and not file.startswith("."))


def check_writable(path: str | Path) -> None:
    """Raise `LogError` if a file cannot be written: its folder is missing or not writable, or a folder has its name."""
    why = why_not_writable(path)
    if why:
        raise LogError(f"{path} cannot be written: {why}.")


def check_is_not_read(log: Log, path: str | Path) -> None:
    """Raise `LogError` if a file is one of those from which the log is read."""
    if any(os.path.realpath(path) == os.path.realpath(file.path) for file in log.files):
        raise LogError(f"{path} is the raw log, and a raw log is never changed; give another file or folder.")


def made_folder(path: str | Path) -> Path:
    """Return the folder, made if it does not exist. Raise `LogError` if files cannot be written into it."""
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LogError(f"{path} cannot be made a folder: {error.strerror}.") from error
    check_writable(path / CLEAN_LOG)
    return path


def made_output_folder(path: str | Path) -> Path:
    """As `made_folder`, for all files of a calibration: whatever could not be replaced at its end is told before it."""
    path = made_folder(path)
    for name in WRITTEN:
        if "/" not in name:
            check_writable(path / name)
    for inside in (path / name for name in FOLDERS):
        if inside.is_dir():
            check_writable(inside / CLEAN_LOG)
        elif os.path.lexists(inside):
            raise LogError(f"{inside} cannot be made a folder: it is a file.")
    return path
