"""The stages of a search: their names, reported as they begin, and their times."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from gtsam_rwhec.files.progress import Progress


@dataclass(frozen=True)
class Stages:
    """``with stages.of(name): ...`` calls ``progress`` with the name and adds the time to ``seconds``."""

    progress: Progress | None = None
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def of(self, name: str) -> Iterator[None]:
        """Report that a stage begins, and add its time."""
        if self.progress is not None:
            self.progress(name)
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
