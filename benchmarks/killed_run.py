"""A run that is killed on the way and started again: what is done again, and whether the result is the same.

    python benchmarks/killed_run.py [--images 300] [--share 0.8] [--workers 2]

The folder has the 39 images of ``workcell_camera2`` again and again, each with its pose. One run is killed with SIGKILL
when `share` of the images are done, and the same command is started again; another run is left alone. Images are
counted where they are decoded, which is in this many threads; more than 320 images are decoded in processes unless
``--workers 1`` keeps them in threads. Times are on the clock.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from itertools import cycle, islice
from pathlib import Path
from typing import Any

from bars import Row, print_rows

from gtsam_rwhec.detect.many_images import FEW

DATA = Path(os.environ.get("GTSAM_RWHEC_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
RIG = """\
carriers: {sensors: base, targets: hand, poses: {frames: [base, hand]}}
sensors:
  camera2: {images: image, poses: pose, intrinsics: intrinsic_pars_file.yaml}
targets:
  board: {type: checkerboard, inner_corners: [3, 4], square_m: 0.05}
"""
#: The command with two files beside it: one gets a byte for each image that is decoded, the other what is told.
COUNTING = """\
import os, sys
from gtsam_rwhec.detect import many_images
from gtsam_rwhec.cli import stage_display
from gtsam_rwhec.cli.app import main

decode, show = many_images.decode_gray, stage_display.StageDisplay.__call__
decoded, told = (os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND) for path in sys.argv[1:3])

def counting(*arguments):
    os.write(decoded, b".")
    return decode(*arguments)

def telling(self, stage):
    os.write(told, (stage + "\\n").encode())
    show(self, stage)

many_images.decode_gray, stage_display.StageDisplay.__call__ = counting, telling
del sys.argv[1:3]
main()
"""


@dataclass(frozen=True)
class Run:
    """A run that has ended: its exit status, images decoded, the images that it went on from, seconds."""

    status: int
    decoded: int
    went_on_from: int
    seconds: float


def make_folder(folder: Path, images: int) -> None:
    """The workcell's images and poses, `images` of them."""
    source = DATA / "workcell_camera2"
    for part in ("image", "pose"):
        (folder / part).mkdir(parents=True)
    names = sorted(path.stem for path in (source / "image").glob("*.png"))
    for number, name in enumerate(islice(cycle(names), images)):
        shutil.copy(source / "image" / f"{name}.png", folder / "image" / f"{number:05d}.png")
        (pose,) = (source / "pose").glob(f"{name}.*")
        shutil.copy(pose, folder / "pose" / f"{number:05d}{pose.suffix}")
    shutil.copy(source / "intrinsic_pars_file.yaml", folder)
    (folder / "rig.yaml").write_text(RIG, encoding="utf-8")


def run(folder: Path, out: Path, workers: int, killed_at: int | None = None) -> Run:
    """Calibrate; kill the command when so many images are done."""
    files = out.with_suffix(".decoded"), out.with_suffix(".told")
    for file in files:
        file.write_bytes(b"")
    begin = time.monotonic()
    command = [sys.executable, "-c", COUNTING, *files, "calibrate", folder, "--rig", folder / "rig.yaml", "-o", out]
    process = subprocess.Popen(
        [*map(str, command), "--workers", str(workers)], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    while process.poll() is None and killed_at is not None:
        if done_in(out) >= killed_at:
            process.send_signal(signal.SIGKILL)
            break
        time.sleep(0.01)
    _, said = process.communicate()
    if process.returncode not in (0, -signal.SIGKILL):
        sys.exit(f"the run ended with {process.returncode}: {said.decode()}")
    going_on = [line for line in files[1].read_text(encoding="utf-8").splitlines() if line.startswith("going on")]
    came_from = int(going_on[0].split(": ")[1].split(" of ")[0].replace(",", "")) if going_on else 0
    return Run(process.returncode, files[0].stat().st_size, came_from, time.monotonic() - begin)


def done_in(out: Path) -> int:
    """How many images a folder keeps."""
    try:
        lines = (out / "detections.jsonl").read_bytes().splitlines()[1:]
    except FileNotFoundError:
        return 0
    return sum(json.loads(line.partition(b" ")[2]).get("count", 0) for line in lines if line.endswith(b"}"))


def timeless(value: Any) -> Any:
    """A result without its times."""
    if isinstance(value, dict):
        return {key: timeless(of_key) for key, of_key in value.items() if key != "seconds"}
    return [timeless(each) for each in value] if isinstance(value, list) else value


def rows(images: int, share: float, workers: int) -> list[Row]:
    """The table's rows."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "cell"
        make_folder(folder, images)
        killed = run(folder, Path(temporary) / "out", workers, round(share * images))
        again = run(folder, Path(temporary) / "out", workers)
        alone = run(folder, Path(temporary) / "alone", workers)
        results = [
            timeless(json.loads((Path(temporary) / out / "result.json").read_text(encoding="utf-8")))
            for out in ("out", "alone")
        ]
    twice = killed.decoded + again.decoded - images
    is_same = results[0] == results[1]
    return [
        Row(
            "images that the killed run decoded",
            f"{killed.decoded} of {images}",
            "killed",
            killed.status == -signal.SIGKILL,
        ),
        Row(
            "images that the second run went on from, and decoded",
            f"{again.went_on_from}, {again.decoded}",
            "the rest only",
            again.went_on_from + again.decoded == images,
        ),
        Row("images decoded twice: they were under way when the run was killed", f"{twice}"),
        Row(
            "result.json is equal, but for times",
            "yes" if is_same else "no",
            "yes",
            is_same and alone.decoded == images,
        ),
        Row(
            "seconds: killed, started again, left alone",
            f"{killed.seconds:.1f}, {again.seconds:.1f}, {alone.seconds:.1f}",
        ),
    ]


def main() -> int:
    """Print the table; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=300)
    parser.add_argument("--share", type=float, default=0.8, help="killed when this share of the images is done")
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    if arguments.images > FEW and arguments.workers > 1:
        parser.error(f"more than {FEW} images are decoded in processes, where they are not counted: --workers 1")
    return print_rows("a killed run", rows(arguments.images, arguments.share, arguments.workers))


if __name__ == "__main__":
    sys.exit(main())
