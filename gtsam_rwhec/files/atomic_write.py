"""Files are written whole or not at all. Every file that this library writes goes through here.

The one file that grows while a run works has lines with checksums (`appending_stream`): a torn last one shows.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from gtsam_rwhec.errors import FileFormatError


def write_atomically(path: str | Path, content: bytes) -> None:
    """Write a file as `atomic_stream` does.

    Raises
    ------
    FileFormatError
        The folder does not exist, is not writable, or the disk is full. An earlier file at `path` stays as it was.
    """
    try:
        with atomic_stream(path) as stream:
            stream.write(content)
    except OSError as error:
        raise FileFormatError(f"{path} cannot be written: {error.strerror or error}.") from error


def why_not_writable(path: str | Path) -> str:
    """Why `write_atomically` could not write a file now, in words; empty where it could. Nothing is left behind.

    For checks before a long calculation: rights, read-only disks and names that folders have show only by trying.
    """
    path = Path(path).absolute()
    try:
        if not path.parent.is_dir():
            return f"the folder {path.parent} does not exist"
        if path.is_dir():
            return "it is a folder; give the name of a file"
        if path.exists() and not path.is_file():
            return ""  # a pipe or a device: to open it is to begin
    except OSError as error:  # a name that is too long
        return error.strerror or str(error)
    trial = Path(os.path.realpath(path)).with_name(f".{path.name}.{os.getpid()}.trial")
    try:
        with open(trial, "xb"):
            pass
        trial.unlink()
    except PermissionError:
        return f"no right to write into {trial.parent}"
    except OSError as error:
        return error.strerror or str(error)
    return ""


def appending_stream(path: str | Path) -> BinaryIO:
    """A stream that adds to the end of a file. What it is told must itself show whether it is whole.

    Raises
    ------
    OSError
        When the file cannot be written.
    """
    return open(path, "ab")


@contextmanager
def atomic_stream(path: str | Path) -> Iterator[BinaryIO]:
    """A stream to a temporary file beside `path`. It takes the name `path` when the block ends without an error.

    A link is followed. A path that is not an ordinary file (``/dev/stdout``, a pipe) is written to directly.

    Raises
    ------
    OSError
        When the file cannot be written. Not a `FileFormatError`, since the block may read other files.
    """
    path = Path(os.path.realpath(path))
    if path.exists() and not path.is_file():
        with open(path, "wb") as stream:
            yield stream
        return
    # Not tempfile.mkstemp: only the owner can read its files, and os.replace would keep that.
    # Two threads, or two machines with one disk, may write the same file and have the same number of process.
    temporary = path.with_name(f".{path.name}.{os.getpid()}{secrets.randbelow(10**9):09d}.part")
    try:
        with open(temporary, "wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
