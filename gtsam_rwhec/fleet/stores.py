"""Files in object stores and on disks with the same functions: a URL of fsspec (s3, gs, http, ...) or a path.

Paths and ``file://`` need no library. Every error names the store and the request, without credentials: a `StoreError`
if the fault is permanent, a `StoreInterruptedError` (an OSError) after several attempts if it may work later. Bytes
from stores are counted. One request writes an object. File systems find credentials in the usual places:
environment, configuration files, roles.
"""

from __future__ import annotations

import glob
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from gtsam_rwhec.errors import FileFormatError, StoreError
from gtsam_rwhec.files.optional_packages import extra_named
from gtsam_rwhec.files.whole_files import checked_path, write_atomically
from gtsam_rwhec.fleet.store_requests import requested, shown

#: Default limit of the bytes of a file that is read whole, such as a manifest or a rig file.
MOST_BYTES = 1 << 32


@dataclass
class ByteCount:
    """Bytes that came from stores."""

    count: int = 0


_counting: ContextVar[tuple[ByteCount, ...]] = ContextVar("counting", default=())


@contextmanager
def counted_bytes() -> Iterator[ByteCount]:
    """Count bytes inside the block; nested blocks count separately."""
    count = ByteCount()
    token = _counting.set((*_counting.get(), count))
    try:
        yield count
    finally:
        _counting.reset(token)


def count_bytes(count: int) -> None:
    """Add bytes to all active counts."""
    for one in _counting.get():
        one.count += count


def local_path(url: str) -> Path | None:
    """The path of a URL on this machine's disks; None if it is in a store."""
    if url.startswith(("file://", "local://")):
        return checked_path(unquote(urlsplit(url).path))
    return None if "://" in url else checked_path(url)


def exists(url: str) -> bool:
    """Whether a file exists."""
    path = local_path(url)
    if path is not None:
        return path.is_file()
    fs, place = _opened(url)

    def ask() -> bool:  # not fs.isfile: it returns False if the store refuses
        try:
            return bool(fs.info(place)["type"] == "file")
        except FileNotFoundError:
            return False

    return requested(ask, shown(url), url)


def size_of(url: str) -> int:
    """Bytes of a file."""
    path = local_path(url)
    if path is not None:
        return requested(lambda: os.stat(path), str(path), url).st_size
    size = _info(url).get("size")
    if size is None:
        raise StoreError(f"{shown(url)}: its server does not say how many bytes it has; copy the file to a disk.")
    return int(size)


def stamp_of(url: str) -> str:
    """A text that changes when the file changes: its ETag or checksum, else its size and time of change."""
    path = local_path(url)
    if path is not None:
        status = requested(lambda: os.stat(path), str(path), url)
        return f"{status.st_size}-{status.st_mtime_ns}"
    info = _info(url)
    names = ("ETag", "etag", "md5Hash", "generation", "Content-MD5", "LastModified", "updated", "mtime", "created")
    stamp = next((info[name] for name in names if info.get(name)), None)
    if stamp is None:
        raise StoreError(
            f"{shown(url)}: its server tells neither ETag nor time of change, so nobody can see that it changed; copy "
            "the file to a disk."
        )
    return f"{info.get('size')}-{str(stamp).strip(chr(34))}"


def read_bytes(url: str, most_bytes: int = MOST_BYTES) -> bytes:
    """The bytes of a file; a StoreError if there are more than `most_bytes`."""
    size = size_of(url)
    if size > most_bytes:
        raise StoreError(f"{shown(url)} has {size} bytes, and {most_bytes} at most are expected; is it the right file?")
    return read_ranges(url, [(0, size)])[0]


def read_ranges(url: str, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
    """Parts of a file, each from a first byte to before an end byte; complete, or an error.

    All ranges of one call are requested at the same time. A range that breaks off is continued from there.
    """
    path = local_path(url)
    if path is not None:
        return requested(lambda: _local_ranges(path, ranges), str(path), url)
    fs, place = _opened(url)
    parts: list[list[bytes]] = [[] for _ in ranges]

    def missing() -> list[tuple[int, int, int]]:
        """Number, first byte and end of each missing part."""
        came = ((i, a + sum(map(len, part)), b) for i, ((a, b), part) in enumerate(zip(ranges, parts, strict=True)))
        return [each for each in came if each[1] < each[2]]

    def ask() -> None:
        wanted = missing()
        if not wanted:
            return
        _, starts, ends = zip(*wanted, strict=True)
        # At most one connection for each range: `batch_size` of fsspec limits them.
        answers = fs.cat_ranges([place] * len(wanted), list(starts), list(ends), on_error="return")
        fault: Exception | None = None
        for (number, start, end), answer in zip(wanted, answers, strict=True):
            if isinstance(answer, Exception):
                fault = answer
                continue
            count_bytes(len(answer))
            if len(answer) > end - start:  # the server does not support ranges and sent the whole file
                answer = answer[start:end]
            parts[number].append(bytes(answer))
        if fault is not None:
            raise fault
        if short := missing():
            raise StoppedEarlyError(f"the store sent nothing more after byte {short[0][1]}")

    def how_far() -> str:
        short = missing()
        got = sum(len(piece) for part in parts for piece in part)
        at = f", stopped at byte {short[0][1]} of {shown(url)}" if short else ""
        return f"{got} of {sum(b - a for a, b in ranges)} bytes came{at}"

    requested(ask, shown(url), url, how_far)
    return [b"".join(part) for part in parts]


def write_once(url: str, data: bytes) -> bool:
    """Write a whole file, unless it exists with the same bytes. Of two writers at once, one file stays, complete.

    On disks it makes the folder and renames a temporary file; in stores it is one request. Returns whether the file
    existed already, so that nothing was written.
    """
    path = local_path(url)
    if path is not None:
        return requested(lambda: _written_locally(path, data), f"{path}, which is to be written", url)
    fs, place = _opened(url)

    def put() -> bool:
        try:
            if fs.size(place) == len(data) and fs.cat_file(place) == data:
                return True
        except FileNotFoundError:
            pass  # it does not exist yet
        fs.pipe_file(place, data)
        return False

    return bool(requested(put, f"{shown(url)}, which is to be written", url))


def listed(pattern: str) -> list[str]:
    """The sorted URLs of the files, without folders, that match a pattern with ``*``, ``?``, ``[]`` or ``**``."""
    path = local_path(pattern)
    if path is not None:
        found = requested(lambda: glob.glob(str(path), recursive=True), f"the files {path}", pattern)
        return sorted(each for each in found if os.path.isfile(each))
    fs, place = _opened(pattern)

    def ask() -> dict[str, Any]:
        fs.invalidate_cache()  # another process may have written since
        return dict(fs.glob(place, detail=True))

    answer = requested(ask, f"the files {shown(pattern)}", pattern)
    scheme = pattern.partition("://")[0]
    files = (name for name, info in answer.items() if info.get("type") != "directory")
    return sorted(name if "://" in name else f"{scheme}://{name.lstrip(chr(47))}" for name in files)


class StoppedEarlyError(OSError):
    """A store sent less than requested, without an error."""


def _opened(url: str) -> tuple[Any, str]:
    """The file system of a URL, and the path in it."""
    scheme = url.partition("://")[0].lower()
    with extra_named():
        from fsspec import core

        if scheme == "s3":
            import s3fs  # noqa: F401  # if it is missing, this import raises the clear error

    def ask() -> tuple[Any, str]:
        fs, place = core.url_to_fs(url, **_OPTIONS.get(scheme, {}))
        if scheme == "s3":
            fs.retries = 1  # `requested` repeats requests and reports it
        return fs, place

    try:
        return requested(ask, shown(url), url, attempts=1)
    except ImportError as error:
        raise StoreError(f"{shown(url)}: {error}") from error


#: Storage options of file systems: no reading ahead, no cached listings, and time limits on every request.
_OPTIONS: dict[str, dict[str, Any]] = {
    "s3": {
        "default_cache_type": "none",
        "use_listings_cache": False,
        "config_kwargs": {"connect_timeout": 10, "read_timeout": 60, "retries": {"total_max_attempts": 1}},
    },
    "http": {"use_listings_cache": False},
    "https": {"use_listings_cache": False},
}


def _info(url: str) -> dict[str, Any]:
    fs, place = _opened(url)

    def ask() -> dict[str, Any]:
        return dict(fs.info(place))

    return requested(ask, shown(url), url)


def _local_ranges(path: Path, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
    with open(path, "rb") as stream:
        parts = []
        for start, end in ranges:
            stream.seek(start)
            parts.append(stream.read(end - start))
            count_bytes(len(parts[-1]))
    if any(len(part) < end - start for part, (start, end) in zip(parts, ranges, strict=True)):
        raise StoppedEarlyError(f"it is shorter than {max(end for _, end in ranges)} bytes")
    return parts


def _written_locally(path: Path, data: bytes) -> bool:
    try:
        if path.stat().st_size == len(data) and path.read_bytes() == data:
            return True
    except FileNotFoundError:
        path.parent.mkdir(parents=True, exist_ok=True)
    try:
        write_atomically(path, data)
    except FileFormatError as error:
        raise (error.__cause__ or error) from None  # the caller writes the message
    return False
