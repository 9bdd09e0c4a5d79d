"""Work in many processes, with progress."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

Result = TypeVar("Result")


def in_processes(
    function: Callable[..., Result], calls: Sequence[tuple[Any, ...]], workers: int | None, label: str
) -> list[Result]:
    """``function(*call)`` of every call, in their order whatever the number of processes; it is pickled.

    Parameters
    ----------
    workers : int or None
        Processes; None: as many as there are cores; 1: none but this one.
    label : str
        What the progress bar says.
    """
    columns = (TextColumn(label), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    results: list[Any] = [None] * len(calls)
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task(label, total=len(calls))
        if workers == 1 or len(calls) == 1:
            for place, call in enumerate(calls):
                results[place] = function(*call)
                progress.advance(task)
            return results
        with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
            places = {pool.submit(function, *call): place for place, call in enumerate(calls)}
            try:
                for future in as_completed(places):
                    results[places[future]] = future.result()
                    progress.advance(task)
            finally:
                pool.shutdown(cancel_futures=True)  # an error is shown now, not after all other calls
    return results
