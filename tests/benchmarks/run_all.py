"""Every benchmark in one table.

    python tests/benchmarks/run_all.py [--no-scs] [--plot FOLDER] [--outlier-seeds 40] [--coverage-runs 1000]
                                       [--tables-runs 1000] [--lom-runs 300] [--corrupted-seeds 8]

Takes an hour or two: SCS a minute, outliers ten, coverage half an hour, the paper's tables the rest (these three in
processes of their own, with their own tables); 0 for any of the numbers leaves that part out. The noise sweep is
examples/noise_sweep.py. Exits with 1 if a bar is missed. Needs opencv-python-headless<5, scs and matplotlib.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

import camera_logs
import corrupted_detections
import edge_summaries
import hand_eye
import many_frames
import million_measurements
import one_pair
import opencv_hand_eye
import outliers
import real_dataset
import single_pairs
import start_time
import vision_rate
import world_origin
from bars import Row, print_rows


def main() -> int:
    """Run them one after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--no-scs", action="store_true", help="leave out the rows that need SCS")
    parser.add_argument("--plot", type=Path, metavar="FOLDER", help="write the benchmarks' plots there")
    parser.add_argument("--outlier-seeds", type=int, default=40, help="of each kind of outliers; 0: none")
    parser.add_argument("--tables-runs", type=int, default=1000, help="of each experiment of Tables 2-5; 0: none")
    parser.add_argument("--lom-runs", type=int, default=300, help="of each row LOM of Tables 2-5; 0: none")
    parser.add_argument("--coverage-runs", type=int, default=1000, help="of each case of coverage; 0: none")
    parser.add_argument("--corrupted-seeds", type=int, default=8, help="of wrong detections; 0: none")
    arguments = parser.parse_args()
    parts = {
        "start": lambda: start_time.rows(repetitions=15),
        "answers on the real dataset": real_dataset.answers,
        "real dataset against SCS": lambda: [] if arguments.no_scs else real_dataset.speed(repetitions=15),
        "the pairs alone": lambda: single_pairs.rows_of("known", 100) + single_pairs.rows_of("shared", 100),
        "one X, one Y, against OpenCV": lambda: one_pair.rows(repetitions=51),
        "AX = XB by dual quaternions": lambda: hand_eye.rows(2450, starts=4, repetitions=5),
        "OpenCV's hand-eye methods": lambda: opencv_hand_eye.rows(repetitions=3, problems=200),
        "a million measurements": lambda: million_measurements.rows(1_000_000, repetitions=9),
        "many frames": lambda: many_frames.rows(repetitions=7),
        "world origin": world_origin.rows,
        "outliers": lambda: outliers.rows(arguments.outlier_seeds, arguments.plot) if arguments.outlier_seeds else [],
        "edge summaries in GTSAM": lambda: edge_summaries.rows(repetitions=5),
        "from camera images": camera_logs.rows,
        "images a second": lambda: vision_rate.rows(repetitions=2),
        "wrong detections": lambda: (
            corrupted_detections.rows(arguments.corrupted_seeds) if arguments.corrupted_seeds else []
        ),
    }
    rows: list[Row] = []
    for name, make in parts.items():
        print(f"{name} ...", file=sys.stderr, flush=True)
        start = time.perf_counter()
        rows += make()
        print(f"    {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
    status = print_rows("What must be reached", rows)
    if arguments.plot is not None:
        print(f"Written to {many_frames.plot(arguments.plot, repetitions=5)}.")
    for name, runs in (
        ("coverage.py", arguments.coverage_runs),
        ("tables_2_to_5.py", arguments.tables_runs),
        ("method_tables.py", arguments.tables_runs),
        ("lom_tables.py", arguments.lom_runs),
    ):
        if runs:
            command = [sys.executable, str(Path(__file__).with_name(name)), "--runs", str(runs)]
            status = max(status, subprocess.run(command, check=False).returncode)
    return status


if __name__ == "__main__":
    raise SystemExit(main())
