"""Files in object stores and on disks with the same functions: a URL of fsspec (s3, gs, http, ...) or a path.

Paths and ``file://`` need no library. Every error names the store and the request, without credentials: a `StoreError`
if the fault is permanent, a `StoreInterruptedError` (an OSError) after several attempts if it may work later. Bytes
from stores are counted. One request writes an object. File systems find credentials in the usual places:
environment, configuration files, roles.
"""

from __future__ import annotations

import asyncio
import errno
import glob
import os
import random
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote, quote_plus, unquote, unquote_plus, urlsplit

from gtsam_rwhec.errors import FileFormatError, StoreError, StoreInterruptedError
from gtsam_rwhec.files.optional_packages import extra_named
from gtsam_rwhec.files.whole_files import checked_path, write_atomically

#: This text replaces a secret.
HIDDEN = "***"
#: Names of options, parameters of a query and variables of the environment whose values are secret.
_SECRET_NAME = re.compile(r"key|secret|token|passw|pwd|credential|signature|(^|[-_.])sig$|auth|sas|account|user", re.I)
#: Shorter values are not hidden: "1" is in every message.
_SHORTEST = 4
_USER_INFO = re.compile(r"(?<=://)[^/\s?#]*@")
_QUERY = re.compile(r"(\w[\w+.-]*://[^\s?#'\"]*)[?#][^\s'\">)\]]*")
_NAMED = re.compile(
    r"(?i)([\w.-]*(?:secret|token|passw(?:or)?d|pwd|credential|signature|api[-_]?key|access[-_]?key(?:[-_]?id)?"
    r"|authorization)[\w.-]*['\"]?\s*[=:]\s*)((?:bearer|basic|aws4-hmac-sha256)\s+)?(['\"]?)[^\s'\",;&}\])]+"
)
_ACCESS_KEY = re.compile(r"\b(?:AKIA|ASIA)[0-9A-Z]{12,}\b")
_SCHEME = re.compile(r"^[a-zA-Z][\w+.-]*://")
#: Names of a query's parameters that are not secret.
_PLAIN_PARAMETER = re.compile(r"(?i)(response-|x-amz-(algorithm|date|expires|signedheaders)|version)")


def shown(url: str) -> str:
    """A URL for messages: without user, password, query and fragment."""
    if not _SCHEME.match(url):
        return url
    plain = _USER_INFO.sub("", url, count=1)
    place, mark, _ = plain.partition("?")
    # Only http has queries: other stores have question marks in patterns and names.
    return place + "?..." if mark and url.lower().startswith("http") else plain


def without_secrets(text: str, url: str = "") -> str:
    """A library's message, or any `text` that may quote one, with `HIDDEN` in place of what is secret or looks so.

    Of `url`, user, password and query are secret.
    """
    known = {*_of_url(url), *_of_environment()}
    forms = {form for one in known for form in (one, quote(one, safe=""), quote_plus(one), repr(one)[1:-1])}
    for secret in sorted((form for form in forms if len(form) >= _SHORTEST), key=len, reverse=True):
        text = text.replace(secret, HIDDEN)
    text = _USER_INFO.sub("", text)
    text = _QUERY.sub(rf"\1?{HIDDEN}", text)
    text = _NAMED.sub(rf"\1\3{HIDDEN}", text)
    return _ACCESS_KEY.sub(HIDDEN, text)


def _of_url(url: str) -> Iterator[str]:
    if not _SCHEME.match(url):
        return
    found = _USER_INFO.search(url)
    if found is not None:
        _, _, password = found[0][:-1].partition(":")
        yield from {found[0][:-1], password, unquote(password)}
    if url.lower().startswith("http"):
        _, _, query = url.partition("?")
        for part in query.split("#")[0].split("&"):
            name, _, value = part.partition("=")
            if not _PLAIN_PARAMETER.match(name):
                yield from {value, unquote_plus(value)}


def _of_environment() -> Iterator[str]:
    for name, value in os.environ.items():
        if name.startswith(("AWS_", "AZURE_", "GOOGLE_", "GCS_", "FSSPEC_")) and _SECRET_NAME.search(name):
            yield value


#: The most attempts of one request; then the store counts as lost.
ATTEMPTS = 4
#: Seconds before the second attempt; each further wait is twice as long. A random part of up to half is added.
PAUSE_S = 0.25
#: Kinds of errors, by words in the codes and class names of stores' libraries. Only passing ones are tried again.
_REFUSED = (
    "accessdenied", "invalidaccesskeyid", "signaturedoesnotmatch", "expiredtoken", "invalidtoken", "forbidden",
    "unauthorized", "nocredentials", "partialcredentials", "credentialretrieval", "unable to locate credentials",
    "authorizationheadermalformed", "anonymous caller", "permission", "tokenrefresh", "requesttimetooskewed",
)  # fmt: skip
_ABSENT = (
    "nosuchbucket",
    "nosuchkey",
    "not found",
    "notfound",
    "no such",
    "bucket does not exist",
    "invalidbucketname",
)
_PASSING = (
    "timeout", "timed out", "slowdown", "slow down", "throttl", "internalerror", "serviceunavailable", "connection",
    "disconnected", "payload", "incompleteread", "requesttimeout", "reset by peer", "service unavailable",
    "bad gateway", "too many requests", "ssl", "temporarily", "broken pipe", "endpoint url", "httpclient",
)  # fmt: skip
#: Errors of disks for which a second attempt does not help.
_OF_DISKS = {errno.ENOSPC, errno.EROFS, errno.EISDIR, errno.ENOTDIR, errno.ENAMETOOLONG, errno.EDQUOT}

Answer = TypeVar("Answer")


def requested(
    ask: Callable[[], Answer],
    what: str,
    url: str,
    how_far: Callable[[], str] | None = None,
    attempts: int | None = None,
) -> Answer:
    """The value that `ask` returns. `ask` is called again after a failure, and continues if it can.

    For messages: `what` is asked for, in words without credentials; secrets of `url` are hidden in libraries'
    messages; `how_far` gives how much has arrived. Raises StoreError if the store refuses or the file is missing,
    StoreInterruptedError if all attempts (by default `ATTEMPTS`) broke off.
    """
    most = ATTEMPTS if attempts is None else attempts
    for attempt in range(1, most + 1):
        try:
            return ask()
        except (StoreError, ImportError, MemoryError):
            raise
        except Exception as error:  # noqa: BLE001  (stores' libraries have errors of many roots; none is swallowed)
            fault = _fault(error, what, url)
            if fault is not None:
                raise fault from None  # the library's own error may repeat credentials
            if attempt == most:
                said = without_secrets(_words(error), url)
                times = f"{most} times" if most > 1 else "once"
                came = f" {how_far()}." if how_far is not None else ""
                raise StoreInterruptedError(
                    f"{what}: the store broke off or did not answer, {times}, at last: {said}.{came} Try again "
                    "when it answers; nothing that is done is lost."
                ) from None
            time.sleep(PAUSE_S * 2 ** (attempt - 1) * random.uniform(1.0, 1.5))
    raise AssertionError("not reached")


def _fault(error: Exception, what: str, url: str) -> StoreError | None:
    """The error if it is permanent; None if the same request may work later."""
    words = _words(error)
    said = without_secrets(words, url)
    # Names in the URL could look like words of the error.
    names = [name for name in url.lower().replace("?", "/").split("/") if name]
    text = f"{type(error).__name__} {_code(error)} {words}".lower()
    for name in sorted(names, key=len, reverse=True):
        text = text.replace(name, "")
    status = _status(error)
    if isinstance(error, PermissionError) or status in (401, 403) or any(word in text for word in _REFUSED):
        if "://" not in url:
            return StoreError(f"{what}: no right to it ({said}).")
        return StoreError(
            f"{what}: refused ({said}). Check the rights and the credentials: they come from the environment, or "
            "from the store's own configuration files."
        )
    if status is None and "://" in url and _is_of_connection(error):  # fsspec reports it as a missing file
        return None
    if isinstance(error, FileNotFoundError) or status in (404, 410) or any(word in text for word in _ABSENT):
        return StoreError(f"{what}: it is not there ({said}).")
    if isinstance(error, OSError) and error.errno in _OF_DISKS:
        return StoreError(f"{what}: {error.strerror}.")
    if isinstance(error, OSError | EOFError | asyncio.TimeoutError) or (status is not None and status >= 429):
        return None
    if any(word in text for word in _PASSING):
        return None
    return StoreError(f"{what}: {said}.")


def _is_of_connection(error: BaseException) -> bool:
    """Whether the store was not reached: the error, or one of its causes, is one of the connection."""
    cause = error.__cause__ or error.__context__
    of_way = "ClientConnect" in type(error).__name__ or isinstance(error, ConnectionError | asyncio.TimeoutError)
    return of_way or (cause is not None and _is_of_connection(cause))


def _words(error: BaseException) -> str:
    """The message of an error and of its causes."""
    said = str(error).strip() or type(error).__name__
    if isinstance(error, OSError) and error.strerror and error.filename:
        return error.strerror  # the message names the file already
    cause = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
    return said if cause is None or str(cause) in said else f"{said} (from {type(cause).__name__})"


def _code(error: BaseException | None) -> str:
    """The store's own code of an error, such as ``InvalidAccessKeyId``; empty without one."""
    while error is not None:
        answer = getattr(error, "response", None)
        if isinstance(answer, dict):
            return str(answer.get("Error", {}).get("Code", ""))
        error = error.__cause__
    return ""


def _status(error: Exception) -> int | None:
    """The HTTP status, if the error has one."""
    status = getattr(error, "status", None)
    if not isinstance(status, int):
        answer = getattr(error, "response", None)
        status = answer.get("ResponseMetadata", {}).get("HTTPStatusCode") if isinstance(answer, dict) else None
    return status if isinstance(status, int) else None


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
