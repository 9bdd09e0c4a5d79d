"""Engines with a record around them: which task had which receipt, and how often each was begun and done."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from gtsam_rwhec.fleet.tasks import Engine, Failed, Receipt, Task


@dataclass
class Kept:
    """An engine that keeps its receipts with their tasks. With `told` it counts in a file what begins and ends."""

    engine: Engine
    told: Path | None = None
    receipts: list[tuple[Task, Receipt]] = field(default_factory=list)
    failures: list[Failed] = field(default_factory=list)

    def run(self, tasks: Iterable[Task]) -> Iterator[Receipt | Failed]:
        """As the engine does."""
        by_key = {task.key: task for task in tasks}
        counted = list(by_key.values())
        if self.told is not None:
            told = str(self.told)
            counted = [replace(t, function=noted, arguments=(told, t.key, t.function, *t.arguments)) for t in counted]
        for outcome in self.engine.run(counted):
            if isinstance(outcome, Receipt):
                self.receipts.append((by_key[outcome.key], outcome))
            else:
                self.failures.append(outcome)
            yield outcome

    def close(self) -> None:
        """Nothing: whoever made the engine closes it."""


def noted(told: str, key: str, function: object, *arguments: object) -> Receipt:
    """Carry out a task, and write when it begins and when it has done something."""
    note(told, f"begun {key}")
    assert callable(function)
    receipt = function(*arguments)
    assert isinstance(receipt, Receipt)
    note(told, f"{'found' if receipt.was_there else 'done'} {key}")
    return receipt


def note(told: str, words: str) -> None:
    """A line at the end of a file; short, so that lines of several processes do not mix."""
    descriptor = os.open(told, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    try:
        os.write(descriptor, f"{words}\n".encode())
    finally:
        os.close(descriptor)


def counts_of(told: Path) -> dict[str, Counter[str]]:
    """How often each task was begun, found and done, by word and key."""
    counts: dict[str, Counter[str]] = {"begun": Counter(), "found": Counter(), "done": Counter()}
    for line in told.read_text(encoding="utf-8").splitlines():
        word, key = line.split()
        counts[word][key] += 1
    return counts
