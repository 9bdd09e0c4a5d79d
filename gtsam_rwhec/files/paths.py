"""Paths as users give them."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.terminal_text import brief

#: Bytes of the longest path, and of the longest name in it, that Linux knows.
MOST_BYTES, LONGEST_NAME = 4096, 255


def checked_path(path: object) -> Path:
    """A path; a FileFormatError for anything that names no file: a number, bytes, text with a null character."""
    if not isinstance(path, str | os.PathLike) or "\0" in (text := str(os.fspath(path))) or not _is_encodable(text):
        raise FileFormatError(f"{brief(path)} is not a path; give the name of a file or folder, as text or Path.")
    if len(os.fsencode(text)) >= MOST_BYTES or any(len(os.fsencode(part)) > LONGEST_NAME for part in Path(text).parts):
        raise FileFormatError(f"{brief(path)} is not a path; no file can have so long a name.")
    return Path(text)


def is_one_of(path: Path, files: Iterable[Path]) -> bool:
    """Whether a path is one of these ordinary files, by whatever name; what cannot be looked at is not."""
    return any(_is_same(path, file) for file in files)


def _is_same(path: Path, file: Path) -> bool:
    try:
        return file.is_file() and path.samefile(file)
    except OSError:  # one of them is not there
        return False


def _is_encodable(text: str) -> bool:
    try:
        os.fsencode(text)
    except UnicodeEncodeError:  # half a character
        return False
    return True
