"""Writing a file so that whoever looks finds it whole or not at all. Nothing in this package writes in another way."""

from __future__ import annotations

import os
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
        The folder does not exist, is not writable, or the disk is full; what was at `path` before is untouched.
    """
    try:
        with atomic_stream(path) as stream:
            stream.write(content)
    except OSError as error:
        raise FileFormatError(f"{path} cannot be written: {error.strerror or error}.") from error


@contextmanager
def atomic_stream(path: str | Path) -> Iterator[BinaryIO]:
    """A stream to a temporary file beside `path`, which gets its name in one step when the block ends without error.

    A link is followed, and something that is not an ordinary file (``/dev/stdout``, a pipe) is written to directly.

    Raises
    ------
    OSError
        As above. Not a `FileFormatError`: in the block, other files may be read that cannot be.
    """
    path = Path(os.path.realpath(path))
    if path.exists() and not path.is_file():
        with open(path, "wb") as stream:
            yield stream
        return
    # Not tempfile.mkstemp: its files are readable by their owner alone, and os.replace would keep that.
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with open(temporary, "wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
