"""Writing a file so that whoever looks finds it whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path


def write_atomically(path: Path, content: bytes) -> None:
    """Write to a temporary file beside `path`, then give it its name in one step.

    A link is followed, and something that is not an ordinary file (``/dev/stdout``, a pipe) is written to directly.

    Raises
    ------
    OSError
        The folder does not exist, is not writable, or the disk is full; what was at `path` before is untouched.
    """
    path = Path(os.path.realpath(path))
    if path.exists() and not path.is_file():
        path.write_bytes(content)
        return
    # Not tempfile.mkstemp: its files are readable by their owner alone, and os.replace would keep that.
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with open(temporary, "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
