"""Checks of the files and folders that a stage will write, before it begins its work."""

from __future__ import annotations

import os
from pathlib import Path

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.logs import Log
from gtsam_rwhec.pipeline.log_contract import CLEAN_LOG


def check_writable(path: str | Path) -> None:
    """Raise `LogError` if a file cannot be written: its folder is missing or not writable, or a folder has its name."""
    path = Path(path)
    folder = path.absolute().parent
    if not folder.is_dir():
        raise LogError(f"{path} cannot be written: there is no folder {folder}.")
    if path.is_dir():
        raise LogError(f"{path} cannot be written: it is a folder; give the name of a file.")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise LogError(f"{path} cannot be written: no right to write into {folder}.")


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
