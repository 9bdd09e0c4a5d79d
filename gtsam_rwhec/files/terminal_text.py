r"""Text that is safe on a terminal: a log may come from anyone, and a name in it could be a terminal command.

`say` prints a message, `printable` makes one fit to be printed. `shown` is for one name inside a message or a table,
`brief` for a value of any type. A name is a topic, a frame, a file, a tag's family: whatever was read. Each shows
unprintable characters as in Python (``\x1b``), and says how long the text was where it cuts.
"""

from __future__ import annotations

import re
import reprlib
import sys
from collections.abc import Sequence

#: A message has at most this many characters. Longer messages are cut in the middle.
LONGEST = 10_000
#: Only so many characters of a message are looked at.
MOST_READ = 1_000_000
#: A name in a message has at most this many characters.
LONGEST_NAME = 100
#: A path that a command has written has at most this many.
LONGEST_PATH = 300
#: A run of characters without a blank that is longer than this is cut, wherever it stands in a message.
LONGEST_WORD = 300
#: A line of a message has at most this many characters: some thirty lines of a terminal.
LONGEST_LINE = 2_500


def printable(text: str, longest: int = LONGEST) -> str:
    """A message, of at most about ``longest`` characters; its lines stay, and very long words and lines are cut."""
    return _cut("\n".join(map(_line, _cut(text, MOST_READ).split("\n"))), longest)


def shown(name: object, longest: int = LONGEST_NAME) -> str:
    """A name on one line, of at most about ``longest`` characters before they are escaped."""
    return _escaped(_cut(str(name), longest))


def shown_path(path: object) -> str:
    """A path that a command has written, on one line; few are so long that they are cut."""
    return shown(path, LONGEST_PATH)


def brief(value: object, longest: int = LONGEST_NAME) -> str:
    """A value of any type as Python writes it, on one line of at most about ``longest`` characters."""
    if isinstance(value, str | bytes):
        return shown(repr(value), longest)
    try:
        written = _REPR.repr(value) if isinstance(value, _CONTAINERS) else repr(value)
    except ValueError:  # Python does not write integers of thousands of digits
        return f"{type(value).__name__} of too many digits"
    return shown(" ".join(written.split()), longest)


def say(text: str, *, to_errors: bool = False) -> None:
    """Print a message on standard output, or on standard error, as `printable` gives it."""
    stream = sys.stderr if to_errors else sys.stdout
    stream.write(f"{printable(text)}\n")
    stream.flush()


def _line(line: str) -> str:
    return _cut(" ".join(_escaped(_cut(word, LONGEST_WORD)) for word in line.split(" ")), LONGEST_LINE)


def _cut(text: str, longest: int) -> str:
    """The text without its middle, and how many characters it had, if it is longer than ``longest``."""
    if len(text) <= longest:
        return text
    half = longest // 2
    return f"{text[:half]}[... {len(text)} characters ...]{text[len(text) - half :]}"


def _escaped(text: str) -> str:
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


_CONTAINERS = (dict, list, tuple, set, frozenset)
_REPR = reprlib.Repr()
_REPR.maxlist = _REPR.maxtuple = _REPR.maxdict = _REPR.maxset = _REPR.maxfrozenset = 10
_REPR.maxstring = _REPR.maxother = LONGEST_NAME


def natural_key(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """A sorting key that compares numbers inside names as numbers."""
    parts = [part for part in re.split(r"(\d+)", name) if part]
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts], name


def some(names: Sequence[str], most: int, between: str = ", ") -> str:
    """The first names, and how many more there are: "a, b and 3 more", or with semicolons "a; b; and 3 more"."""
    left = len(names) - most
    last = f"{' ' if between == ', ' else between}and {left} more" if left > 0 else ""
    return between.join(names[:most]) + last


def listed(words: Sequence[str]) -> str:
    """One word or more as people list them: "a", "a and b", "a, b and c"."""
    return " and ".join(filter(None, [", ".join(words[:-1]), words[-1]]))


def counted(number: int, word: str) -> str:
    """A number of things: "1 row", "3 rows"."""
    return f"{number} {word}{'s' * (number != 1)}"


def rounded(value: float, digits: int = 2) -> str:
    """A number with so many digits, and without an exponent from 0.0001 up to a million."""
    return f"{float(f'{value:.{digits}g}'):g}"
