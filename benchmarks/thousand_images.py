"""From folders to a result: 1,004 images of 1080p from four cameras, as `gtsam-rwhec calibrate` takes them.

    python benchmarks/thousand_images.py [--folder FOLDER] [--each 251]

The images are those of ``workcell_camera2`` and renderings like them (`four_cameras`). The command runs as a process,
in the environment that a user has; its time is on the clock, its memory the greatest sum over all of its processes of
what is theirs (shared pages in parts). A bare loop on one core, which decodes images and runs OpenCV's classic detector
with its fast check, is timed on every tenth image beside it.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from bars import Row, given_options, print_rows
from four_cameras import CAMERAS, Cell, made_cell
from rwhec_factors.se3 import inverse

import gtsam_rwhec as rw

BAR_S, BAR_BYTES = 90.0, 1.5e9
#: Seconds between two looks at the memory.
LOOK_S = 0.1


@dataclass(frozen=True)
class Run:
    """What one run of the command took and gave."""

    status: int
    seconds: float
    bytes_most: int
    words: str


def run(cell: Cell, out: Path) -> Run:
    """Run the command, and look at the memory of its processes."""
    shutil.rmtree(out, ignore_errors=True)
    command = [
        sys.executable,
        "-m",
        "gtsam_rwhec",
        "calibrate",
        str(cell.folder),
        "--rig",
        str(cell.rig),
        "-o",
        str(out),
    ]
    begun = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    most = 0
    ended = threading.Event()

    def look() -> None:
        nonlocal most
        while not ended.wait(LOOK_S):
            most = max(most, sum(map(_own_bytes, _with_children(process.pid))))

    watcher = threading.Thread(target=look)
    watcher.start()
    words, _ = process.communicate()
    seconds = time.monotonic() - begun
    ended.set()
    watcher.join()
    return Run(process.returncode, seconds, most, words)


def _with_children(pid: int) -> list[int]:
    """A process and all that it started, as far as they are there."""
    found, waiting = [], [pid]
    while waiting:
        found.append(waiting.pop())
        for task in Path(f"/proc/{found[-1]}/task").glob("*/children"):
            try:
                waiting += map(int, task.read_text().split())
            except OSError:  # it has ended
                continue
    return found


def _own_bytes(pid: int) -> int:
    """The memory of a process, with its part of what it shares."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:  # it has ended
        return 0
    return sum(1024 * int(line.split()[1]) for line in lines if line.startswith("Pss:"))


def classic_s(cell: Cell) -> float:
    """Seconds an image of the bare loop, on every tenth image."""
    files = sorted(cell.folder.glob("*/image/*.png"))[::10]
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    begun = time.monotonic()
    for file in files:
        gray = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        found, corners = cv2.findChessboardCorners(gray, (3, 4), flags=flags)
        if found:
            cv2.cornerSubPix(gray, corners, (5, 5), (-1, -1), (cv2.TERM_CRITERIA_EPS, 20, 1e-3))
    cv2.setNumThreads(threads)
    return (time.monotonic() - begun) / len(files)


def main() -> int:
    """Make the folder, run, print."""
    given = given_options(folder=Path, each=251)
    with tempfile.TemporaryDirectory() as temporary:
        place = given.folder or Path(temporary) / "cell"
        cell = made_cell(place, given.each)
        done = run(cell, place.with_name(f"{place.name}_out"))
        rows = [
            Row("time on the clock", f"{done.seconds:.1f} s", f"<= {BAR_S:.0f} s", done.seconds <= BAR_S),
            Row("images a second", f"{cell.images / done.seconds:.1f}"),
            Row("  the bare loop, one core", f"{1.0 / classic_s(cell):.1f}"),
            Row("memory", f"{done.bytes_most / 1e9:.2f} GB", "<= 1.5 GB", done.bytes_most <= BAR_BYTES),
            Row("exit status", str(done.status), "0", done.status == 0),
        ]
        path = place.with_name(f"{place.name}_out") / "result.json"
        if path.is_file():
            result = rw.results.read_result(path)
            assert result.refined is not None
            for name in CAMERAS:
                wrong = inverse(cell.Y[name]) @ result.refined.Y[name].matrix()
                turn = np.degrees(np.linalg.norm(cv2.Rodrigues(wrong[:3, :3])[0]))
                rows.append(Row(f"{name} off the truth", f"{1e3 * np.linalg.norm(wrong[:3, 3]):.2f} mm, {turn:.3f}°"))
        else:
            print(done.words)
        return print_rows(f"{cell.images} images, four cameras, from folders to result", rows)


if __name__ == "__main__":
    sys.exit(main())
