"""Files that are read whole: ordinary files of at most a size, and what a shell hands over as /dev/stdin or /dev/fd/N.

A pipe or a device in place of a file is refused: reading it could wait for ever, or never end.
"""

from __future__ import annotations

import os
import re
import secrets
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.terminal_text import brief

#: The descriptors that a shell's ``<`` and ``<( )`` give; these may be pipes.
_DESCRIPTORS = re.compile(r"/dev/stdin|/dev/fd/\d+|/proc/self/fd/\d+")
#: What a path can be instead of an ordinary file, in words.
_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def opened(path: str | Path) -> BinaryIO:
    """A stream of an ordinary file, or of a descriptor of this process.

    Raises `FileFormatError` if no file can have this name, there is none, it may not be read, or it is a folder, a pipe
    or a device.
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

    Raises `FileFormatError` as `opened`; or the file has more bytes, or reading it fails.
    """
    with opened(path) as stream:
        try:
            # Python makes room for all that it is asked to read; a pipe has no size.
            content = stream.read(min(most_bytes, os.fstat(stream.fileno()).st_size or most_bytes) + 1)
        except OSError as error:
            raise FileFormatError(f"{path} cannot be read: {error.strerror}.") from error
    if len(content) > most_bytes:
        raise FileFormatError(f"{path} is larger than {most_bytes} bytes; is it the right file? {expected} expected.")
    return content


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

    For checks before a long calculation: only a trial shows missing rights, a read-only disk or a folder of this name.
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
    """A stream that appends to a file; `OSError` if it cannot be written.

    The written data must themselves show whether they are complete.
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
    """Whether a path is one of these ordinary files, under any name; False if the path cannot be examined."""
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
