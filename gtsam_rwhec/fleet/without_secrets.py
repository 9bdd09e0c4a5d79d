"""Words without secrets: no password, key, token or signature of an object store gets into a message, a log or a file.

What a library says of an error may repeat the URL, a header or an option. So its words go through `without_secrets`,
which takes out what is known to be secret (of the URL, of the environment), and then whatever
looks like one.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from urllib.parse import quote, quote_plus, unquote, unquote_plus

#: What stands where a secret was.
HIDDEN = "***"
#: Names of options, parameters of a query and variables of the environment whose values are secret.
_SECRET_NAME = re.compile(r"key|secret|token|passw|pwd|credential|signature|(^|[-_.])sig$|auth|sas|account|user", re.I)
#: Shorter values are not looked for: "1" is in every message.
_SHORTEST = 4
_USER_INFO = re.compile(r"(?<=://)[^/\s?#]*@")
_QUERY = re.compile(r"(\w[\w+.-]*://[^\s?#'\"]*)[?#][^\s'\">)\]]*")
_NAMED = re.compile(
    r"(?i)([\w.-]*(?:secret|token|passw(?:or)?d|pwd|credential|signature|api[-_]?key|access[-_]?key(?:[-_]?id)?"
    r"|authorization)[\w.-]*['\"]?\s*[=:]\s*)((?:bearer|basic|aws4-hmac-sha256)\s+)?(['\"]?)[^\s'\",;&}\])]+"
)
_ACCESS_KEY = re.compile(r"\b(?:AKIA|ASIA)[0-9A-Z]{12,}\b")
_SCHEME = re.compile(r"^[a-zA-Z][\w+.-]*://")
#: The parameters of a query that are not secret have these names.
_PLAIN_PARAMETER = re.compile(r"(?i)(response-|x-amz-(algorithm|date|expires|signedheaders)|version)")


def shown(url: str) -> str:
    """A URL as messages show it: without user, password, query and fragment."""
    if not _SCHEME.match(url):
        return url
    plain = _USER_INFO.sub("", url, count=1)
    place, mark, _ = plain.partition("?")
    # A query is left out for http alone: other stores have question marks in patterns and names.
    return place + "?..." if mark and url.lower().startswith("http") else plain


def without_secrets(text: str, url: str = "") -> str:
    """`text` with `HIDDEN` in place of what is secret, or looks like it.

    Parameters
    ----------
    text
        What a library says, or anything that may repeat it.
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
