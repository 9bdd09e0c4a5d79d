"""Workers killed at random, the scheduler killed once, the run repeated: what is lost, done twice, or not the same.

    python benchmarks/fleet_kills.py [--robots 60] [--logs 5] [--every 3]

One run is left alone. Another one loses a worker (SIGKILL) every few seconds, and its scheduler when half of its tasks
are done; the same run is started again, with workers still dying, and goes on from what is on disk. Every task writes
when it begins and when it has done its work, in a file that no process owns.
"""

from __future__ import annotations

import hashlib
import os
import random
import signal
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import psutil
from bars import Row, run_script
from fleets import MadeFleet, write_fleet
from kept_outcomes import Kept, counts_of

from gtsam_rwhec import fleet
from gtsam_rwhec.errors import FleetError
from gtsam_rwhec.fleet.dask_engine import DaskEngine

#: Files below this hold measurements. Answers have seconds in them.
FOLDERS = ("partials",)


@contextmanager
def workers_dying(engine: DaskEngine, every_s: float, seed: int, deaths: list[int]) -> Iterator[None]:
    """Kill one of the engine's workers at random times, `every_s` seconds apart on average."""
    ended, chance = threading.Event(), random.Random(seed)

    def kill() -> None:
        while not ended.wait(every_s * chance.uniform(0.5, 1.5)):
            assert engine.cluster is not None
            with suppress(psutil.NoSuchProcess, ProcessLookupError):
                workers = [
                    one
                    for one in psutil.Process(engine.cluster.workers.pid).children()
                    if "resource_tracker" not in " ".join(one.cmdline())
                ]
                if workers:
                    victim = chance.choice(workers)
                    os.kill(victim.pid, signal.SIGKILL)
                    deaths.append(victim.pid)

    thread = threading.Thread(target=kill)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def killed_run(manifest: str, output: Path, every: float, seed: int, kill_at: float = np.inf) -> tuple[str, int, int]:
    """What it said, how many tasks and deaths of workers it had; the scheduler dies after ``kill_at`` tasks."""
    deaths: list[int] = []
    with DaskEngine(2, dashboard=False) as engine:
        engine.start()
        kept = Kept(engine, output / "told")

        def progress(stage: object) -> None:
            assert engine.cluster is not None
            if len(kept.receipts) >= kill_at:
                with suppress(ProcessLookupError):
                    engine.cluster.scheduler.kill()

        said = ""
        with workers_dying(engine, every, seed, deaths):
            try:
                done = fleet.run(fleet.read_manifest(manifest), str(output), engine=kept, progress=progress)
                said = "; ".join(row.failure for row in done.rows if row.failure)
            except FleetError as error:
                said = str(error)
        return said, len(kept.receipts), len(deaths)


def checksums(output: Path) -> dict[str, str]:
    """Of all files but receipts, which have times in them."""
    return {
        path.relative_to(output).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for folder in FOLDERS
        for path in sorted((output / folder).rglob("*"))
        if path.is_file() and not path.name.endswith((".receipt.json", ".part"))
    }


def rows(robots: int, logs: int, images: int, every: float, seed: int) -> list[Row]:
    """The table's rows."""
    with tempfile.TemporaryDirectory() as folder:
        return rows_in(Path(folder), write_fleet(Path(folder), robots, logs, images=images), every, seed)


def rows_in(folder: Path, made: MadeFleet, every: float, seed: int) -> list[Row]:
    """The rows of a fleet."""
    alone, output = folder / "alone", folder / "killed"
    output.mkdir()
    with DaskEngine(2, dashboard=False) as engine:
        kept = Kept(engine)
        fleet.run(fleet.read_manifest(made.manifest), str(alone), engine=kept)
    tasks = len(kept.receipts)
    said, first, deaths = killed_run(made.manifest, output, every, seed, sum(map(len, made.logs.values())) // 2)
    again, second, more = killed_run(made.manifest, output, every, seed + 1)
    counts = counts_of(output / "told")
    twice = sum(count - 1 for count in counts["done"].values())
    lost = sum(counts["begun"].values()) - sum(counts["done"].values()) - sum(counts["found"].values())
    is_same = checksums(alone) == checksums(output)
    # A receipt is written last: who has one is done. A worker may die between it and its note here.
    done, all_of_it = (len(list(each.rglob("*.receipt.json"))) for each in (output, alone))
    # Each death costs what its worker was at, and the scheduler's costs what the two were at.
    most = deaths + more + 2
    return [
        Row("files of measurements, bit for bit", "the same" if is_same else "others", "the same", is_same),
        Row("tasks done, of all", f"{done} of {all_of_it}", "all", done == all_of_it == tasks),
        Row("tasks done twice", f"{twice}", "0", twice == 0),
        Row("attempts lost with what was killed", f"{lost}", f"<= {most}", lost <= most),
        Row("  outcomes fetched anew: the work was on disk", f"{sum(counts['found'].values())}"),
        Row("workers killed: first run, second", f"{deaths}, {more}", "> 0", deaths + more > 0),
        Row("outcomes told: first run, second", f"{first}, {second}"),
        Row("the first run ended", said[:60], "Dask's scheduler is gone", "scheduler is gone" in said),
        Row("the second run's failures", again or "none", "none", not again),
    ]


if __name__ == "__main__":
    run_script("fleets: killed on the way", rows, robots=60, logs=5, images=40, every=3.0, seed=0)
