"""Shows the progress of a long calculation on standard error: stage, share done, time so far, time left."""

from __future__ import annotations

import threading
import time
from types import TracebackType
from typing import Self

from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, ProgressColumn, SpinnerColumn, Task, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from gtsam_rwhec.files.progress import Counted, Pace, Remark, duration, share
from gtsam_rwhec.files.terminal import SafeConsole
from gtsam_rwhec.files.terminal_text import shown

#: Seconds before anything is shown, and between lines in a log.
INTERVAL_S = 1.0
#: Seconds between lines in a log while a stage continues.
SILENCE_S = 10.0
#: A stage is shown with at most this many characters.
LONGEST_STAGE = 200
#: And a remark, of which nothing is to be lost.
LONGEST_REMARK = 2000
#: The length of the progress bar, characters.
BAR = 24


class StageDisplay:
    """A context that shows stages: on a terminal with a spinner, and a bar where a stage counts; in a log with lines.

    A log has a line for each longer stage, and one every ten seconds while the stage continues, with the share done and
    about how long it still takes.

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
            _OfCounted(),
            TextColumn("{task.fields[pace]}", markup=False),
            TimeElapsedColumn(),
            console=self._console,
            transient=True,
        )
        self._task = self._progress.add_task("", total=None, pace="")
        self._stage = ""
        self._pace: tuple[str, Pace] = ("", Pace(0.0, 0))
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
        """Show a stage that begins, or the count of the current stage; a remark gets a line that stays."""
        if isinstance(stage, Remark):
            self._console.print(shown(stage, LONGEST_REMARK), markup=False, soft_wrap=True)
            return
        if isinstance(stage, Counted):
            if self._pace[0] != stage.what:
                self._pace = stage.what, Pace(time.monotonic(), stage.done)
            self._stage = Counted(shown(stage.what, LONGEST_STAGE), stage.done, stage.total)
        else:
            self._pace = "", Pace(0.0, 0)
            self._stage = shown(stage, LONGEST_STAGE)
        counted = self._stage if isinstance(self._stage, Counted) else None
        self._progress.update(
            self._task,
            description=self._stage,
            total=None if counted is None else max(counted.total, 1),
            completed=0 if counted is None else counted.done,
            pace=self._pace_in_words(),
        )

    def _pace_in_words(self) -> str:
        """Rate and time left of a stage with a count, for a terminal."""
        stage, now_s = self._stage, time.monotonic()
        if not isinstance(stage, Counted):
            return ""
        rate, left_s = self._pace[1].rate(stage, now_s), self._pace[1].left_s(stage, now_s)
        if rate is None or left_s is None:
            return ""
        return f"{rate:.{0 if rate >= 10.0 else 1}f}/s, about {duration(left_s)} left"

    def _line(self, stage: str, *, is_still: bool) -> str:
        """The words of a line in a log."""
        if isinstance(stage, Counted):
            left_s = self._pace[1].left_s(stage, time.monotonic())
            left = "" if left_s is None else f", about {duration(left_s)} left"
            return f"{stage} ({100.0 * share(stage):.0f} %){left}"
        return f"still {stage}" if is_still else stage

    def _tick(self) -> None:
        said, said_s = "", self._begun_s
        while not self._finished.wait(INTERVAL_S):
            now_s = time.monotonic()
            stage = self._stage
            name = stage.what if isinstance(stage, Counted) else stage
            if self._console.is_interactive:
                self._progress.start()  # does nothing when it runs already
            elif name != said or now_s - said_s > SILENCE_S:
                line = self._line(stage, is_still=name == said)
                said, said_s = name, now_s
                self._console.print(f"[{now_s - self._begun_s:.0f} s] {line}", markup=False, soft_wrap=True)


class _OfCounted(ProgressColumn):
    """A bar and a share for a stage that counts; nothing for another one."""

    _bar = BarColumn(bar_width=BAR)

    def render(self, task: Task) -> RenderableType:
        """The bar with the share that is done."""
        if task.total is None:
            return Text("")
        row = Table.grid(padding=(0, 1))
        row.add_row(self._bar.render(task), f"{task.percentage:.0f} %")
        return row
