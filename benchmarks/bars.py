"""What the benchmarks share: rows with bars, options, processes, shares with intervals, times of calls in turns.

Whoever imports this module also finds the helpers of the tests, whose simulated rigs and logs the benchmarks share.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.special import betaincinv

TESTS = Path(__file__).resolve().parents[1] / "tests"
sys.path += [str(TESTS), *sorted(str(folder) for folder in TESTS.iterdir() if folder.is_dir())]
#: Data that the repository does not contain.
SHARED = Path(os.environ.get("GTSAM_RWHEC_DATA", TESTS.parents[1] / "shared" / "data"))
Result = TypeVar("Result")


@dataclass(frozen=True)
class Row:
    """One line of the table; ``met`` is None for figures that have no bar."""

    what: str
    figure: str
    bar: str = ""
    met: bool | None = None


def at_most(what: str, value: float, most: float | None, unit: str = "", spec: str = ".3g", more: str = "") -> Row:
    """The row of a value that is at most its bar; without a bar, if there is none."""
    figure = f"{value:{spec}}{unit}{more}"
    return Row(what, figure) if most is None else Row(what, figure, f"<= {most:g}{unit}", bool(value <= most))


def benchmark_parser(description: str | None) -> argparse.ArgumentParser:
    """A parser that prints a script's docstring as it stands."""
    return argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)


def given_options(**defaults: Any) -> argparse.Namespace:
    """The command line's values of options that are stated by their defaults, and described in the script's docstring.

    False makes a flag, a tuple one or more of these words, a type an option without a default, any other value one of
    its own type.
    """
    parser = benchmark_parser(sys.modules["__main__"].__doc__)
    for name, default in defaults.items():
        kind: dict[str, Any] = {"default": default, "type": type(default), "help": "(default: %(default)s)"}
        if default is False:
            kind = {"action": "store_true"}
        elif isinstance(default, tuple):
            kind = {"default": default, "nargs": "+", "choices": default, "metavar": "WORD"}
        elif isinstance(default, type):
            kind = {"type": default}
        parser.add_argument(f"--{name.replace('_', '-')}", **kind)
    return parser.parse_args()


def run_script(title: str, rows: Callable[..., list[Row]], /, **defaults: Any) -> NoReturn:
    """Print the table of ``rows`` with the given options; exit with 1 if a bar is missed. The title may name one."""
    given = vars(given_options(**defaults))
    sys.exit(print_rows(title.format(**given), rows(**given)))


def wide_console() -> Console:
    """The console; in a pipe, whose width is unknown, nothing of a table may be cut."""
    console = Console()
    return console if console.is_terminal else Console(width=180)


def print_rows(title: str, rows: list[Row]) -> int:
    """Print the rows as a table; 1 if a bar is missed, else 0: a script's exit status."""
    table = Table(title=title, title_justify="left")
    table.add_column("what", overflow="fold")
    table.add_column("figure", justify="right", overflow="fold")
    table.add_column("bar", justify="right", overflow="fold")
    table.add_column("met", justify="center", no_wrap=True)
    for row in rows:
        verdict = {None: "", True: "[green]yes[/green]", False: "[bold red]NO[/bold red]"}[row.met]
        table.add_row(row.what, row.figure, row.bar, verdict)
    wide_console().print(table)
    return int(any(row.met is False for row in rows))


def each_done(
    function: Callable[..., Result], calls: Collection[tuple[Any, ...]], workers: int, what: str
) -> Iterator[tuple[tuple[Any, ...], Result]]:
    """The calls' arguments and results as they end, in processes if there are several workers; with a progress bar."""
    console = Console(stderr=True)
    if workers == 1:
        yield from ((call, function(*call)) for call in track(calls, what, console=console))
        return
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        waiting = {pool.submit(function, *call): call for call in calls}
        try:
            for future in track(as_completed(waiting), what, total=len(waiting), console=console):
                yield waiting[future], future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def in_order(
    function: Callable[..., Result], calls: Collection[tuple[Any, ...]], workers: int, what: str
) -> list[Result]:
    """The results in the order of the calls."""
    done = dict(each_done(function, calls, workers, what))
    return [done[call] for call in calls]


def alone(function: Callable[..., Result], *arguments: Any) -> Result:
    """The result of a call in a process of its own."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def runs_of_kinds(
    one: Callable[..., Result], kinds: Iterable[str], runs: int, workers: int, seed: int = 0, only: str = ""
) -> Iterator[tuple[str, list[Result]]]:
    """Each kind whose name has the words ``only``, with ``one(kind, seed)`` of so many seeds."""
    calls = [(name, seed + i) for name in kinds if only in name for i in range(runs)]
    done = in_order(one, calls, workers, "runs")
    yield from ((calls[i][0], done[i : i + runs]) for i in range(0, len(calls), runs))


def kept_lines(keep: Path | None) -> list[dict[str, Any]]:
    """The runs that a file of JSON lines has."""
    return [json.loads(line) for line in keep.read_text().splitlines()] if keep is not None and keep.exists() else []


def keep_line(keep: Path | None, one: dict[str, Any]) -> None:
    """Add a run to the file."""
    if keep is not None:
        keep.parent.mkdir(parents=True, exist_ok=True)
        with keep.open("a") as file:
            file.write(json.dumps(one) + "\n")


@dataclass(frozen=True)
class Share:
    """``held`` of ``runs``, with the interval that their number leaves."""

    held: int
    runs: int

    @staticmethod
    def of(outcomes: list[bool]) -> Share:
        """The share of those that are true."""
        return Share(sum(outcomes), len(outcomes))

    @property
    def value(self) -> float:
        """The share, between 0 and 1; nan of no runs."""
        return self.held / self.runs if self.runs else float("nan")

    def interval(self, confidence: float = 0.99) -> tuple[float, float]:
        """Clopper and Pearson's: where the true share is, whatever it is, with at least this probability."""
        if not self.runs:
            return 0.0, 1.0
        held, missed, tail = self.held, self.runs - self.held, (1.0 - confidence) / 2.0
        low = betaincinv(held, missed + 1, tail) if held else 0.0
        high = betaincinv(held + 1, missed, 1.0 - tail) if missed else 1.0
        return float(low), float(high)

    def meets(self, least: float, most: float, confidence: float = 0.99) -> bool:
        """Whether the interval and [least, most] have anything in common."""
        low, high = self.interval(confidence)
        return self.runs > 0 and low <= most and high >= least

    def __str__(self) -> str:
        low, high = self.interval()
        return f"{100 * self.value:.1f} % of {self.runs} [{100 * low:.1f}, {100 * high:.1f}]"


@dataclass(frozen=True)
class Times:
    """Seconds of each repetition, by call: arrays (repetitions,)."""

    of: dict[str, NDArray[np.float64]]

    def median(self, name: str) -> float:
        """Median seconds of one call."""
        return float(np.median(self.of[name]))

    def ratio(self, name: str, peer: str) -> float:
        """Median over the repetitions of one call's time over its peer's in the same repetition."""
        return float(np.median(self.of[name] / self.of[peer]))


def interleaved(repetitions: int, calls: dict[str, Callable[[], object]]) -> Times:
    """Time calls in turns, so that what else the machine does falls on all alike; the first round does not count."""
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for repetition in range(repetitions + 1):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            elapsed = time.perf_counter() - start
            if repetition:
                seconds[name].append(elapsed)
    return Times({name: np.array(values) for name, values in seconds.items()})


def in_words(seconds: float) -> str:
    """A duration with its unit: "3.42 ms"."""
    if seconds < 1e-3:
        return f"{1e6 * seconds:.0f} us"
    return f"{1e3 * seconds:.3g} ms" if seconds < 1.0 else f"{seconds:.3g} s"


def utias_folder() -> Path:
    """The RWHEC paper's real dataset: the folder that GTSAM_RWHEC_UTIAS names, or the one beside the checkout."""
    folder = Path(os.environ.get("GTSAM_RWHEC_UTIAS", SHARED / "utias"))
    if not folder.is_dir():
        raise SystemExit(f"{folder} does not exist: run `gtsam-rwhec fetch utias DEST`, set GTSAM_RWHEC_UTIAS=DEST")
    return folder
