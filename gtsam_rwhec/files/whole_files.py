"""Files that are read whole: ordinary files of at most a size, and what a shell hands over as /dev/stdin or /dev/fd/N.

A pipe or a device in place of a file is refused: reading it could wait for ever, or never end.
"""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path
from typing import BinaryIO

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.paths import checked_path

#: The descriptors that a shell's ``<`` and ``<( )`` give; these may be pipes.
_DESCRIPTORS = re.compile(r"/dev/stdin|/dev/fd/\d+|/proc/self/fd/\d+")
#: What a file can be in place of a file, in words.
_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def opened(path: str | Path) -> BinaryIO:
    """A stream of an ordinary file, or of a descriptor of this process.

    Raises
    ------
    FileFormatError
        No file can have this name; there is no such file, it may not be read, or it is a folder, a pipe or a device.
    """
    try:
        # Without O_NONBLOCK, opening a pipe waits until somebody writes to it.
        descriptor = os.open(checked_path(path), os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise FileFormatError(f"{path} cannot be read: {error.strerror}.") from error
    mode = os.fstat(descriptor).st_mode
    is_given = _DESCRIPTORS.fullmatch(str(path)) is not None
    if not stat.S_ISREG(mode) and (stat.S_ISDIR(mode) or not is_given):
        os.close(descriptor)
        kind = next((words for is_kind, words in _KINDS if is_kind(mode)), "not a file")
        advice = "" if stat.S_ISDIR(mode) else "; give a file, or /dev/stdin"
        raise FileFormatError(f"{path} cannot be read: it is {kind}{advice}.")
    os.set_blocking(descriptor, True)
    return os.fdopen(descriptor, "rb")


def read_whole(path: str | Path, most_bytes: int, expected: str) -> bytes:
    """The content of a file of at most `most_bytes`; `expected` says in words what should be in it.

    Raises
    ------
    FileFormatError
        As `opened`; or the file has more bytes, or reading it fails.
    """
    with opened(path) as stream:
        try:
            content = stream.read(most_bytes + 1)
        except OSError as error:
            raise FileFormatError(f"{path} cannot be read: {error.strerror}.") from error
    if len(content) > most_bytes:
        raise FileFormatError(f"{path} is larger than {most_bytes} bytes; is it the right file? {expected} expected.")
    return content
