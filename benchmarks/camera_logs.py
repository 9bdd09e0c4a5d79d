"""From camera images to a calibration: the shipped log against its truth, and in two encodings; other logs.

python benchmarks/camera_logs.py [--poses 1000000]
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
import tracemalloc
import warnings
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import gtsam
import numpy as np
from bars import Row, benchmark_parser, print_rows
from dataset import utias_folder
from mcap.reader import make_reader
from ros2_twin import write_twins
from utias_log import rig_text, write_utias_log

import gtsam_rwhec as rw
from gtsam_rwhec.logs import LogWriter, open_log
from gtsam_rwhec.rig import parse_rig, read_rig
from gtsam_rwhec.runs.whole_runs import calibrate_log

CELL = Path(__file__).resolve().parents[1] / "data" / "cell"

SIGMA_M, ROTATION_DEG = 0.005, 0.5


def demo(out: Path) -> list[Row]:
    """The shipped log, end to end, against its truth."""
    truth = json.loads((CELL / "truth.json").read_text(encoding="utf-8"))
    start = time.perf_counter()
    refined = calibrate_log(CELL / "robot_cell.mcap", read_rig(CELL / "rig.yaml"), out).refined
    seconds = time.perf_counter() - start
    poses = refined.X | refined.Y
    frames = truth["T_hand_camera"] | truth["T_base_target"]
    off = {name: gtsam.Pose3(np.array(T)).between(poses[name]) for name, T in frames.items()}
    mm = {name: 1e3 * float(np.linalg.norm(pose.translation())) for name, pose in off.items()}
    deg = {n: float(np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(p.rotation())))) for n, p in off.items()}
    clock_ms = max(1e3 * abs(refined.time_offsets_s[n] - s) for n, s in truth["time_offset_s"].items())
    assert isinstance(refined.scale, dict)
    size = 100.0 * abs(refined.scale["board"] / truth["scale"]["board"] - 1.0)
    inside = [refined.contains(name, np.array(T), 0.95) for name, T in frames.items()]
    certificate = refined.solution.certificate
    sensors = list(truth["T_hand_camera"])
    return [
        Row("demo, end to end, from images", f"{certificate.status}, {seconds:.0f} s", "certified",
            certificate.is_certified),
        *(
            Row(f"    {what}", f"{max(mm[n] for n in names):.3f} mm, {max(deg[n] for n in names):.4f} deg",
                "<= 2 mm, 0.2 deg (stretch 1, 0.1)", all(mm[n] <= 2.0 and deg[n] <= 0.2 for n in names))
            for what, names in (("worst sensor", sensors), ("worst of all frames", list(frames)))
        ),
        Row("    worst time offset", f"{clock_ms:.3f} ms", "<= 2 ms", clock_ms <= 2.0),
        Row("    the wrong board's size", f"{size:.4f} %", "<= 0.2 %", size <= 0.2),
        Row("    truths inside their 95 % ellipsoids", f"{sum(inside)} of {len(inside)}", "all", all(inside)),
    ]  # fmt: skip


def twins(folder: Path) -> list[Row]:
    """The shipped log as Foxglove JSON and as a ROS 2 bag."""
    write_twins(folder / "json.mcap", folder / "ros2.mcap", images=1000)
    results = []
    for name in ("json", "ros2"):
        calibrate_log(folder / f"{name}.mcap", read_rig(CELL / "rig.yaml"), folder / name)
        result: dict[str, Any] = json.loads((folder / name / "result.json").read_text(encoding="utf-8"))
        for certificate in (result["certificate"], *(part["certificate"] for part in result["parts"])):
            certificate.pop("seconds")
        result["log"]["detection"].pop("sources")
        results.append(result)
    same = results[0] == results[1]
    return [Row("ROS 2 bag and Foxglove JSON", "identical" if same else "different", "identical", same)]


def real_dataset(folder: Path) -> list[Row]:
    """From CSV and from a log."""
    problem = rw.read_csv(utias_folder(), sigma=SIGMA_M, kappa=1.0 / (2.0 * np.radians(ROTATION_DEG) ** 2))
    expected = rw.solve(problem)
    write_utias_log(utias_folder(), folder / "utias.mcap")
    rig = parse_rig(rig_text(problem.targets, ROTATION_DEG, 1e3 * SIGMA_M), "rig")
    found = calibrate_log(folder / "utias.mcap", rig, folder / "utias").refined.solution
    cost = abs(found.cost / expected.cost - 1.0)
    answers = expected.X | expected.Y
    poses = max(float(np.abs((found.X | found.Y)[n].matrix() - p.matrix()).max()) for n, p in answers.items())
    return [
        Row("real dataset from a log: cost, relative to CSV's", f"{cost:.1e}", "<= 1e-12", cost <= 1e-12),
        Row("    poses, largest difference", f"{poses:.1e}", "<= 1e-12", poses <= 1e-12),
    ]


def reading(folder: Path, count: int) -> list[Row]:
    """Pose messages against the mcap library's own iteration, undecoded."""
    path = folder / "poses.mcap"
    with LogWriter(path) as out:
        for i in range(count):
            T = np.eye(4)
            T[0, 3] = i
            out.transforms("/tf", 1_700_000_000_000_000_000 + i * 1_000_000, [("base", "hand", T)])

    def undecoded() -> int:
        with open(path, "rb") as stream:
            return sum(1 for _ in make_reader(stream).iter_messages())

    def ours() -> int:
        with open_log(path) as log:
            return sum(1 for _ in log.records(["/tf"]))

    ratios = []
    for _ in range(3):
        times = []
        for read in (ours, undecoded):
            start = time.perf_counter()
            assert read() == count
            times.append(time.perf_counter() - start)
        ratios.append(times[0] / times[1])
    tracemalloc.start()
    ours()
    peak = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    ratio = float(np.median(ratios))
    return [
        Row(f"reading {count:,} pose messages (JSON) over undecoded", f"{ratio:.2f}x", "<= 3x", ratio <= 3.0),
        Row("    memory at its peak", f"{peak:.0f} MB", "bounded"),
    ]


def rows(poses: int = 1_000_000) -> list[Row]:
    """All of them."""
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        folder = Path(name)
        return [*demo(folder / "demo"), *twins(folder), *real_dataset(folder), *reading(folder, poses)]


if __name__ == "__main__":
    parser = benchmark_parser(__doc__)
    parser.add_argument("--poses", type=int, default=1_000_000)
    arguments = parser.parse_args()
    sys.exit(print_rows("From camera images", rows(arguments.poses), store=arguments.store))
