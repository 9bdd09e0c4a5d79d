"""Every benchmark, one after the other, each in a process of its own with its own table.

    python benchmarks/run_all.py [--quick] [--only NAME ...]

Takes some hours. ``--quick`` takes minutes: a small part of each, which tells that all run and roughly where they are
(bars of small parts may be missed by chance). Exits with 1 if a bar is missed. `pip install '.[bench]'` brings what the
neutral benchmark and OpenCV 4's hand-eye calls need. The papers' tables are in examples/papers.
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

from bars import benchmark_parser

#: By script, the arguments of all of it and of a small part; no small part: it is left out of ``--quick``.
SCRIPTS: dict[str, tuple[str, str | None]] = {
    "start_time": ("", "--repetitions 3"),
    "real_dataset": ("", "--repetitions 3"),
    "single_pairs": ("", "--starts 3"),
    "one_pair": ("", "--repetitions 7"),
    "calibrate_times": ("", "--runs 1"),
    "million_measurements": ("", "--count 100000 --repetitions 3"),
    "large_graphs": ("", "--share 0.1"),
    "large_duals": ("--problems 20 --most 200", None),
    "hand_eye": ("", "--problems 50"),
    "opencv_hand_eye": ("", "--repetitions 1 --problems 5"),
    "few_measurements": ("", "--quick"),
    "outliers": ("", "--seeds 1"),
    "planned_poses": ("", "--rigs 4 --calibrated 4"),
    "misreadings": ("", None),
    "slipped_rows": ("", "--logs 6 --good 8"),
    "coverage": ("--runs 1000", "--runs 4"),
    "wrong_assumptions": ("--runs 1000", "--runs 1"),
    "split_halves": ("--runs 300", "--runs 1"),
    "corner_times": ("", "--views 25"),
    "corner_native": ("", "--views 25"),
    "corner_coverage": ("--runs 2000", "--runs 4"),
    "corner_wrong_intrinsics": ("--runs 400", "--runs 2"),
    "corner_undetermined": ("--runs 60", "--runs 2"),
    "corner_intrinsics": ("--runs 200", "--runs 2"),
    "corner_efficiency": ("--runs 2000", "--runs 4"),
    "rendered_boards": ("--images 200", "--images 3"),
    "rendered_cells": ("--cells 300 --folder build/cells --keep build/cells.jsonl", None),
    "cell_models": ("--folder build/cells --keep build/cells.jsonl --models build/models.jsonl --opencv 60", None),
    "thousand_images": ("", None),
    "many_tags": ("", "--tags 9"),
    "workcell": ("--splits 20", "--repetitions 1"),
    "report_cost": ("", ""),
    "gallery": ("--runs 10", None),
    "changes": ("--runs 1000", "--runs 1"),
    "acceptance": ("", "--runs 20"),
    "trajectories": ("--runs 6", "--runs 1 --kinds walk --movers held"),
    "odometry_bounds": ("--runs 40", "--runs 1"),
    "object_clouds": ("--runs 300", "--runs 6 --views 9"),
    "odometry_planar": ("--runs 200", "--runs 1"),
    "lidars_together": ("", "--runs 1"),
    "lidar_camera": ("", "--runs 3 --biased 1 --splits 2"),
    "fleet_scale": ("", None),
    "fleet_kills": ("", None),
    "fleet_s3": ("", None),
    "fleet_drift": ("", None),
    "kinhec": ("--seeds 20260909", None),
}


def main() -> int:
    """Run them."""
    parser = benchmark_parser(__doc__)
    parser.add_argument("--quick", action="store_true", help="a small part of each, in a few minutes")
    parser.add_argument("--only", nargs="+", choices=list(SCRIPTS), default=list(SCRIPTS), metavar="NAME")
    given = parser.parse_args()
    status = 0
    for name in given.only:
        arguments = SCRIPTS[name][1 if given.quick else 0]
        if arguments is None:
            continue
        print(f"{name} {arguments} ...", file=sys.stderr, flush=True)
        start = time.perf_counter()
        command = [sys.executable, str(Path(__file__).with_name(f"{name}.py")), *arguments.split()]
        status = max(status, subprocess.run(command, check=False).returncode)
        print(f"    {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
    return status


if __name__ == "__main__":
    raise SystemExit(main())
