"""Every benchmark in one table.

    python benchmarks/run_all.py [--quick] [--store] [--no-scs] [--plot FOLDER]

Takes some hours: SCS a minute, outliers ten, few measurements and coverage half an hour each, wrong assumptions, split
halves, KinHEC and refinement from corners some hours together, the paper's tables the rest (these in processes of their
own, with their own tables). ``--quick`` takes a few minutes for a small part of each: it tells that all run and roughly
where they are, and its figures are kept apart from the others. The noise sweep is examples/noise_sweep.py. Exits with 1
if a bar is missed. Needs scs, kinhec, and opencv-python-headless<5 for what is compared with OpenCV 4's hand-eye calls:
`pip install '.[bench]'`; ``--quick`` leaves out what cannot run.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import busy_cores
import calibrate_times
import camera_logs
import certificate_cost
import corrupted_detections
import cv2
import edge_summaries
import few_measurements
import hand_eye
import large_graphs
import long_log
import many_frames
import million_measurements
import one_pair
import opencv_hand_eye
import outliers
import own_code_against_libraries
import real_dataset
import single_pairs
import start_time
import vision_rate
import workcell
import world_origin
from bars import Row, benchmark_parser, print_rows
from kinhec_sequences import STANDARD_SEED

#: Scripts with tables of their own whose rows have bars; the others compare theirs with the papers'.
WITH_BARS = (
    "coverage.py", "wrong_assumptions.py", "split_halves.py", "corner_coverage.py", "corner_wrong_intrinsics.py",
    "corner_undetermined.py", "corner_intrinsics.py", "corner_efficiency.py", "changes.py", "odometry_bounds.py",
    "odometry_planar.py",
)  # fmt: skip


@dataclass(frozen=True)
class Sizes:
    """How much of each benchmark is run."""

    scs_repetitions: int = 15
    pair_starts: int = 100
    pair_repetitions: int = 51
    hand_eye_problems: int = 2450
    opencv_problems: int = 200
    measurements: int = 1_000_000
    repetitions: int = 9
    few_repetitions: int = 5
    processes: int = 6
    few_counts: tuple[int, ...] = tuple(range(2, 41))
    few_trials: int = 2000
    outlier_seeds: int = 40
    log_poses: int = 1_000_000
    bare_loop_s: float = 45.0
    corrupted_seeds: int = 8
    log_messages: int = 20_000
    share_of_graphs: float = 1.0
    #: Of the scripts that print tables of their own, the number of --runs.
    runs: tuple[tuple[str, int], ...] = (
        ("coverage.py", 1000),
        ("tables_2_to_5.py", 1000),
        ("method_tables.py", 1000),
        ("lom_tables.py", 300),
        ("wrong_assumptions.py", 1000),
        ("split_halves.py", 300),
        ("corner_coverage.py", 2000),
        ("corner_wrong_intrinsics.py", 400),
        ("corner_undetermined.py", 60),
        ("corner_intrinsics.py", 200),
        ("corner_efficiency.py", 2000),
        ("changes.py", 1000),
        ("odometry_bounds.py", 40),
        ("odometry_planar.py", 200),
    )
    #: Of the neutral benchmark; none are run without its package.
    neutral_seeds: tuple[int, ...] = (STANDARD_SEED,)


FULL = Sizes()
QUICK = Sizes(
    scs_repetitions=3,
    pair_starts=3,
    pair_repetitions=7,
    hand_eye_problems=50,
    opencv_problems=5,
    measurements=100_000,
    repetitions=3,
    few_repetitions=1,
    processes=1,
    few_counts=(2, 3, 4, 5, 6, 8, 12, 20, 40),
    few_trials=60,
    outlier_seeds=1,
    log_poses=100_000,
    bare_loop_s=3.0,
    corrupted_seeds=1,
    log_messages=5_000,
    share_of_graphs=0.1,
    runs=(),
    neutral_seeds=(),
)


def parts(sizes: Sizes, plot: Path | None) -> dict[str, Callable[[], list[Row]]]:
    """By name, what makes the rows of each benchmark."""
    return {
        "start": lambda: start_time.rows(3 * sizes.few_repetitions),
        "answers on the real dataset": real_dataset.answers,
        "real dataset against SCS": lambda: real_dataset.speed(sizes.scs_repetitions),
        "the pairs alone": lambda: (
            single_pairs.rows_of("known", sizes.pair_starts) + single_pairs.rows_of("shared", sizes.pair_starts)
        ),
        "one X, one Y, against OpenCV": lambda: one_pair.rows(sizes.pair_repetitions),
        "AX = XB by dual quaternions": lambda: hand_eye.rows(sizes.hand_eye_problems, 4, sizes.few_repetitions),
        "OpenCV's hand-eye methods": lambda: opencv_hand_eye.rows(sizes.few_repetitions, sizes.opencv_problems),
        "beside busy cores": lambda: busy_cores.rows(3 * sizes.few_repetitions),
        "cost of the certificate": lambda: (
            certificate_cost.rows_of_real_dataset(None, sizes.processes, sizes.repetitions)
            + certificate_cost.rows_of_many(sizes.measurements, sizes.repetitions)
        ),
        "few measurements": lambda: few_measurements.rows(sizes.few_counts, sizes.few_trials, few_measurements.SEED),
        "a million measurements": lambda: million_measurements.rows(sizes.measurements, sizes.repetitions),
        "many frames": lambda: many_frames.rows(sizes.repetitions),
        "large graphs": lambda: large_graphs.rows(list(large_graphs.BARS), sizes.share_of_graphs, keep=False),
        "world origin": world_origin.rows,
        "outliers": lambda: outliers.rows(sizes.outlier_seeds, plot),
        "a long log with drift and outliers": long_log.rows,
        "edge summaries in GTSAM": lambda: edge_summaries.rows(sizes.few_repetitions),
        "time of rw.calibrate": lambda: calibrate_times.rows(sizes.few_repetitions),
        "from camera images": lambda: camera_logs.rows(sizes.log_poses),
        "images a second": lambda: vision_rate.rows(max(1, sizes.few_repetitions // 2), sizes.bare_loop_s),
        "a real workcell": lambda: workcell.rows(sizes.few_repetitions),
        "wrong detections": lambda: corrupted_detections.rows(sizes.corrupted_seeds),
        "our own code against libraries": lambda: own_code_against_libraries.rows(sizes.log_messages),
    }


def cannot_run() -> dict[str, str]:
    """By name of a part, what it lacks here."""
    lacking = {}
    if find_spec("scs") is None:
        lacking["real dataset against SCS"] = "scs"
    if not workcell.FOLDER.is_dir():
        lacking["a real workcell"] = "GTSAM_RWHEC_DATA, the folder that holds workcell_camera2"
    if not hasattr(cv2, "calibrateRobotWorldHandEye"):
        for name in ("one X, one Y, against OpenCV", "OpenCV's hand-eye methods"):
            lacking[name] = "opencv-python-headless<5"
    return lacking


def main() -> int:
    """Run them one after the other."""
    parser = benchmark_parser(__doc__)
    parser.add_argument("--quick", action="store_true", help="a small part of each, in a few minutes")
    parser.add_argument("--no-scs", action="store_true", help="leave out the rows that need SCS")
    parser.add_argument("--plot", type=Path, metavar="FOLDER", help="write the benchmarks' plots there")
    arguments = parser.parse_args()
    sizes, lacking = (QUICK, cannot_run()) if arguments.quick else (FULL, {})
    if arguments.no_scs:
        lacking["real dataset against SCS"] = "SCS, which --no-scs leaves out"
    rows: list[Row] = []
    for name, make in parts(sizes, arguments.plot).items():
        if name in lacking:
            print(f"{name}: left out, needs {lacking[name]}", file=sys.stderr, flush=True)
            continue
        print(f"{name} ...", file=sys.stderr, flush=True)
        start = time.perf_counter()
        rows += make()
        print(f"    {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
    title = "A part of each" if arguments.quick else "What must be reached"
    status = print_rows(title, rows, store=arguments.store)
    if arguments.plot is not None:
        print(f"Written to {many_frames.plot(arguments.plot, repetitions=5)}.")
    for name, runs in sizes.runs:
        status = max(status, script(name, "--runs", str(runs), store=arguments.store and name in WITH_BARS))
    if sizes.neutral_seeds:
        seeds = ",".join(map(str, sizes.neutral_seeds))
        for offsets in ("true", "estimated"):
            of_neutral = ("--seeds", seeds, "--offsets", offsets, "--no-times")
            status = max(status, script("kinhec.py", *of_neutral, store=arguments.store))
    return status


def script(name: str, *arguments: str, store: bool) -> int:
    """Run a script of this folder in a process of its own; its exit status."""
    command = [sys.executable, str(Path(__file__).with_name(name)), *arguments, *(["--store"] if store else [])]
    return subprocess.run(command, check=False).returncode


if __name__ == "__main__":
    raise SystemExit(main())
