"""A calibration that ends early leaves whole files or none."""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import pytest
import synthetic_logs as made
from bad_logs import MOVING, RECORDED, WRITTEN, calibrate

import gtsam_rwhec as rw
from gtsam_rwhec.errors import FileFormatError, LogError
from gtsam_rwhec.logs import open_log
from gtsam_rwhec.runs.cleaning_stage import clean_log
from gtsam_rwhec.runs.detection_stage import detect_log
from gtsam_rwhec.runs.output_folder import LIST_FILE, earlier_run
from gtsam_rwhec.runs.run_log import DETECTION_METADATA
from gtsam_rwhec.runs.whole_runs import calibrate_log, solve_into

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
