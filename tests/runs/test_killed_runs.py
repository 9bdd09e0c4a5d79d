"""Runs that are killed or end early leave whole files or none; the same command does the rest and finds the same."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import synthetic_logs as made
from bad_logs import MOVING, RECORDED, WRITTEN, calibrate
from cells_of_others import WORKCELL

import gtsam_rwhec as rw
from gtsam_rwhec.errors import FileFormatError, LogError
from gtsam_rwhec.logs import open_log
from gtsam_rwhec.rig import parse_rig
from gtsam_rwhec.runs.cleaning_stage import clean_log
from gtsam_rwhec.runs.detection_stage import detect_log
from gtsam_rwhec.runs.output_folder import DETECTIONS, LIST_FILE, earlier_run
from gtsam_rwhec.runs.run_log import DETECTION_METADATA
from gtsam_rwhec.runs.whole_runs import calibrate_log, solve_into

NUMBERS = (1, 43, 61, 94, 112, 121, 208, 221, 233, 242)
#: Instead of these of the workcell's images there are others: no picture, an empty file, a picture of another size, and
#: a link to nothing.
OTHERS = (20, 46, 49, 52)
IMAGES = len(NUMBERS) + len(OTHERS)
#: So many are detected together: four of 1920 x 1080, and the others.
TOGETHER = 4 + len(OTHERS)
#: Calibrates in a process for each moment, which kills itself then; says how many images each process decoded.
SCRIPT = """\
import os, signal, sys
from pathlib import Path
import gtsam_rwhec as rw
from gtsam_rwhec.detect import many_images

folder, rig, out, *moments = sys.argv[1:]
decode, give_name = many_images.decode_gray, os.replace

def calibrate(moment, counts):
    def counting(*arguments):
        os.write(counts, b".")
        return decode(*arguments)

    def killing(source, target):
        if Path(target).name == moment:
            os.kill(os.getpid(), signal.SIGKILL)
        give_name(source, target)

    def progress(stage):
        if stage == moment:
            os.kill(os.getpid(), signal.SIGKILL)

    many_images.decode_gray, os.replace = counting, killing
    rw.calibrate_log(folder, rw.rig.read_rig(rig), out, workers=1, replace=False, progress=progress)

for moment in moments:
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        calibrate(moment, write)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    os.close(write)
    print(len(os.read(read, 10_000)), os.WTERMSIG(status), flush=True)
    if not moment.endswith(".mcap"):
        with open(f"{out}/detections.jsonl", "ab") as stream:
            stream.write(b'0badc0de {"batch":1,"count":')
"""


@pytest.fixture(scope="module")
def cell(workcell_camera2: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ten of the workcell's images, and four that cannot be used."""
    folder = tmp_path_factory.mktemp("cell")
    (folder / "image").mkdir()
    for number in NUMBERS:
        (folder / "image" / f"{number:04d}.png").symlink_to(workcell_camera2 / "image" / f"{number:04d}.png")
    others = b"no picture", b"", cv2.imencode(".png", np.zeros((480, 640), dtype=np.uint8))[1].tobytes()
    for number, content in zip(OTHERS, others, strict=False):
        (folder / "image" / f"{number:04d}.png").write_bytes(content)
    (folder / "image" / f"{OTHERS[-1]:04d}.png").symlink_to(folder / "nothing")
    for name in ("pose", "intrinsic_pars_file.yaml"):
        (folder / name).symlink_to(workcell_camera2 / name)
    return folder


def result(out: Path) -> Any:
    """The result without its times."""

    def timeless(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: timeless(of_key) for key, of_key in value.items() if key != "seconds"}
        return [timeless(each) for each in value] if isinstance(value, list) else value

    return timeless(json.loads((out / "result.json").read_text(encoding="utf-8")))


def interrupted(
    folder: Path, out: Path, stage: str, text: str = WORKCELL, *, replace: bool = True
) -> tuple[list[str], str]:
    """What a calibration told until it was interrupted when a stage began, and what it said then."""
    stages: list[str] = []

    def interrupt(told: str) -> None:
        stages.append(told)
        if told.startswith(stage):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as stopped:
        calibrate_log(folder, parse_rig(text, "rig.yaml"), out, workers=1, replace=replace, progress=interrupt)
    (said,) = stopped.value.__notes__
    return stages, said


@pytest.mark.filterwarnings("ignore:.*(poses have no image|counts as an image)")
def test_a_run_that_is_killed_again_and_again(cell: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (tmp_path / "rig.yaml").write_text(WORKCELL, encoding="utf-8")
    moments = (f"detecting: image {TOGETHER} of {IMAGES}", "calibration.mcap")
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", SCRIPT, cell, tmp_path / "rig.yaml", out, *moments],
        capture_output=True,
        text=True,
    )
    killed = [tuple(map(int, line.split())) for line in done.stdout.splitlines()]
    assert [number for _, number in killed] == [signal.SIGKILL] * 2, done.stderr
    assert killed[1][0] == IMAGES - TOGETHER  # the rest only
    assert {DETECTIONS, LIST_FILE} <= {path.name for path in out.iterdir()}
    assert [path.name for path in out.iterdir() if path.name.startswith(".calibration.mcap.")]

    # The result is there before files are exported, which takes longer than all else.
    stages, _ = interrupted(cell, out, "exporting", replace=False)
    assert f"going on with an unfinished run: {IMAGES} of {IMAGES} images are done" in stages
    assert [stage for stage in stages if stage.startswith("detecting")] == [f"detecting: image {IMAGES} of {IMAGES}"]
    assert not [path for path in out.iterdir() if path.name.endswith(".part")]
    interrupted(cell, tmp_path / "at once", "exporting")
    assert result(out) == result(tmp_path / "at once")

    faults = result(out)["log"]["detection"]["undecoded"]["camera2"]
    assert [fault.split(":")[0] for fault in faults] == [f"image/{number:04d}.png" for number in OTHERS]
    assert "640 x 480 pixels, but the intrinsics are for 1920 x 1080" in faults[2]
    assert faults[1] == "image/0046.png: there are no bytes in it"
    assert faults[3] == "image/0052.png: there are no bytes in it"


@pytest.mark.filterwarnings("ignore:.*(poses have no image|counts as an image)")
def test_an_unfinished_run_of_other_inputs_is_refused(cell: Path, tmp_path: Path) -> None:
    folder, out = tmp_path / "cell", tmp_path / "out"
    shutil.copytree(cell, folder, symlinks=True)

    done = f"{TOGETHER} of {IMAGES} images are done"
    _, said = interrupted(folder, out, "detecting: image")
    assert said == f"The same command goes on from here: {done}, and kept in {out}."
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    (folder / "image" / "0020.png").write_bytes(b"another content")
    changed = WORKCELL.replace("square_m: 0.05", "square_m: 0.06")
    for _ in range(2):  # refused once, it is refused again
        with pytest.raises(LogError, match=r"unfinished run of other inputs, and nothing was changed: ") as refused:
            interrupted(folder, out, "detecting: image", changed, replace=False)
        assert "image/0020.png was changed; targets.board.square_m was 0.05 and is 0.06. Put that back" in str(
            refused.value
        )
        assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    # Where it may replace them it begins anew. What does not count for detection may change then.
    stages, _ = interrupted(folder, out, "detecting: image", changed)
    assert not [stage for stage in stages if stage.startswith("going on")]
    stages, _ = interrupted(folder, out, "looking for what hides", changed + "cleaning: {consensus: false}\n")
    assert f"going on with an unfinished run: {done}" in stages


pytestmark = pytest.mark.usefixtures("without_figures")

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]


NO_SPACE = OSError(errno.ENOSPC, "No space left on device")
#: Where a calibration ends, and how. Most files and both ways are there without a mark.
STOPS = [
    *((name, KeyboardInterrupt()) for name in ("calibration.mcap", "tf.yaml")),
    *((name, NO_SPACE) for name in ("calibration.mcap", "result.json")),
    *(pytest.param(name, NO_SPACE, marks=pytest.mark.slow) for name in ("tf.yaml", "evidence.json")),
    *(pytest.param(name, KeyboardInterrupt(), marks=pytest.mark.slow) for name in ("result.json", "report.html")),
]


def check_whole(folder: Path) -> None:
    """That every file under its final name is whole, and that there are no others."""
    for path in folder.rglob("*"):
        if path.is_dir():
            continue
        assert path.name in WRITTEN | {LIST_FILE}, path
        if path.suffix == ".mcap":
            with open_log(path) as log:
                assert not log.losses
                assert sum(1 for _ in log.records(["/tf"])) == len(MOVING)
                assert set(log.metadata()) & {DETECTION_METADATA}
        elif path.name == "result.json":
            assert set(rw.read_refined(path).Y) == set(made.CAMERAS)
        elif path.suffix == ".png":
            assert cv2.imread(str(path)) is not None
        else:
            assert path.read_bytes().endswith(b"}" if path.name == LIST_FILE else b"\n")


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """No file can be written that is larger, as on a disk that is full meanwhile."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.skipif(resource is None, reason="no limits of files here")
def test_stages_that_cannot_write_to_the_end(tmp_path: Path) -> None:
    raw, detected, clean, out = (tmp_path / name for name in ("raw.mcap", "detected.mcap", "calibration.mcap", "out"))
    made.write(raw, RECORDED)
    with largest_file(20_000), pytest.raises(LogError, match=r"detected\.mcap cannot be written: File too large"):
        detect_log(raw, made.rig(), detected)
    assert set(tmp_path.iterdir()) == {raw}
    detect_log(raw, made.rig(), detected)
    with largest_file(20_000), pytest.raises(LogError, match=r"calibration\.mcap cannot be written: File too large"):
        clean_log(detected, clean)
    assert set(tmp_path.iterdir()) == {raw, detected}
    clean_log(detected, clean)
    content = clean.read_bytes()
    with largest_file(20_000), pytest.raises(LogError, match=r"calibration\.mcap cannot be written: File too large"):
        clean_log(clean, clean)
    assert clean.read_bytes() == content  # onto itself: the one before stays
    with largest_file(1000), pytest.raises(FileFormatError, match=r"result\.json cannot be written: File too large"):
        solve_into(clean, None, out)
    assert list(out.iterdir()) == []
    with (
        largest_file(len(content)),
        pytest.raises(LogError, match=r"calibration\.mcap cannot be written: File too large"),
    ):
        solve_into(clean, None, out)
    assert {path.name for path in out.iterdir()} == {"result.json"}
    check_whole(out)


@pytest.fixture(scope="module")
def calibrated_before(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with raw.mcap and, in out/, a calibration of it."""
    folder = tmp_path_factory.mktemp("before")
    calibrate(folder, RECORDED)
    return folder


@pytest.mark.parametrize(("name", "stop"), STOPS)
def test_a_calibration_that_ends_early_leaves_whole_files(
    calibrated_before: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, stop: BaseException
) -> None:
    """When `name` is to get its name; into a folder in which there was a calibration before."""
    shutil.copytree(calibrated_before / "out", tmp_path / "out")
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir() if path.is_file()}
    give_name = os.replace

    def stopped(source: str | Path, target: str | Path) -> None:
        if Path(target).name == name:
            raise stop
        give_name(source, target)

    # What takes long is the same each time: only some begin with the raw log.
    log = calibrated_before / ("raw.mcap" if name == "calibration.mcap" else "out/calibration.mcap")
    rig = made.rig()
    with monkeypatch.context() as patched:
        patched.setattr(os, "replace", stopped)
        kind = KeyboardInterrupt if isinstance(stop, KeyboardInterrupt) else FileFormatError
        with pytest.raises(kind) as caught:
            calibrate_log(log, rig, tmp_path / "out")
    if kind is FileFormatError:
        assert re.search(rf"{re.escape(name)} cannot be written: No space left on device", str(caught.value))
    check_whole(tmp_path / "out")
    there = {path.name for path in (tmp_path / "out").iterdir()}
    assert there == WRITTEN | {LIST_FILE}
    state = "unfinished" if kind is KeyboardInterrupt else "failed"  # the next run need not be told to replace it
    assert earlier_run(tmp_path / "out") == ("raw.mcap", state)
    if name in before:
        assert (tmp_path / "out" / name).read_bytes() == before[name]
