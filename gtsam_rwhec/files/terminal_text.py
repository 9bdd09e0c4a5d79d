"""Text for a terminal: logs are strangers' files, and names in them could be commands to it."""

from __future__ import annotations

#: Longer messages are cut in the middle.
LONGEST = 10_000


def printable(text: str, longest: int = LONGEST) -> str:
    r"""What cannot be printed as Python would escape it (``\x1b``), lines as they are; at most so many characters."""
    if len(text) > longest:
        half = (longest - 20) // 2
        text = f"{text[:half]} [...] {text[len(text) - half :]}"
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)
