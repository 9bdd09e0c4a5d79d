"""What the report costs beyond the calibration: seconds of the processor, and megabytes.

    python benchmarks/report_cost.py [--profile]

Counted is all that is done for it: evidence, figures, page, and the import of what draws them, each report in a process
of its own. Every number of both pages is compared with the JSON beside them. ``--profile`` prints where the time goes.
"""

from __future__ import annotations

import cProfile
import json
import pstats
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bars import Row, alone, at_most, run_script, utias_folder
from places import CELL
from shown_numbers import numbers_of, wrong_numbers

import gtsam_rwhec as rw
from gtsam_rwhec.runs import log_evidence, whole_runs

SECONDS, MEGABYTES = 3.0, 5.0


class Timed:
    """A function whose calls are counted in seconds of the processor."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function, self.seconds, self.profiler = function, 0.0, cProfile.Profile()
        self.is_profiled = False

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        start = time.process_time()
        if self.is_profiled:
            self.profiler.enable()
        try:
            return self.function(*arguments, **options)
        finally:
            self.profiler.disable()
            self.seconds += time.process_time() - start


def demo(folder: Path, timed: Timed) -> None:
    """Calibrate the demo's log; its report is timed."""
    timed.function = log_evidence.write_report
    whole_runs.write_report = timed  # type: ignore[assignment]
    rw.calibrate_log(CELL / "robot_cell.mcap", rw.rig.read_rig(CELL / "rig.yaml"), folder)


def real(folder: Path, timed: Timed) -> None:
    """Calibrate the real dataset, and write its report as the command does."""
    problem = rw.read_csv(utias_folder())
    calibration = rw.calibrate(problem)
    result = folder / "result.json"
    rw.write_calibration(calibration, result)

    def write() -> None:
        inputs = rw.results.Inputs(
            files=rw.results.input_files(sorted(utias_folder().glob("*.csv"))), versions=rw.results.versions()
        )
        evidence = rw.results.evidence_of(problem, calibration, inputs)
        rw.results.write_evidence(evidence, folder / "evidence.json", result)
        rw.report.write_html(result, folder / "report.html")

    timed.function = write
    timed()


REPORTS = {"demo": demo, "real": real}


def measured(name: str, is_profiled: bool) -> dict[str, Any]:
    """Time, size and numbers of a report."""
    timed = Timed(lambda: None)
    timed.is_profiled = is_profiled
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made) / "out"
        folder.mkdir()
        REPORTS[name](folder, timed)
        page = (folder / "report.html").read_text(encoding="utf-8")
        files = {each: json.loads((folder / each).read_bytes()) for each in ("result.json", "evidence.json")}
        size = (folder / "report.html").stat().st_size
    if is_profiled:
        pstats.Stats(timed.profiler).sort_stats("cumulative").print_stats(70)
    wrong = list(wrong_numbers(page, files))
    return {"seconds": timed.seconds, "bytes": size, "numbers": len(numbers_of(page)), "wrong": wrong}


def rows(profile: bool) -> list[Row]:
    """Time, size and numbers of both reports, each in a process of its own."""
    table = []
    for name in REPORTS:
        found = alone(measured, name, profile)
        wrong = len(found["wrong"])
        table += [
            at_most(f"{name}: s of a processor", found["seconds"], SECONDS, spec=".2f"),
            at_most(f"{name}: MB", 1e-6 * found["bytes"], MEGABYTES, spec=".2f"),
            Row(f"{name}: numbers unlike the JSON's", f"{wrong} of {found['numbers']}", "0", wrong == 0),
        ]
    return table


if __name__ == "__main__":
    run_script("Report", rows, profile=False)
