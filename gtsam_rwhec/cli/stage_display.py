"""The progress of a long calculation: its stage and the time, on standard error."""

from __future__ import annotations

import threading
import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from gtsam_rwhec.files.terminal import SafeConsole
from gtsam_rwhec.files.terminal_text import shown

#: Seconds before anything is shown, and between lines in a log.
INTERVAL_S = 1.0
#: Seconds after which a log says that a stage goes on.
SILENCE_S = 10.0
#: A stage is shown with at most this many characters.
LONGEST_STAGE = 200


class StageDisplay:
    """A context that shows stages: with a spinner on a terminal, or with a line for each stage in a log.

    Examples
    --------
    >>> with StageDisplay() as stage:
    ...     stage("reading")
    """

    def __init__(self, console: Console | None = None) -> None:
        self._console = SafeConsole(stderr=True) if console is None else console
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            TimeElapsedColumn(),
            console=self._console,
            transient=True,
        )
        self._task = self._progress.add_task("")
        self._stage = ""
        self._finished = threading.Event()
        self._ticker = threading.Thread(target=self._tick, daemon=True)
        self._begun_s = time.monotonic()

    def __enter__(self) -> Self:
        self._ticker.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._finished.set()
        self._ticker.join()
        if self._console.is_interactive:
            self._progress.stop()

    def __call__(self, stage: str) -> None:
        """Show the stage that begins now."""
        self._stage = shown(stage, LONGEST_STAGE)
        self._progress.update(self._task, description=self._stage)

    def _tick(self) -> None:
        said, said_s = "", self._begun_s
        while not self._finished.wait(INTERVAL_S):
            now_s = time.monotonic()
            if self._console.is_interactive:
                self._progress.start()  # does nothing when it runs already
            elif self._stage != said or now_s - said_s > SILENCE_S:
                still = "still " if self._stage == said else ""
                said, said_s = self._stage, now_s
                self._console.print(f"[{now_s - self._begun_s:.0f} s] {still}{said}", markup=False, soft_wrap=True)
