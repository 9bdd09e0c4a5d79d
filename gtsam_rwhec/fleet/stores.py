"""Files in object stores and on disks by one way: a URL of fsspec (s3, gs, http, ...) or a path.

Paths and ``file://`` need no library. Every error says what was asked of which store, without credentials: a
`StoreError` for what stays wrong, a `StoreInterruptedError` (an OSError) for what was tried several times and may work
later. Every byte that comes from a store is counted; an object is written by one request. File systems find credentials
where their users keep them: environment, configuration files, roles.
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

#: A file that is asked for whole, a manifest or a rig file, has at most this many bytes unless the caller says more.
MOST_BYTES = 1 << 32


@dataclass
class ByteCount:
    """Bytes that came from stores."""

    count: int = 0


_counting: ContextVar[tuple[ByteCount, ...]] = ContextVar("counting", default=())


@contextmanager
def counted_bytes() -> Iterator[ByteCount]:
    """Count in the block; blocks within blocks count each for themselves."""
    count = ByteCount()
    token = _counting.set((*_counting.get(), count))
    try:
        yield count
    finally:
        _counting.reset(token)


def count_bytes(count: int) -> None:
    """Tell all that count of bytes that came."""
    for one in _counting.get():
        one.count += count


def local_path(url: str) -> Path | None:
    """The path of a URL on this machine's disks; None if it is in a store."""
    if url.startswith(("file://", "local://")):
        return checked_path(unquote(urlsplit(url).path))
    return None if "://" in url else checked_path(url)


def exists(url: str) -> bool:
    """Whether a file is there."""
    path = local_path(url)
    if path is not None:
        return path.is_file()
    fs, place = _opened(url)

    def ask() -> bool:  # not fs.isfile, to which a store that refuses is one that has nothing
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
    """What changes when the file does: its ETag or checksum in the store, or else its size and time of change."""
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
    """A whole file; a StoreError where it has more than `most_bytes`."""
    size = size_of(url)
    if size > most_bytes:
        raise StoreError(f"{shown(url)} has {size} bytes, and {most_bytes} at most are expected; is it the right file?")
    return read_ranges(url, [(0, size)])[0]


def read_ranges(url: str, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
    """Parts of a file, each from a byte to before another; all that is asked for, or an error.

    Ranges of one call travel at the same time. A range that breaks off is asked for again from where it broke off.
    """
    path = local_path(url)
    if path is not None:
        return requested(lambda: _local_ranges(path, ranges), str(path), url)
    fs, place = _opened(url)
    parts: list[list[bytes]] = [[] for _ in ranges]

    def missing() -> list[tuple[int, int, int]]:
        """Number, first byte and end of what has not come."""
        came = ((i, a + sum(map(len, part)), b) for i, ((a, b), part) in enumerate(zip(ranges, parts, strict=True)))
        return [each for each in came if each[1] < each[2]]

    def ask() -> None:
        wanted = missing()
        if not wanted:
            return
        _, starts, ends = zip(*wanted, strict=True)
        # One connection for each range at most: `batch_size` of fsspec bounds them.
        answers = fs.cat_ranges([place] * len(wanted), list(starts), list(ends), on_error="return")
        fault: Exception | None = None
        for (number, start, end), answer in zip(wanted, answers, strict=True):
            if isinstance(answer, Exception):
                fault = answer
                continue
            count_bytes(len(answer))
            if len(answer) > end - start:  # the server knows no ranges, and sent all of the file
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
    """Write a file whole, unless it is there with the same bytes. Two who write at once leave one of the two, whole.

    On disks it is a temporary file that is renamed, with its folder made; in stores one request. It returns whether
    the file was there, and nothing was written.
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
            pass  # it is to be made
        fs.pipe_file(place, data)
        return False

    return bool(requested(put, f"{shown(url)}, which is to be written", url))


def listed(pattern: str) -> list[str]:
    """The URLs of files that a pattern with ``*``, ``?``, ``[]`` or ``**`` names, sorted; those of folders are not."""
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
    """A store sent less than was asked for, and no error."""


def _opened(url: str) -> tuple[Any, str]:
    """The file system of a URL, and the place in it."""
    scheme = url.partition("://")[0].lower()
    with extra_named():
        from fsspec import core

        if scheme == "s3":
            import s3fs  # noqa: F401  # for its own error, if it is missing

    def ask() -> tuple[Any, str]:
        fs, place = core.url_to_fs(url, **_OPTIONS.get(scheme, {}))
        if scheme == "s3":
            fs.retries = 1  # `requested` tries again, and says so
        return fs, place

    try:
        return requested(ask, shown(url), url, attempts=1)
    except ImportError as error:
        raise StoreError(f"{shown(url)}: {error}") from error


#: Storage options of file systems. No block is read ahead and no listing kept, and nobody is waited for for ever.
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
        raise (error.__cause__ or error) from None  # whoever asked says it in words
    return False
