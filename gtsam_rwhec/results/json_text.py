"""The text of a result file as JSON values. The file may come from anyone, so what it may cost is bounded here.

The budget grows with the file. It is checked before the text is parsed, by counting signs, and again while it is
parsed: no file makes more than a few times its own size of values.
"""

from __future__ import annotations

import json
from collections import Counter
from typing import Any, NoReturn

from gtsam_rwhec.files.terminal_text import brief, shown

#: Bytes of the largest file that is read. The joint covariance of 400 frames takes about half of it.
MOST_BYTES = 500_000_000
#: A file may have this many lists and objects, and this many numbers and texts, whatever its size.
FEW = 20_000
#: A larger file needs this many bytes for each of its lists and objects, brackets and names included,
BYTES_FOR_A_GROUP = 24
#: and this many for each of its values.
BYTES_FOR_A_VALUE = 12
#: Lists and objects inside one another. The deepest place of a result is at nine.
DEEPEST = 20
#: Digits of the longest integer.
MOST_DIGITS = 20
#: Entries of the longest list or object: of targets, sensors or pairs.
MOST_ROWS = 20_000
#: Values in a file without the matrices of the joint covariance. A thousand frames in ten thousand pairs have 300,000.
MOST_VALUES = 1_000_000


def parse_json(content: bytes) -> Any:
    """The values of a JSON text. Raises `ValueError`, in words, for a text that is no JSON or beyond the budget."""
    if not content.strip():
        raise ValueError("it is empty")
    if len(content) > MOST_BYTES:
        raise ValueError(f"it has {len(content)} bytes; at most {MOST_BYTES} are read")
    for number, what, size in (
        (content.count(b"[") + content.count(b"{"), "lists and objects", BYTES_FOR_A_GROUP),
        (content.count(b",") + content.count(b":"), "values", BYTES_FOR_A_VALUE),
    ):
        if number > max(FEW, len(content) // size):
            raise ValueError(f"it has {number} {what} in {len(content)} bytes, which no result has; is it damaged?")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"it is not text in UTF-8 (byte {error.start})") from error
    try:
        return json.loads(text, object_pairs_hook=_object, parse_int=_integer, parse_constant=_constant)
    except json.JSONDecodeError as error:
        raise ValueError(f"$: Invalid JSON: {error.msg} (line {error.lineno} column {error.colno})") from error
    except RecursionError:
        refuse_depth()


def refuse_depth() -> NoReturn:
    """Raise the error about lists and objects that are nested too deeply."""
    raise ValueError(f"more than {DEEPEST} lists and objects inside one another; is it damaged?") from None


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    fields = dict(pairs)
    if len(fields) != len(pairs):
        twice, _ = Counter(key for key, _ in pairs).most_common(1)[0]
        among = ", ".join(map(shown, list(fields)[:5]))
        raise ValueError(f"the key {brief(twice)} is there twice, in the object with the keys {among}; keep one")
    return fields


def _integer(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise ValueError(f"an integer of {len(digits)} digits; at most {MOST_DIGITS} are read")
    return int(digits)


def _constant(word: str) -> float:
    return float(word)  # `json_tree.from_json` refuses it with its place
