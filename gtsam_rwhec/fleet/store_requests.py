"""Requests to a store. They are repeated if this may help; messages about failures never have credentials."""

from __future__ import annotations

import asyncio
import errno
import os
import random
import re
import time
from collections.abc import Callable, Iterator
from typing import TypeVar
from urllib.parse import quote, quote_plus, unquote, unquote_plus

from gtsam_rwhec.errors import StoreError, StoreInterruptedError

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
    """`text` with `HIDDEN` in place of secrets and of words that look like secrets.

    Parameters
    ----------
    text
        A library's message, or any text that may quote it.
    url
        Its user, password and query are secret.
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
