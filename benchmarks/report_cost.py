"""What the report costs beyond the calibration: seconds of the processor, and megabytes.

    python benchmarks/report_cost.py [--profile]

Counted is all that is done for it: evidence, figures, page, and the import of what draws them, each report in a process
of its own. Every number of both pages is compared with the JSON beside them. ``--profile`` prints where the time goes.
"""

from __future__ import annotations

import cProfile
import json
import pstats
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bars import Row, benchmark_parser, print_rows, utias_folder
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


def measured(name: str, *, is_profiled: bool = False) -> dict[str, Any]:
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


def rows() -> list[Row]:
    """Time, size and numbers of both reports, each in a process of its own."""
    table = []
    for name in REPORTS:
        done = subprocess.run([sys.executable, __file__, "--of", name], check=True, capture_output=True, text=True)
        found = json.loads(done.stdout.splitlines()[-1])
        size, wrong = 1e-6 * found["bytes"], len(found["wrong"])
        table += [
            Row(f"{name}: s of a processor", f"{found['seconds']:.2f}", f"<= {SECONDS}", found["seconds"] <= SECONDS),
            Row(f"{name}: MB", f"{size:.2f}", f"<= {MEGABYTES}", size <= MEGABYTES),
            Row(f"{name}: numbers unlike the JSON's", f"{wrong} of {found['numbers']}", "0", wrong == 0),
        ]
    return table


def main() -> int:
    """Print the table."""
    parser = benchmark_parser(__doc__)
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("--of", choices=REPORTS, help="one report, as JSON")
    arguments = parser.parse_args()
    if arguments.of is not None:
        print(json.dumps(measured(arguments.of, is_profiled=arguments.profile)))
        return 0
    return print_rows("Report", rows())


if __name__ == "__main__":
    raise SystemExit(main())
