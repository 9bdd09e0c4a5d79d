"""Checks of the files and folders that a stage will write, before it begins its work."""

from __future__ import annotations

import os
from pathlib import Path

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.logs import Log
from gtsam_rwhec.pipeline.log_contract import CLEAN_LOG


def check_writable(path: str | Path) -> None:
    """Check that a file can be written.

    Raises
    ------
    LogError
        There is no such folder, no right to write into it, or a folder of this name.
    """
    path = Path(path)
    folder = path.absolute().parent
    if not folder.is_dir():
        raise LogError(f"{path} cannot be written: there is no folder {folder}.")
    if path.is_dir():
        raise LogError(f"{path} cannot be written: it is a folder; give the name of a file.")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise LogError(f"{path} cannot be written: no right to write into {folder}.")


def check_is_not_read(log: Log, path: str | Path) -> None:
    """Check that a file is not one of those from which the log is read.

    Raises
    ------
    LogError
        It is one of them.
    """
    if any(os.path.realpath(path) == os.path.realpath(file.path) for file in log.files):
        raise LogError(f"{path} is the log that is read: a raw log stays as it is; give another file or folder.")


def made_folder(path: str | Path) -> Path:
    """The folder, made if it is not there.

    Raises
    ------
    LogError
        It cannot be made, or files cannot be written into it.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LogError(f"{path} cannot be made a folder: {error.strerror}.") from error
    check_writable(path / CLEAN_LOG)
    return path
