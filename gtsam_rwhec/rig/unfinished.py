"""Lines of a rig file that are marked TODO: ``init`` guessed their values, and a person must state them."""

from __future__ import annotations

import re
from dataclasses import dataclass

#: The mark in a comment.
TODO = "TODO"
#: A comment with the mark: # begins a comment at the start of a line or after a blank.
_COMMENT = re.compile(rf"(?:^|\s)#(?P<comment>.*\b{TODO}\b.*)$")
#: The key of a line.
_KEY = re.compile(r"\s*(?P<key>[^\s#:][^:]*):(?:\s|$)")


@dataclass(frozen=True)
class TodoLine:
    """A line that a person must complete; ``str()`` says which, and what is to be done.

    Attributes
    ----------
    number : int
        From 1 on. A comment on lines of its own belongs to the line after it.
    key : str
        The line's key; empty where it has none.
    words : str
        The comment from the mark on.
    """

    number: int
    key: str
    words: str

    def __str__(self) -> str:
        return f"line {self.number}{f', {self.key}' if self.key else ''}: {self.words}"


def todo_lines(text: str) -> tuple[TodoLine, ...]:
    """The lines of a rig file's text that are marked TODO. Comments at its head are about the whole file."""
    found = []
    waiting: list[str] = []
    is_head = True
    for number, line in enumerate(text.splitlines(), 1):
        bare = line.strip()
        if bare.startswith("#"):
            words = bare.lstrip("# ")
            if not is_head and (waiting or TODO in words.split()):
                waiting.append(words)
            continue
        if not bare:
            continue
        is_head = False
        match = _COMMENT.search(line)
        said = [*waiting, match["comment"]] if match else waiting
        waiting = []
        if said:
            key = _KEY.match(line)
            words = " ".join(" ".join(said).split())
            found.append(TodoLine(number, key["key"] if key else "", words[words.index(TODO) :]))
    return tuple(found)
