"""Text that is safe on a terminal: a log may come from anyone, and a name in it could be a terminal command."""

from __future__ import annotations

#: A message has at most this many characters. Longer messages are cut in the middle.
LONGEST = 10_000


def printable(text: str, longest: int = LONGEST) -> str:
    r"""The text with unprintable characters escaped as in Python (``\x1b``), cut to ``longest``; lines stay."""
    if len(text) > longest:
        half = (longest - 20) // 2
        text = f"{text[:half]} [...] {text[len(text) - half :]}"
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)
