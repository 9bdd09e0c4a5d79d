"""Many robots: two workers against one, what the engine itself costs, and what a log costs.

    python benchmarks/fleet_scale.py [--robots 200] [--logs 5] [--images 40]

The logs are MCAP with a driver's detections of 4 tags by a camera (tests/fleet/fleets.py). One worker and two go over
the same logs in one run of this script, each into an output of its own; the time is on the clock, from when the workers
have started until the last row. The engine's overhead is the share of all seconds of the processor (of scheduler,
nannies, workers and this process, their start included) that was not in tasks. Keep other programs off the machine.

With ``--folder`` logs and outputs stay there, and a run that was stopped goes on from what it has; what it had done
before is then missing in the times, so only counts are right.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
from bars import Row, run_script
from fleets import write_fleet
from kept_outcomes import Kept

from gtsam_rwhec import fleet
from gtsam_rwhec.fleet.dask_engine import DaskEngine
from gtsam_rwhec.fleet.tasks import Receipt, Task

MIB = 1 << 20
#: The model's cluster.
ROBOTS, WORKERS = 1000, 100


@dataclass(frozen=True)
class Measured:
    """One run: seconds on the clock, of all processes, of the start; those of processes for the start; receipts."""

    seconds: float
    cpu_s: float
    start_s: float
    start_cpu_s: float
    receipts: tuple[tuple[Task, Receipt], ...]

    @property
    def task_cpu_s(self) -> float:
        """Seconds of the processor in tasks."""
        return sum(receipt.cpu_s for _, receipt in self.receipts)

    def of(self, function: str) -> list[Receipt]:
        """The receipts of one kind of task."""
        return [receipt for task, receipt in self.receipts if task.function.__name__ == function]


def measured(manifest: str, output: Path, workers: int) -> Measured:
    """A run with so many workers."""
    own, begin, at_start = time.process_time(), time.monotonic(), []

    def all_cpu_s() -> float:
        return time.process_time() - own + sum(map(cpu_of, psutil.Process(os.getpid()).children(recursive=True)))

    def first_tasks(stage: object) -> None:
        """When each worker has done a task or two, all is imported: what was not in tasks is the start."""
        if not at_start and len(kept.receipts) >= 2 * workers:
            at_start.append(all_cpu_s() - sum(receipt.cpu_s for _, receipt in kept.receipts))

    with DaskEngine(workers, dashboard=False) as engine:
        engine.start()
        started = time.monotonic()
        kept = Kept(engine)
        done = fleet.run(fleet.read_manifest(manifest), str(output), engine=kept, progress=first_tasks)
        ended = time.monotonic()
        cpu_s = all_cpu_s()
    failed = [row.failure for row in done.rows if row.failure]
    if failed:
        sys.exit(f"{len(failed)} rows failed, the first: {failed[0]}")
    return Measured(ended - started, cpu_s, started - begin, sum(at_start), tuple(kept.receipts))


def cpu_of(process: psutil.Process) -> float:
    """Seconds of the processor of a process and of its children that ended."""
    times = process.cpu_times()
    return float(times.user + times.system + times.children_user + times.children_system)


def spread(values: list[float], unit: str, digits: int) -> str:
    """Median and largest."""
    return f"{np.median(values):.{digits}f} {unit} (largest {max(values):.{digits}f})"


def rows(robots: int, logs: int, images: int, folder: Path | None) -> list[Row]:
    """The table's rows."""
    with tempfile.TemporaryDirectory() as temporary:
        return rows_in(folder or Path(temporary), robots, logs, images)


def rows_in(folder: Path, robots: int, each: int, images: int) -> list[Row]:
    """The table's rows."""
    folder.mkdir(parents=True, exist_ok=True)
    made = write_fleet(folder, robots, each, images=images)
    size = sum(path.stat().st_size for paths in made.logs.values() for path in paths)
    one, two = (measured(made.manifest, folder / f"out_{workers}", workers) for workers in (1, 2))
    logs = two.of("map_log")
    speed_up, overhead = one.seconds / two.seconds, 1.0 - two.task_cpu_s / two.cpu_s
    found = [
        Row("speed-up of two workers over one", f"{speed_up:.2f}x", ">= 1.8x", speed_up >= 1.8),
        Row("  seconds on the clock: one worker, two", f"{one.seconds:.1f}, {two.seconds:.1f}"),
        Row("engine's overhead", f"{overhead:.1%}", "<= 10 %", overhead <= 0.1),
        Row("  seconds of the processor: tasks, all", f"{two.task_cpu_s:.1f}, {two.cpu_s:.1f}"),
        Row("  of these for the start: processes and imports", f"{two.start_cpu_s:.1f}"),
        Row("  with one worker", f"{1.0 - one.task_cpu_s / one.cpu_s:.1%}"),
        Row("  logs, their bytes, tasks", f"{len(logs)}, {size / MIB:.0f} MiB, {len(two.receipts)}"),
        Row("a log: seconds of the processor", spread([one.cpu_s for one in logs], "s", 3)),
        Row("  bytes read", spread([one.bytes_read / 1024 for one in logs], "KiB", 0)),
        Row("  peak memory of the worker", spread([one.peak_bytes / MIB for one in logs], "MiB", 0)),
    ]
    return found + modelled(two, len(two.receipts), robots, each)


def modelled(two: Measured, tasks: int, robots: int, logs: int) -> list[Row]:
    """Seconds on the clock of 1,000 robots on 100 workers, and what that assumes."""
    scale = ROBOTS / robots
    work_s = scale * two.task_cpu_s / WORKERS
    # All that is not in tasks grows with the tasks, but for the start; scheduler and client are one thread each.
    serial_s = scale * max(0.0, two.cpu_s - two.task_cpu_s - two.start_cpu_s)
    last_s = max(receipt.seconds for _, receipt in two.receipts) * 2
    total = two.start_s + max(work_s, serial_s) + last_s
    return [
        Row(f"model: {ROBOTS} robots, {logs} logs each, {WORKERS} workers", f"{total:.0f} s"),
        Row("  tasks' seconds over the workers", f"{work_s:.1f} s"),
        Row("  what one thread does (scheduler and client), beside it", f"{serial_s:.1f} s"),
        Row("  start, and the last robot's merge and solution", f"{two.start_s:.1f} s, {last_s:.1f} s"),
        Row("  assumes", f"these processors; {tasks} tasks here, times {scale:g}; a store that answers at once"),
    ]


if __name__ == "__main__":
    run_script("fleets: two workers", rows, robots=200, logs=5, images=40, folder=Path)
